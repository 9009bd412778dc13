"""`scape layout`: what is listed, shown and carried, and what is refused in one line."""
import json
from dataclasses import replace

import numpy as np
import pytest
from people_bodies import small_people

from completion.__main__ import main
from completion.mocap.marker_sets import pictures
from completion.mocap.marker_sets.layout import MarkerLayout
from completion.mocap.marker_sets.named import layout_names, load_layout, read_layout
from completion.mocap.marker_sets.opensim import opensim_markers
from model.fitting.bodies import at_rest
from scanprep import read_mesh, write_landmarks, write_mesh
from scanprep.geometry.landmark_reading import read_marker_set
from scanprep.synthetic.people import SyntheticPerson


@pytest.fixture(autouse=True)
def small_pictures(monkeypatch):
    monkeypatch.setattr(pictures, "HEIGHT", 150)


@pytest.fixture(scope="module")
def person():
    return SyntheticPerson()


def test_the_sets_are_listed_with_their_bodies(capsys):
    assert main(["layout", "list"]) == 0
    said = capsys.readouterr().out
    assert all(name in said for name in layout_names()) and "SCAPE and SPRING" in said.replace("\n", " ")


def test_a_layout_is_shown_on_a_mesh_and_can_be_used_again(tmp_path, person):
    write_mesh(tmp_path / "body.ply", person.mesh)
    assert main(["layout", "show", "vicon47", "--body", str(tmp_path / "body.ply"), "-o", str(tmp_path / "out")]) == 0
    page = (tmp_path / "out" / "report.html").read_text()
    layout = MarkerLayout.load(tmp_path / "out" / "layout.json", 12500)
    assert all(label in page for label in layout.labels) and (tmp_path / "out" / "layout.png").stat().st_size > 5_000
    figures = {m["metric"]: m["value"] for m in json.loads((tmp_path / "out" / "report.json").read_text())["metrics"]}
    assert (figures["markers"], figures["pairs of left and right"], figures["without a side"]) == (47, 21, 5)
    named = load_layout("vicon47", person.mesh)
    assert set(zip(layout.labels, layout.vertices.tolist(), strict=True)) == \
        set(zip(named.labels, named.vertices.tolist(), strict=True))


def test_a_layout_is_shown_on_a_model(tmp_path):
    small_people().save(tmp_path / "model.npz")
    assert main(["layout", "show", "mosh67", "-m", str(tmp_path / "model.npz"), "-o", str(tmp_path / "out")]) == 0
    assert len(MarkerLayout.load(tmp_path / "out" / "layout.json").labels) == 67
    assert "upper_arm" in (tmp_path / "out" / "report.html").read_text()
    file = tmp_path / "out" / "markerset.xml"
    assert len(read_marker_set(file, file.read_bytes())) == 67


STRANGE_LABELS = ("two\nlines", "bell\x07", "a$b$\\frac{", "=1+1", "-x", " ", "<b>", "\u202eback", "'")


def test_labels_that_no_line_can_hold_are_shown(tmp_path, person):
    write_mesh(tmp_path / "body.ply", person.mesh)
    layout = load_layout("vicon47", person.mesh)
    names = dict(zip(layout.labels, STRANGE_LABELS, strict=False))
    layout = MarkerLayout(tuple(names.get(label, label) for label in layout.labels), layout.vertices, layout.distances)
    layout.save(tmp_path / "mine.json")
    assert main(["layout", "show", str(tmp_path / "mine.json"), "--body", str(tmp_path / "body.ply"),
                 "-o", str(tmp_path / "out")]) == 0
    assert MarkerLayout.load(tmp_path / "out" / "layout.json", 12500).labels == layout.labels
    assert "&lt;b&gt;" in (tmp_path / "out" / "report.html").read_text()


# places in the marker set of OpenSim's model gait2392, metres, of markers that sit on the same bones
GAIT2392 = {"RFWT": ("pelvis", (0.02, 0.03, 0.128)), "LFWT": ("pelvis", (0.02, 0.03, -0.128)),
            "RKNE": ("femur_r", (0.0, -0.404, 0.05)), "RANK": ("tibia_r", (-0.005, -0.41, 0.053)),
            "RHEE": ("calcn_r", (-0.02, 0.02, 0.0))}


def test_markers_are_on_the_bodies_of_opensim():
    """Near those of its own model; by frames in which every marker of the body is again where it was."""
    model = small_people()
    body = at_rest(model)
    skeleton = replace(model.skeleton, joints=model.skeleton.joint_regressor(model.template) @ body.vertices)
    layout = read_layout("cmu41", body, np.array(model.info["people_vertices"]))
    found = opensim_markers(layout, body, skeleton)
    assert list(found) == list(layout.labels)
    for label, (name, place) in GAIT2392.items():
        assert found[label][0] == f"/bodyset/{name}"
        assert np.linalg.norm(found[label][1] - place) < 0.05, (label, found[label])
    places = dict(zip(layout.labels, layout.place(body), strict=True))
    for side in "RL":                               # distances between markers of one body are kept
        shin, ankle = f"{side}SHN", f"{side}ANK"
        assert found[shin][0] == found[ankle][0]
        apart = np.linalg.norm(found[shin][1] - found[ankle][1])
        assert apart == pytest.approx(np.linalg.norm(places[shin] - places[ankle]))
    with pytest.raises(ValueError, match="person's parts"):
        opensim_markers(layout, body, replace(skeleton, names=tuple(f"part{j}" for j in range(len(skeleton.names)))))


def test_a_transfer_writes_layout_picture_and_registration(tmp_path, person, capsys):
    """On the same triangles nothing moves; landmarks go by name; a layout of one's own needs its mesh."""
    body = person.mesh
    marks = {"toe": 700, "heel": 9, "nose": 5}
    for name, shift, more in (("a", 0.0, {"ear": 8}), ("b", 2.0, {})):
        write_mesh(tmp_path / f"{name}.ply", body.with_vertices(body.vertices + shift))
        write_landmarks(tmp_path / f"{name}.landmarks.json", marks | more)
    out = tmp_path / "b.layout.json"
    assert main(["layout", "transfer", "vicon47", "--source", str(tmp_path / "a.ply"), "--target",
                 str(tmp_path / "b.ply"), "--landmarks", str(tmp_path / "b.landmarks.json"), "-o", str(out)]) == 0
    named = load_layout("vicon47", body)
    found = MarkerLayout.load(out, 12500).select(named.labels)
    np.testing.assert_allclose(found.place(read_mesh(tmp_path / "b.ply")) - 2.0, named.place(body), atol=1e-5)
    assert out.with_suffix(".png").exists() and len(read_mesh(out.with_suffix(".registered.ply")).vertices) == 12500
    told = json.loads((tmp_path / "b.layout.json.report.json").read_text())
    figures = {m["metric"]: m["value"] for m in told["metrics"]}
    assert figures["target not covered"] == 0 and figures["landmarks"] == 3
    assert main(["layout", "transfer", str(out), "--target", str(tmp_path / "b.ply"), "-o", str(tmp_path / "n")]) == 1
    assert "expected the mesh that it is for, --source" in capsys.readouterr().err


BAD = {
    "neither name nor file": ("show nobody --body body.ply -o out", ["nobody", "vicon47"]),
    "another body": ("show vicon47 --body ball.ply -o out", ["vicon47", "12500", "4 vertices"]),
    "a layout of another body": ("show big.json --body ball.ply -o out", ["big.json", "vertex 77"]),
    "a mesh that is not there": ("show vicon47 --body none.ply -o out", ["none.ply", "no such file"]),
    "a body and a model": ("show vicon47 --body body.ply -m body.ply -o out", ["--model", "--body"]),
    "a source of another body": ("transfer vicon47 --source ball.ply --target body.ply -o o.json",
                                 ["vicon47", "4 vertices"]),
    "landmarks that do not match": ("transfer vicon47 --source body.ply --target ball.ply --landmarks far.json "
                                    "-o o.json",
                                    ["expected at least three ends of limbs"]),      # without them, which is noted
    "no landmarks of the source": ("transfer vicon47 --source lonely/body.ply --target ball.ply --landmarks far.json "
                                   "-o o.json", ["body.landmarks.json"]),
    "a damaged layout": ("show broken.json --body body.ply -o out", ["broken.json", "JSON"]),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_gives_one_line(case, tmp_path, person, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_mesh("body.ply", person.mesh)
    write_mesh("lonely/body.ply", person.mesh)
    ball = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    write_mesh("ball.ply", type(person.mesh)(ball, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))
    MarkerLayout(("A",), np.array([77])).save("big.json")
    write_landmarks("body.landmarks.json", {"nose": 5, "heel": 9, "toe": 700})
    write_landmarks("far.json", {"chin": [0.0, 0, 0]})
    (tmp_path / "broken.json").write_text("{oops")
    command, words = BAD[case]
    assert main(["layout", *command.split()]) == (2 if case == "a body and a model" else 1)
    said = [line for line in capsys.readouterr().err.splitlines() if line.strip() and "note:" not in line]
    assert len(said) == 1 and all(word in said[0] for word in words), said
    assert not (tmp_path / "out").exists() and not (tmp_path / "o.json").exists()
