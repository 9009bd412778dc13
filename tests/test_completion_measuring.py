"""`scape measure`: sets, completions, betas and meshes in, a table and a page out; the body of some measurements."""
import csv
import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from people_bodies import kept, small_people

from completion.__main__ import main
from completion.measuring import template
from completion.measuring.bodies import read_bodies
from completion.partial.completion import Completion
from model import find_tapes, measure
from model.measurement.catalogue import CATALOGUE
from model.measurement.survey import ordinal, percentiles
from scanprep import Mesh, RegisteredSet, read_mesh, write_mesh
from scanprep.decimation.decimate import decimate
from scanprep.geometry.landmark_names import landmark_name, translate_landmarks
from scanprep.judgement import Judgement
from scanprep.synthetic.landmarks import landmarks
from scanprep.synthetic.people import BodyShape, SyntheticPerson


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A model, its template's own body at rest, somebody in a pose, and betas."""
    folder, model = tmp_path_factory.mktemp("measure"), small_people()
    model.save(folder / "model.npz")
    rest = np.zeros((len(model.skeleton.parents), 3))
    bent = rest.copy()
    bent[4, 1], bent[7, 1], bent[11, 0] = 1.1, -1.1, 0.9
    for name, vertices in (("rest", model.vertices(rest)), ("bent", model.vertices(bent))):
        write_mesh(folder / "bodies" / f"{name}.ply", model.template.with_vertices(vertices))
    (folder / "somebody.json").write_text(json.dumps({"betas": [0.8, -0.5]}))
    (folder / "people" / "anna").mkdir(parents=True)                       # as scape mosh writes them
    (folder / "people" / "anna" / "subject.json").write_text(json.dumps({"betas": [0.8, -0.5], "layout": "cmu41"}))
    (folder / "marks.json").write_text(json.dumps(model.info["landmarks"]))
    return folder


def scape(*words):
    return main(["measure", *map(str, words)])


def table(path):
    """Rows of a table by the name of the body."""
    with path.open(encoding="utf-8") as lines:
        return {row["body"]: row for row in csv.DictReader(lines)}


@pytest.mark.slow
def test_a_folder_and_betas_with_their_model(folder, tmp_path, capsys):
    """A bent body is measured as it stands upright; the page and the report are there, the values those of Python."""
    assert scape(folder / "bodies", folder / "somebody.json", folder / "people", "-m", folder / "model.npz", "-o",
                 tmp_path / "all.csv") == 0
    rows, model = table(tmp_path / "all.csv"), small_people()
    assert list(rows) == ["bent", "rest", "somebody", "anna"]
    assert list(rows["anna"].values())[1:] == list(rows["somebody"].values())[1:]
    assert list(rows["rest"])[:3] == ["body", "stature", "neck_height"] and len(rows["rest"]) == 2 + 2 * len(CATALOGUE)
    tapes = find_tapes(model.template, model.info["landmarks"])
    true = measure(model.vertices(np.zeros((16, 3))), tapes, tapes.axes).values
    as_it_is = measure(read_mesh(folder / "bodies" / "bent.ply"), tapes, tapes.axes).values
    for name in ("stature", "waist_girth", "upper_arm_girth_left", "knee_girth_left"):
        assert float(rows["rest"][name]) == pytest.approx(true[name], abs=0.003), name
    for name in ("stature", "chest_girth", "hip_girth", "knee_girth_left"):              # measured upright
        assert float(rows["bent"][name]) == pytest.approx(true[name], abs=0.006), name
    for name in ("calf_girth_left", "upper_arm_girth_left"):                             # and as the limb is
        assert float(rows["bent"][name]) == pytest.approx(as_it_is[name], abs=0.001), name
    errors = [float(rows[name][f"{c}_error"]) for name in ("rest", "bent") for c in CATALOGUE]
    assert min(errors) > 0 and float(rows["bent"]["hip_girth_error"]) > float(rows["rest"]["hip_girth_error"])
    page = (tmp_path / "all.html").read_text(encoding="utf-8")
    assert "4 bodies, measured" in page and "back waist length, ISO 8559-1" in page
    report = (tmp_path / "all.csv.report.json").read_text(encoding="utf-8")
    assert "NaN" not in report and json.loads(report)["judgement"]["verdict"] == "good"


TAPES = ("stature", "chest_girth", "hip_girth", "thigh_girth_left", "calf_girth_right", "foot_length_left")


@pytest.mark.slow
def test_a_model_with_the_ten_landmarks_of_the_readme_is_measured(folder, tmp_path, capsys):
    """Heels, crotch and all that is not among them are found; they were refused before."""
    model = small_people()
    known = translate_landmarks(model.info["landmarks"])
    readme = {name: known[landmark_name(name)] for name in (
        "crown", "navel", "LeftHand", "RightHand", "foot_l", "foot_r", "left elbow", "right elbow", "l_knee", "r_knee")}
    replace(model, info={**model.info, "landmarks": readme}).save(tmp_path / "ten.npz")
    for name in ("ten", "model"):
        path = (tmp_path if name == "ten" else folder) / f"{name}.npz"
        assert scape(folder / "bodies" / "rest.ply", "-m", path, "-o", tmp_path / f"{name}.csv") == 0
        assert ("found by laying the built-in people on it" in capsys.readouterr().err) == (name == "ten")
    ten, full = (table(tmp_path / f"{name}.csv")["rest"] for name in ("ten", "model"))
    for name in TAPES:
        assert float(ten[name]) == pytest.approx(float(full[name]), abs=0.012), name


def test_a_registered_half_view_is_less_known_than_a_whole_scan(tmp_path):
    """By the share of the surface that `registration.csv` says has data; four views leave 15% without."""
    person = SyntheticPerson().mesh
    bodies = RegisteredSet.create(tmp_path / "set", person).add("whole", person).add("half", person)
    bodies.add("unknown", person)
    (tmp_path / "set" / "registration.csv").write_text(
        "name,init,distance,rms,seen,confidence,missed,stretch,landmarks,inverted,converged\n"
        "half,model people,0.001,0.001,0.35,0.3,0,0,none,0,True\n"
        "whole,model people,0.001,0.001,0.9,0.9,0,0,none,0,True\n")
    error = {body.name: body.expected_error for body in read_bodies([tmp_path / "set"], None, None)}
    assert all(values.shape == (len(person.vertices),) and np.ptp(values) == 0 for values in error.values())
    assert error["whole"][0] == error["unknown"][0] == 0.0015 and 0.008 < error["half"][0] < 0.0125


def test_what_is_no_person_has_no_landmarks_to_measure_from(tmp_path, capsys):
    ball = trimesh.creation.icosphere(4, 0.5)
    write_mesh(tmp_path / "ball.ply", Mesh(ball.vertices, ball.faces))
    assert scape(tmp_path / "ball.ply", "-o", tmp_path / "m.csv") == 1
    assert "measuring begins at landmarks of the template, and there are none" in capsys.readouterr().err


@pytest.mark.slow
def test_a_completion_states_errors(folder, tmp_path):
    """Those that expected errors of its vertices imply; its report names the model."""
    model, person = small_people(), SyntheticPerson(BodyShape("male", (0.1,)))
    body = model.template.with_vertices(person.mesh.vertices[kept()])
    n = len(body.vertices)
    done = Completion(body, body, np.zeros((16, 3)), np.zeros(4), np.zeros(3), np.ones(n, bool), 0.001, 1.0, 0.001,
                      True, 3, expected_error=np.full(n, 0.004), judgement=Judgement())
    done.save(tmp_path / "whole")
    (tmp_path / "whole" / "report.json").write_text(json.dumps({"settings": {"model": str(folder / "model.npz")}}))
    assert scape(tmp_path / "whole", "-o", tmp_path / "m.csv") == 0
    row = table(tmp_path / "m.csv")["whole"]
    assert 0.0005 < float(row["waist_girth_error"]) < 0.02
    assert abs(float(row["stature"]) - person.anatomy.stature) < 0.01


@pytest.mark.slow
def test_the_body_of_some_measurements(folder, tmp_path, capsys):
    """It has them, and its betas are a subject of other commands."""
    assert scape("-m", folder / "model.npz", "--to", "stature=1.72", "waist=0.82", "-o", tmp_path / "body.ply") == 0
    assert scape(tmp_path / "body.ply", tmp_path / "body.betas.json", "-m", folder / "model.npz", "-o",
                 tmp_path / "m.csv") == 0
    with (tmp_path / "m.csv").open() as lines:
        for row in csv.DictReader(lines):
            assert float(row["stature"]) == pytest.approx(1.72, abs=0.003)
            assert float(row["waist_girth"]) == pytest.approx(0.82, abs=0.003)
    assert (tmp_path / "body.html").exists()


@pytest.mark.parametrize(("words", "told"), [
    (["-m", "model.npz", "--to", "stature=180", "-o", "b.ply"], "stature=180: expected 1.2 to 2.4 m, which people "
     "measure there; it is in metres: did you mean stature=1.8, which is 180 centimetres?"),
    (["-m", "model.npz", "--to", "weight=78000", "-o", "b.ply"], "weight=78000: expected 25 to 300 kg, which people "
     "weigh; it is in kilograms: did you mean weight=78, which is 78000 grams?"),
    (["-m", "model.npz", "--to", "stature=2.7", "-o", "b.ply"], "people measure there; the nearest is stature=2.4"),
    (["-m", "model.npz", "--to", "stature=1.8", "--sex", "male", "-o", "b.ply"], "the model does not tell women from "
     "men, so it has no men; leave it out, or take the built-in model, which is named people"),
    (["-m", "model.npz", "--to", "waist", "-o", "b.ply"], "--to: expected name=metres, such as waist=0.85, got waist"),
    (["-m", "model.npz", "--to", "shoe=1", "-o", "b.ply"], "no measurement 'shoe'; there are: stature"),
    (["bodies", "-m", "model.npz", "--to", "waist=0.8", "-o", "b.ply"], "--to makes a body from measurements"),
    (["-o", "m.csv"], "BODY: expected at least one body to measure"),
    (["nowhere", "-o", "m.csv"], "nowhere: no such file or folder"),
    (["bodies", "-o", "m.xlsx"], "expected the name of a table, such as measures.csv"),
    (["bodies", "--landmarks", "marks.json", "-o", "m.csv"], "bodies/bent.ply: it is the template of all bodies, as no "
     "model is named, and does not stand upright: the left shin is "),
    (["somebody.json", "-o", "m.csv"], "somebody.json: betas need their model; name it with -m")])
def test_one_line_for_what_is_wrong(folder, monkeypatch, capsys, words, told):
    monkeypatch.chdir(folder)
    monkeypatch.setattr(template, "lay_people", lambda mesh: None)                # a template of which nothing is known
    before = sorted(p.name for p in folder.iterdir())
    assert scape(*words) == (2 if told.startswith("--to") else 1)
    said = capsys.readouterr().err.strip().splitlines()
    assert told in said[-1] and len(said) == 1
    assert sorted(p.name for p in folder.iterdir()) == before


def test_other_triangles_are_refused(folder, tmp_path, capsys):
    write_mesh(tmp_path / "other.ply", SyntheticPerson().mesh)
    assert scape(folder / "bodies" / "rest.ply", tmp_path / "other.ply", "--landmarks", folder / "marks.json", "-o",
                 tmp_path / "m.csv") == 1
    assert "expected the triangles of" in capsys.readouterr().err


@pytest.mark.slow
def test_a_wrong_unit_is_told(folder, tmp_path, capsys):
    """A body of 17 m means nothing."""
    model = small_people()
    write_mesh(tmp_path / "giant.ply", model.template.with_vertices(10 * model.vertices(np.zeros((16, 3)))))
    assert scape(tmp_path / "giant.ply", "--landmarks", folder / "marks.json", "-o", tmp_path / "m.csv") == 1
    assert "giant: no person measures so, stature" in capsys.readouterr().err


@pytest.mark.slow
def test_a_hole_leaves_a_cell_empty(folder, tmp_path, capsys):
    """The row says why, and no NaN is anywhere."""
    model = small_people()
    body = model.template.with_vertices(model.vertices(np.zeros((16, 3))))
    tapes = find_tapes(model.template, model.info["landmarks"])
    calf = np.unique(tapes.found["calf_girth_left"].ring.edges[:2])
    opened = type(body)(body.vertices, body.faces[~np.isin(body.faces, calf).any(axis=1)])
    write_mesh(tmp_path / "open.ply", opened)
    assert scape(tmp_path / "open.ply", "--landmarks", folder / "marks.json", "-o", tmp_path / "m.csv") == 0
    row = table(tmp_path / "m.csv")["open"]
    assert row["calf_girth_left"] == "" and "calf_girth_left: a hole of the template crosses it" in row["note"]
    assert row["waist_girth"] != "" and "nan" not in (tmp_path / "m.csv").read_text().lower()
    said = capsys.readouterr().err
    assert "LOOK AT THE RESULT: open: no calf girth left, a hole" in said, said


@pytest.mark.slow
def test_percentiles_of_a_sex_and_the_weight_of_a_closed_body(folder, tmp_path, capsys):
    """985 kg in a cubic metre, give or take 2%; an open one has none, and is good all the same."""
    model = small_people()
    body = model.template.with_vertices(model.vertices(np.zeros((16, 3))))
    assert scape(folder / "bodies" / "rest.ply", "-m", folder / "model.npz", "--sex", "male", "-o",
                 tmp_path / "m.csv") == 0
    row = table(tmp_path / "m.csv")["rest"]
    assert float(row["weight"]) == pytest.approx(985 * body.volume, abs=0.05)
    spread, skin = 0.02 * float(row["weight"]), 985 * body.face_areas.sum() * 0.0015 / np.sqrt(3)  # all skin 1.5 mm off
    assert spread < float(row["weight_error"]) < np.hypot(spread, skin)
    assert float(row["weight_percentile"]) == pytest.approx(
        percentiles({"weight": float(row["weight"])}, "male")["weight"], abs=0.1)
    true = percentiles({"stature": float(row["stature"])}, "male")
    assert float(row["stature_percentile"]) == pytest.approx(true["stature"], abs=0.3)
    assert "knee_girth_left_percentile" not in row, "the survey has none"
    assert "of men" in capsys.readouterr().out
    page = (tmp_path / "m.html").read_text(encoding="utf-8")
    assert f"({ordinal(true['stature'])})" in page and "4,082 men of ANSUR II" in page
    crown = int(body.vertices[:, 2].argmax())
    write_mesh(tmp_path / "bald.ply", type(body)(body.vertices, body.faces[~(body.faces == crown).any(axis=1)]))
    capsys.readouterr()
    assert scape(tmp_path / "bald.ply", "--landmarks", folder / "marks.json", "-o", tmp_path / "o.csv") == 0
    row = table(tmp_path / "o.csv")["bald"]
    assert row["weight"] == "" and "weight: the template is open" in row["note"]
    assert "LOOK AT" not in capsys.readouterr().err


@pytest.mark.slow
def test_the_most_probable_man_and_what_is_likely_of_him(tmp_path, capsys):
    """The body has what was asked for; of the rest the table, the page, the betas and the report tell the range."""
    assert scape("--to", "stature=1.80", "weight=78", "--sex", "male", "-o", tmp_path / "he.ply") == 0
    said = capsys.readouterr()
    assert "LOOK" not in said.err and "of men" in said.out and "waist girth, likely" in said.out
    kept = json.loads((tmp_path / "he.betas.json").read_text())
    low, value, high = kept["likely"]["waist_girth"]
    assert kept["sex"] == "male" and low < value < high and 0.08 < high - low < 0.2
    assert kept["measurements"]["weight"] == pytest.approx(78, abs=0.02) and "weight" not in kept["likely"]
    page = (tmp_path / "he.html").read_text(encoding="utf-8")
    assert "What was not asked for" in page and "78.0\u00a0kg" in page.replace(" kg", "\u00a0kg")
    assert "wrist girth left, likely " in (tmp_path / "he.ply.report.json").read_text(encoding="utf-8")


@pytest.mark.slow
def test_nobody_said_the_sex(tmp_path, capsys):
    """The more probable one is taken and told, and how to name it."""
    assert scape("--to", "stature=1.58", "hip=1.05", "-o", tmp_path / "she.ply") == 0
    said = capsys.readouterr()
    assert "female (" in said.out and "name it with --sex" in said.err
    assert json.loads((tmp_path / "she.betas.json").read_text())["sex"] == "female"


@pytest.mark.slow
@pytest.mark.parametrize(("words", "told"), [
    (("waist=0.6", "hip=1.4"), "hip girth 1,400 mm fits least: most women with the other measurements have"),
    (("stature=1.5", "weight=200"), "weight 200.0 kg fits least: most women with the other measurements have"),
    (("stature=2.35",), "stature 2,350 mm fits least: most women have")])
def test_measures_that_contradict_each_other_or_everybody(tmp_path, capsys, words, told):
    """To be looked at, with what was reached and what people have."""
    assert scape("--to", *words, "--sex", "female", "-o", tmp_path / "b.ply") == 0
    said = capsys.readouterr().err
    assert "LOOK AT THE RESULT" in said and told in said and "the measurements contradict each other" in said


@pytest.mark.slow
@pytest.mark.parametrize(("sex", "weight"), [("male", 0.0), ("female", 3.0)])
def test_a_lone_body_of_foreign_triangles_is_measured(tmp_path, sex, weight):
    """Nobody named a landmark: tapes lie where they lie on the same body in triangles that are known, also if fat."""
    person = SyntheticPerson(BodyShape.like(sex, weight=weight)).mesh
    remeshed = decimate(person, 24000)
    order = np.random.default_rng(1).permutation(len(remeshed.vertices))
    write_mesh(tmp_path / "body.ply", Mesh(remeshed.vertices[order], np.argsort(order)[remeshed.faces]))
    assert scape(tmp_path / "body.ply", "-o", tmp_path / "m.csv") == 0
    row, true = table(tmp_path / "m.csv")["body"], measure(person, find_tapes(person, landmarks())).values
    report = json.loads((tmp_path / "m.csv.report.json").read_text(encoding="utf-8"))
    assert report["judgement"]["verdict"] == "good" and row["note"] == ""
    for name in (*TAPES, "waist_girth", "waist_height", "head_girth", "neck_girth"):
        error = float(row[f"{name}_error"])
        assert 0 < error < 0.03 and abs(float(row[name]) - true[name]) < max(2 * error, 0.004), name
