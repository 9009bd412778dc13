"""`scape mosh`: people and their motions from files and folders of markers."""
import json
import shutil

import numpy as np
import pytest
from completion_bodies import worm_with_prior
from config_files import config_file
from glb_reader import Glb
from mosh_folders import FRAMES, QUICK, QuietWork, run, small_pictures, write_people

from completion import MarkerSequence, Motion, read_markers, write_markers
from completion.__main__ import main
from completion.mocap.mosh import cli
from completion.mocap.mosh.recordings import find_actors, write_grouping
from completion.mocap.soft_tissue.soft_tissue import SoftTissue
from completion.motion_pictures import frames_to_play
from model.learning.sexes import SexPlane
from scanprep.geometry.format_glb import turn_up
from scanprep.pictures.camera import guess_upright

PERSON = {"subject.json", "layout.json", "report.html", "report.json", "picture.png"}
TAKE = {"motion.npz", "soft_tissue.npz", "animation.glb", "motion.bvh", "motion.trc",
        "joint_angles.csv", "joint_centres.csv",
        "residuals.csv", "residuals_soft.csv", "virtual.c3d", "artefacts.json", "artefacts.csv", "report.html",
        "report.json", "picture.png"}

@pytest.fixture(scope="module", autouse=True)
def nobody_looks():
    with small_pictures():
        yield


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    return write_people(tmp_path_factory.mktemp("mosh"))


def told(folder):
    return {row["metric"]: row["value"] for row in json.loads((folder / "report.json").read_text())["metrics"]}


@pytest.fixture(scope="module")
def done(place, tmp_path_factory):
    """The two recordings of ann, as a table says."""
    out = tmp_path_factory.mktemp("done") / "out"
    (place / "who.json").write_text('{"walk": "ann", "run": "ann"}')
    assert run(place, place / "people" / "ann", "-o", out, "--subjects", place / "who.json",
               "--retarget-to", place / "model.npz", exaggeration=2.0) == 0
    return out


def test_everything_is_written(done):
    assert {p.name for p in done.iterdir()} == {".scapekit", "ann", "report.html", "report.json", "subjects.csv"}
    assert {p.name for p in (done / "ann").iterdir()} == PERSON | {"walk", "run"}
    for name in ("walk", "run"):
        assert {p.name for p in (done / "ann" / name).iterdir()} == TAKE | {
            "exaggerated.glb", "character.glb", "character.npz"}


@pytest.mark.slow
@pytest.mark.parametrize("words", [("--preset", "published"), ("--config", "soft.toml", "--character", "model.npz")])
def test_betas_may_change_in_every_frame(place, tmp_path, monkeypatch, words):
    """As the paper has it: by its preset, and by the setting alone; every file is there."""
    monkeypatch.chdir(place)
    config_file(place, "soft.toml", person=QUICK, soft={"shape_change": 0.25})
    assert main(["mosh", "people/ann/walk.csv", "-m", "model.npz", "--layout", "layout.json", "-o",
                 str(tmp_path / "out"), "--workers", "1", *words]) == 0
    take = next((tmp_path / "out").glob("*/walk*"), tmp_path / "out")
    assert SoftTissue.load(take / "soft_tissue.npz").changes.any()
    assert (take / "animation.glb").stat().st_size > 1000


def test_gaps_are_counted(done):
    artefacts = json.loads((done / "ann" / "walk" / "artefacts.json").read_text())
    assert artefacts["filled"]["M3"] >= 4
    figures = told(done / "ann" / "walk")
    assert figures["gaps filled in"] == sum(artefacts["filled"].values())
    assert figures["markers missing"] == pytest.approx(100 * 4 / (FRAMES * 34))


def test_the_glb_lasts_as_long_as_the_motion_and_exaggerates(done):
    first = {}
    for name in ("animation.glb", "exaggerated.glb"):
        glb = Glb((done / "ann" / "walk" / name).read_bytes())
        times = glb.array(glb.json["animations"][0]["samplers"][0]["input"])[:, 0]
        assert len(times) == FRAMES and times[-1] == pytest.approx((FRAMES - 1) / 60, rel=1e-5)
        up = guess_upright(worm_with_prior().template)[0]
        first[name] = np.stack([glb.skinned(t) for t in range(FRAMES)]) @ turn_up(up)
    soft = SoftTissue.load(done / "ann" / "walk" / "soft_tissue.npz")
    rigid = soft.motion.vertices(worm_with_prior().subject(soft.motion.betas))
    for factor, name in ((1, "animation.glb"), (2, "exaggerated.glb")):
        exact = soft.vertices(worm_with_prior(), factor=factor)
        off = np.linalg.norm(first[name] - exact, axis=2)
        assert off.mean() < 1e-3 and np.linalg.norm(exact - rigid, axis=2).max() > 1e-4
        assert told(done / "ann" / "walk")[f"{name}, distance from the exact body, mean"] == pytest.approx(
            1000 * off.mean(), rel=1e-2)


def test_pages_lead_to_each_other_and_tell_the_markers(done):
    assert 'href="ann/report.html"' in (done / "report.html").read_text()
    person = (done / "ann" / "report.html").read_text()
    assert 'href="walk/report.html"' in person and "Markers before and after" in person and ">M33<" in person
    take = (done / "ann" / "walk" / "report.html").read_text()
    assert "Soft tissue" in take and "Marker artefacts" in take


@pytest.mark.slow
def test_a_folder_of_people_goes_on_where_it_was(place, tmp_path, capsys):
    people, out = tmp_path / "people", tmp_path / "out"
    shutil.copytree(place / "people", people)
    (people / "ann" / "run.csv").unlink()
    assert run(place, people, "-o", out, soft_tissue=False) == 0
    said = capsys.readouterr().err
    assert "ann: walk.csv" in said and "scape view --mend" in said.split("next: ")[1]
    assert (told(out)["people"], told(out)["done before"], told(out)["failed"]) == (2, 0, 0)
    assert not (out / "ann" / "walk" / "soft_tissue.npz").exists()
    when = (out / "ann" / "walk" / "motion.npz").stat().st_mtime_ns
    (people / "bob" / "jump.csv").write_text("time,A_x,A_y,A_z\n0,1,2,3\n0.1,1,2,3\n")
    (people / "bob" / "swim.csv").write_text("nothing")
    assert run(place, people, "-o", out, soft_tissue=False) == 1
    said = capsys.readouterr().err
    assert "failed: bob: " in said and "labels: expected at least 3 markers of the layout" in said
    assert (out / "ann" / "walk" / "motion.npz").stat().st_mtime_ns == when
    assert (told(out)["done before"], told(out)["failed"]) == (1, 1)
    assert not (out / "bob" / "jump" / "motion.npz").exists()          # it was of other markers than there are now
    shutil.copy(place / "people" / "bob" / "jump.csv", people / "bob" / "jump.csv")
    assert run(place, people, "-o", out, soft_tissue=False) == 1              # one file of bob's cannot be read
    assert "bob: " in (said := capsys.readouterr().err) and "swim.csv" in said and "ann: ann" not in said
    assert told(out)["done before"] == 1 and told(out)["failed"] == 0
    assert [p.name for p in out.glob(".*")] == [".scapekit"]


def test_two_people_and_a_prop_in_one_file_become_two_folders(place, tmp_path, capsys, monkeypatch):
    """The same bodies as from files of their own, with feet held; the prop is told."""
    some = slice(10, 22)
    ann, bob = (read_markers(place / "people" / name).frames(some) for name in ("ann/walk.csv", "bob/jump.csv"))
    ball = np.full((12, 3, 3), 1.0) + 0.1 * np.eye(3)
    labels = [f"{who}:{label}" for who in ("Ann", "Bob") for label in ann.labels]
    positions = np.concatenate([ann.positions, bob.positions + [2.0, 0, 0], ball], axis=1)
    write_markers(tmp_path / "two.c3d", MarkerSequence(positions, (*labels, "Ball:A", "Ball:B", "Ball:C"), 60.0))
    monkeypatch.setattr(cli, "MoshTask", QuietWork)
    out = tmp_path / "out"
    assert run(place, tmp_path / "two.c3d", "-o", out, soft_tissue=False, repair=False, poses={"ground": True},
               person={"frames": 3, "annealing": [2.0]}) == 0
    assert "Ball taken for props beside people and left out" in capsys.readouterr().err
    assert {p.name for p in out.iterdir() if p.is_dir() and p.name[0] != "."} == {"Ann", "Bob"}
    assert json.loads((out / "report.json").read_text())["settings"]["mosh"]["poses"]["ground"] is True
    truth = np.load(place / "truth.npz")
    for who, take, shift in (("Ann", "walk", 0.0), ("Bob", "jump", 2.0)):
        assert {"subject.json", "layout.json", "report.html"} <= {p.name for p in (out / who).iterdir()}
        motion = Motion.load(out / who / "two" / "motion.npz")
        body = motion.vertices(worm_with_prior().subject(motion.betas)) - [shift, 0, 0]
        assert np.linalg.norm(body - truth[take][some], axis=2).mean() < 0.03


def names(actors):
    return {actor.name: [r.name for r in actor.recordings] for actor in actors}


def empty(*paths):
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("")


def test_who_is_who(tmp_path):
    labelled = MarkerSequence(np.zeros((2, 2, 3)) + 1, ("Eve:A", "Eve:B"), 10.0)
    both = MarkerSequence(np.zeros((2, 2, 3)) + 1, ("Eve:A", "Adam:A"), 10.0)
    write_markers(tmp_path / "walk.c3d", labelled)
    write_markers(tmp_path / "dance.c3d", both)
    empty(*(tmp_path / name for name in ("85_02.csv", "85_03.csv", ".hidden.csv", "zoe/1.csv", "zoe/day/1.csv",
                                         "zoe/1.trc", "notes.txt")))
    found = find_actors([tmp_path])
    assert names(found) == {"85_02": ["85_02"], "85_03": ["85_03"], "walk": ["walk"], "Eve": ["dance"],
                            "Adam": ["dance"], "zoe": ["1.csv", "1.trc", "day_1"]}
    assert {a.name: a.recordings[0].who for a in found} == dict.fromkeys(names(found)) | {"Eve": "Eve", "Adam": "Adam"}
    one = {"Eve": ["dance"], "Adam": ["dance"]}                             # a file by itself as in a folder
    assert names(find_actors([tmp_path / "dance.c3d"])) == one
    assert names(find_actors([tmp_path / "dance.c3d"], "Eve")) == {"Eve": ["dance"]}
    table = tmp_path / "who.csv"
    write_grouping(table, find_actors([tmp_path / "dance.c3d"]))
    mended = find_actors([tmp_path / "dance.c3d"], str(table))
    table.unlink()
    assert names(mended) == one and [a.recordings[0].who for a in mended] == ["Adam", "Eve"]
    assert names(find_actors([tmp_path / "85_02.csv", tmp_path / "walk.c3d"])) == {"85_02": ["85_02", "walk"]}
    others = {"85_02", "85_03", "walk", "Eve", "Adam"}
    assert names(find_actors([tmp_path], output=tmp_path / "zoe")).keys() == others
    with pytest.raises(ValueError, match="expected a folder for the output that does not hold the recordings"):
        find_actors([tmp_path], output=tmp_path.parent)
    empty(tmp_path / "zoe" / "subjects.csv", tmp_path / "zoe" / "report.html")      # the output of an earlier call
    assert names(find_actors([tmp_path])).keys() == others


@pytest.mark.parametrize("count, rate, step", [(1, 120, 4), (500, 25, 1), (494, 60, 2), (2751, 120, 4),
                                               (10**5, 120, 50), (10**5 + 1, 25, 51)])
def test_a_page_plays_no_more_frames_than_it_can_carry(count, rate, step):
    motion = Motion(np.zeros((count, 1, 3)), np.zeros((count, 3)), None, rate, np.zeros((count, 0)))
    frames, shown = frames_to_play(motion)
    assert frames[1:2].tolist() == [step][:count - 1] and shown == rate / step and len(frames) <= 2000


@pytest.mark.slow
def test_the_model_of_the_sex_that_the_markers_tell(place, tmp_path):
    model = worm_with_prior()
    model.info["sex_plane"] = SexPlane(np.array([1.0, 0, 0]), 0.0, 40, 5.0).to_arrays()
    model.save(tmp_path / "neutral.npz")
    shutil.copytree(place / "people", tmp_path / "people", ignore=shutil.ignore_patterns("walk.csv"))
    shutil.copy(tmp_path / "neutral.npz", tmp_path / "model.npz")
    shutil.copy(place / "layout.json", tmp_path / "layout.json")
    assert run(tmp_path, tmp_path / "people", "-m", place / "model.npz", "-m", place / "model.npz",
               "-o", tmp_path / "out", soft_tissue=False) == 0
    for person, take, sex in (("ann", "run", "male"), ("bob", "jump", "female")):
        assert told(tmp_path / "out" / person)["sex"].startswith(f"{sex} (")
        assert json.loads((tmp_path / "out" / person / "subject.json").read_text())["sex"]["sex"] == sex
        assert Motion.load(tmp_path / "out" / person / take / "motion.npz").gender == sex


@pytest.mark.parametrize("words, message", [
    (("-m", "layout.json"), "--model: expected one, or three of both sexes, of women and of men, got 2"),
    (("-m", "layout.json", "-m", "layout.json", "--character", "layout.json"),
     "--character: a character is made of one model"),
    (("--subjects", "no.csv"), "no.csv: no such file"), (("--subjects", "nobody"), "--subjects: expected a file"),
])
def test_wrong_words_are_one_line(place, tmp_path, capsys, words, message):
    words = [place / word if word == "layout.json" else word for word in words]         # any file that there is
    code = run(place, place / "people" / "bob" / "jump.csv", "-o", tmp_path / "out", *words)
    assert code == (2 if message.startswith("--") else 1)
    assert message in capsys.readouterr().err
