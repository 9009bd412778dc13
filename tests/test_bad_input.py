"""What a user may get wrong: one clear line that names the file, exit code 1, no traceback, nothing half written."""
import json

import numpy as np
import pytest
from completion_bodies import half_view, worm_with_prior
from model_bodies import worm

from completion import MarkerLayout, MarkerSequence, write_markers
from completion.__main__ import main
from scanprep import Mesh, write_landmarks, write_mesh
from scanprep.geometry.files import PointCloud, write_points

MARKS = {"head": 10, "tail": 380, "left": 100, "right": 200, "middle": 250}


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A user's folder with a good model, template, scans, half view, markers; each test breaks one thing."""
    monkeypatch.chdir(tmp_path)
    model = worm_with_prior()
    body = model.template
    write_mesh("template.ply", body)
    write_landmarks("template.landmarks.json", MARKS)
    model.info["landmarks"] = MARKS
    model.save("model.npz")
    for k in range(3):
        moved = body.with_vertices(body.vertices + [0, 0, 0.05 * k])
        write_mesh(f"scans/scan{k}.ply", moved)
        write_landmarks(f"scans/scan{k}.landmarks.json", {name: moved.vertices[v] for name, v in MARKS.items()})
        write_mesh(f"poses/pose{k}.ply", moved)
    points, _ = half_view(body, np.array([0.0, -1.0, 0.0]))
    write_points("half.ply", PointCloud(points))
    write_landmarks("half.landmarks.json", {name: body.vertices[v] for name, v in MARKS.items()})
    more = np.setdiff1d(np.linspace(0, len(body.vertices) - 1, 7).astype(int), list(MARKS.values()))
    labels, rows = (*MARKS, *(f"M{k}" for k in more)), np.r_[list(MARKS.values()), more]
    write_markers("walk.c3d", MarkerSequence(np.repeat(body.vertices[None, rows], 40, axis=0), labels, 60.0))
    MarkerLayout(labels, rows).save("layout.json")
    return tmp_path


PREP = "prep run scans --template template.ply -o out"
FILL = "prep fill mesh.ply -o out.ply"
LEARN = "learn --poses poses -o out.npz"
COMPLETE = "complete half.ply -m model.npz --subject template -o out"
ANIMATE = "animate walk.c3d -m model.npz --layout layout.json -o out"
MOSH = "mosh walk.c3d -m model.npz --layout layout.json -o out"
def template(change):
    def write(place):
        write_mesh("template.ply", change(worm()))
    return write


def model_of_version(version):
    def write(place):
        with np.load("model.npz") as stored:
            arrays = dict(stored)
        header = json.loads(str(arrays["header"]))
        arrays["header"] = np.array(json.dumps({**header, "version": version}))
        np.savez("model.npz", **arrays)
    return write


def remove(name):
    return lambda place: (place / name).unlink()


def text(name, content):
    return lambda place: (place / name).write_text(content)


def fan(body):
    """A third triangle on an edge."""
    third = [*body.faces[0, :2], len(body.vertices)]
    return Mesh(np.vstack([body.vertices, [[0.3, 2, 2]]]), np.vstack([body.faces, [third]]))


def cut(name, end):
    return lambda place: (place / name).write_bytes((place / name).read_bytes()[:end])


CASES = {
    "missing file": (FILL, lambda place: None, ["mesh.ply", "no such file"]),
    "truncated": (FILL, lambda place: (place / "mesh.ply").write_bytes((place / "template.ply").read_bytes()[:-50]),
                  ["mesh.ply", "face"]),
    "template not manifold": (PREP, template(fan), ["template", "not manifold"]),
    "no landmarks of the template": (PREP, remove("template.landmarks.json"), ["template.ply", "landmarks"]),
    "no scans": ("prep run nowhere --template template.ply -o out", lambda place: None, ["nowhere"]),
    "poses of other topology": (LEARN, lambda place: write_mesh("poses/pose1.ply", worm(20)),
                                ["pose1.ply", "pose0.ply"]),
    "faces in another order": (LEARN, lambda place: write_mesh("poses/pose1.ply", Mesh(
        worm().vertices, worm().faces[::-1])), ["pose1.ply", "face"]),
    "one pose": (LEARN, lambda place: [(place / "poses" / f"pose{k}.ply").unlink() for k in (1, 2)], ["poses"]),
    "shapes of other topology": (LEARN + " --shapes shapes", lambda place: write_mesh("shapes/a.ply", worm(20)),
                                 ["shapes", "expected the triangles"]),
    "skeleton that is none": (LEARN + " --skeleton layout.json", lambda place: None, ["layout.json", "skeleton"]),
    "no such landmark file": (COMPLETE + " --landmarks clicks.json", lambda place: None,
                              ["clicks.json", "no such file"]),
    "landmarks cut off": (COMPLETE, text("half.landmarks.json", '{"head": [0, 0'), ["half.landmarks.json"]),
    "model of the future": (COMPLETE, model_of_version(99), ["model.npz", "version 99"]),
    "model that is none": (COMPLETE, text("model.npz", "nothing"), ["model.npz"]),
    "model cut off": (COMPLETE, cut("model.npz", 2000), ["model.npz"]),
    "scan missing": (COMPLETE, remove("half.ply"), ["half.ply"]),
    "no marker of the layout": (ANIMATE, lambda place: MarkerLayout(("A", "B", "C"), np.arange(3)).save("layout.json"),
                                ["head", "A"]),
    "layout of another body": (ANIMATE, lambda place: MarkerLayout(
        tuple(MARKS), np.arange(5) + 10_000).save("layout.json"), ["layout.json"]),
    "layout that is none": (ANIMATE, text("layout.json", "[]"), ["layout.json"]),
    "recording cut off": (ANIMATE, cut("walk.c3d", -1200), ["walk.c3d"]),
    "betas that are none": (ANIMATE + " --subject layout.json", lambda place: None, ["layout.json", "betas"]),
    "too many betas": (ANIMATE + " --subject betas.json", text("betas.json", "[1, 2, 3, 4, 5, 6, 7, 8, 9]"),
                       ["betas.json", "3"]),
    "mesh of another topology for a subject": (ANIMATE + " --subject other.ply",
                                               lambda place: write_mesh("other.ply", worm(20)), ["other.ply"]),
    "nothing to mosh": ("mosh nowhere -m model.npz -o out", lambda place: None, ["nowhere", "no such file"]),
    "a folder without markers": ("mosh poses -m model.npz -o out", lambda place: None, ["poses", ".c3d"]),
    "a table of nobody": (MOSH + " --subjects layout.json", lambda place: None, ["layout.json", "subject"]),
    "a table of other files": (MOSH + " --subjects who.csv", text("who.csv", "file,subject\nrun.c3d,ann\n"),
                               ["who.csv", "run.c3d"]),
    "a character that is none": (MOSH + " --retarget-to layout.json", lambda place: None, ["layout.json"]),
    "a sex alone": (MOSH + " -m model.npz", lambda place: None, ["--model", "three"]),
}


USAGE = ("a sex alone",)                         # the command line is wrong, whatever the files hold


@pytest.mark.parametrize("case", CASES)
def test_one_clear_line(place, capsys, case):
    command, spoil, expected = CASES[case]
    spoil(place)
    before = sorted(place.rglob("*"))
    assert main(command.split()) == (2 if case in USAGE else 1)
    lines = capsys.readouterr().err.splitlines()
    said = [line for line in lines if line.startswith("scape ") and ": note: " not in line]
    assert len(said) == 1, said
    assert all(word in said[0] for word in expected), said[0]
    assert "Traceback" not in said[0]
    assert sorted(place.rglob("*")) == before


FULL, GONE = OSError(28, "No space left on device"), OSError(5, "Input/output error")


@pytest.mark.parametrize("error", [FULL, GONE], ids=["full", "gone"])
@pytest.mark.parametrize("line", ["model export model.npz -o out.glb", "model mesh model.npz -o out.ply",
                                  "layout transfer layout.json --source template.ply --target model.npz -o out.json"])
def test_a_disk_that_is_full_or_goes_away_is_told_with_the_file(place, capsys, monkeypatch, line, error):
    def fail(*args, **kwargs):
        raise error

    monkeypatch.setattr("pathlib.Path.write_bytes", fail)
    monkeypatch.setattr("os.write", fail)
    monkeypatch.setattr("os.replace", fail)
    before = sorted(place.rglob("*"))
    assert main(line.split()) == 1
    told = capsys.readouterr().err.strip().splitlines()[-1]
    assert f"{line.split()[-1]}: " in told and "Errno" not in told
    assert ("the disk is full" if error is FULL else "Input/output error") in told
    assert sorted(place.rglob("*")) == before


@pytest.mark.parametrize("name", ["two words", "it's", "-anna", 'quo"te', "$HOME", "\u00e4" * 90])
def test_a_scan_of_any_name_is_taken(place, capsys, name):
    (place / "scans" / "scan0.ply").rename(place / "scans" / f"{name}.ply")
    (place / "scans" / "scan0.landmarks.json").rename(place / "scans" / f"{name}.landmarks.json")
    assert main(["prep", "clean", f"scans/{name}.ply", "-o", f"{name}.ply"]) == 0
    assert (place / f"{name}.ply").exists() and name in capsys.readouterr().err
    assert main(["prep", "clean", "-o", "out.ply", "--", f"{name}.ply"]) == 0
    assert main(["prep", "clean", f"{name}.ply", "-o", "more.ply"]) == (2 if name[0] == "-" else 0)
    assert name[0] != "-" or f"write ./{name}.ply" in capsys.readouterr().err


def test_a_result_never_replaces_the_file_it_is_made_of(place, capsys):
    assert main("prep fill template.ply -o out.ply".split()) == 0
    before = (place / "out.ply").read_bytes()
    assert main("prep decimate out.ply --faces 100 -o out.ply".split()) == 2
    assert "--output: expected another file than out.ply, which is read" in capsys.readouterr().err
    assert (place / "out.ply").read_bytes() == before
