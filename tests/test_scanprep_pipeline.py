"""A folder of scans: resumable, and one bad scan stops no other."""
import dataclasses
import json
import shutil

import numpy as np
import pytest
from scan_folders import MARKS, QUICK, ball, contents, write_scans
from scipy.spatial.transform import Rotation

from scanprep import Mesh, RegisteredSet, read_mesh, write_landmarks, write_mesh
from scanprep.batch.pool import Workers
from scanprep.cleaning.clean_scan import CleanScanConfig
from scanprep.correspondence.correspondences import Correspondences
from scanprep.pipeline.prepare import prepare
from scanprep.pipeline.scans import find_scans
from scanprep.registration import unmarked


@pytest.fixture(name="template", scope="module")
def ball_template():
    return ball()


@pytest.fixture(name="scans")
def three_scans(tmp_path, template):
    return write_scans(tmp_path / "scans", template)


def test_scans_and_what_is_known_of_them(scans):
    tasks = find_scans(scans)
    assert [(t.name, t.subject, t.sex) for t in tasks] == [
        ("body0", "anna", "female"), ("body1", "anna", "female"), ("body2", "ben", "male")]
    assert all(t.landmarks.name == f"{t.name}.landmarks.json" for t in tasks)
    (scans / "scans.csv").unlink()
    assert [t.subject for t in find_scans(scans)] == ["body0", "body1", "body2"]
    assert {t.subject for t in find_scans(scans, subject="carl")} == {"carl"}
    (scans / "cloud.xyz").write_text("0 0 0\n1 0 0\n")
    (scans / "notes.txt").write_text("Tuesday")
    assert [t.name for t in find_scans(scans)] == ["body0", "body1", "body2", "cloud"]


def test_a_landmark_file_without_landmarks_is_as_none(scans):
    (scans / "body0.landmarks.json").write_text("{}")
    (scans / "body1.landmarks.json").write_text("{")                      # damaged: registering the scan reports it
    assert [t.landmarks is None for t in find_scans(scans)] == [True, False, False]


def test_a_scan_of_another_body_is_named(scans, template, tmp_path):
    """Before the skeleton is sought: three registered people were called one."""
    larger = read_mesh(scans / "body1.ply")
    write_mesh(scans / "body1.ply", larger.with_vertices(1.5 * larger.vertices))
    write_landmarks(next(scans.rglob("body1.landmarks.json")), {n: 1.5 * larger.vertices[v] for n, v in MARKS.items()})
    tasks = [dataclasses.replace(task, subject="anna") for task in find_scans(scans)]
    posed = dataclasses.replace(QUICK, min_poses=3)
    with pytest.raises(ValueError, match=r"scans of anna: body1: it is 1\.\d+ times as large as the other bodies"):
        prepare(tasks, template, MARKS, tmp_path / "set", posed)
    assert RegisteredSet.load(tmp_path / "set").names == ("body0", "body1", "body2")


def test_folders_that_cannot_be_meant(scans, tmp_path):
    shutil.copy(scans / "body0.ply", scans / "body0.obj")
    with pytest.raises(ValueError, match=r"body0\.obj and body0\.ply, both of the name 'body0'"):
        find_scans(scans)
    for folder, says in ((tmp_path, "in its folders scans: name one"), (tmp_path / "nowhere", "no such folder")):
        with pytest.raises(ValueError, match=says):
            find_scans(folder)
    (scans / "body0.obj").unlink()
    with pytest.raises(ValueError, match="landmarks: expected a folder"):
        find_scans(scans, tmp_path / "nowhere")


@pytest.mark.parametrize("text, says", [
    ("name,subject\nnobody,anna\n", r"scans\.csv: no scan is called nobody; the scans are called body0, "),
    ("scan,subject\nbody0,anna\n", "line 1: expected the columns name,subject"),
    ("name,subject\nbody0,anna\nbody0,ben\n", "body0 comes twice")])
def test_tables_that_cannot_be_meant(scans, text, says):
    (scans / "scans.csv").write_text(text)
    with pytest.raises(ValueError, match=says):
        find_scans(scans)


def test_registers_all(scans, template, tmp_path):
    calls = []
    done = prepare(find_scans(scans), template, MARKS, tmp_path / "set", QUICK, lambda *a: calls.append(a))
    assert not done.failures and done.registered.names == ("body0", "body1", "body2") and done.fresh == 3
    assert calls[0] == (0, 3) and calls[-1] == (3, 3)
    assert all(f.distance < 0.001 and f.seen > 0.6 and f.missed < 0.01 for f in done.figures)
    assert {f.init for f in done.figures} == {"5 landmarks"}
    assert not (tmp_path / "set" / "limbs.csv").exists()                 # the template is no person
    again = RegisteredSet.load(tmp_path / "set")
    assert again.subjects == ("anna", "ben") and len(again.poses()) == 2
    assert json.loads((tmp_path / "set" / "landmarks.json").read_text()) == MARKS


def test_only_what_has_changed_is_done_again(scans, template, tmp_path):
    prepare(find_scans(scans), template, MARKS, tmp_path / "set", QUICK)
    before = contents(tmp_path / "set")
    marks = json.loads((scans / "body1.landmarks.json").read_text())
    marks["top"][2] += 0.05
    (scans / "body1.landmarks.json").write_text(json.dumps(marks))
    done = prepare(find_scans(scans), template, MARKS, tmp_path / "set", QUICK)
    assert done.fresh == 1
    changed = {name for name, data in contents(tmp_path / "set").items() if data != before[name]}
    assert changed == {"meshes/body1.ply", "pictures/body1.webp", "pictures/body1.scene", "registration.csv",
                       "report.html"}


def test_bad_scans_stop_no_other(scans, template, tmp_path):
    (scans / "body0.ply").write_bytes((scans / "body0.ply").read_bytes()[:-100])
    (scans / "body1.landmarks.json").write_text('{"nose": [0, 0, 0], "ear": [1, 0, 0], "chin": [0, 1, 0]}')
    shutil.copy(scans / "body2.ply", scans / "broken.ply")
    (scans / "broken.landmarks.json").write_text("{")
    done = prepare(find_scans(scans), template, MARKS, tmp_path / "set", QUICK)
    assert done.registered.names == ("body2",)
    assert len(done.failures) == 3 and all("\n" not in line for line in done.failures)
    joined = " | ".join(sorted(done.failures))
    assert "body0.ply" in joined and "body1" in joined and "broken.landmarks.json" in joined, joined
    write_scans(scans, template)                       # mended; the fourth is taken away
    (scans / "broken.ply").unlink()
    again = prepare(find_scans(scans), template, MARKS, tmp_path / "set", QUICK)
    assert not again.failures and again.fresh == 2 and not (tmp_path / "set" / "failures.csv").exists()


def test_a_scan_in_another_unit_is_refused_at_once(scans, template, tmp_path):
    for name, factor in (("body0", 3000), ("body1", 0.001)):             # no person in any unit
        body = read_mesh(scans / f"{name}.ply")
        write_mesh(scans / f"{name}.ply", body.with_vertices(factor * body.vertices))
    with pytest.warns(UserWarning, match="when read as metres"):
        done = prepare(find_scans(scans), template, MARKS, tmp_path / "set", QUICK)
    assert done.registered.names == ("body2",)
    assert "e+03 times as large as the body: the wrong unit?" in done.failures[0]
    assert "body1.ply: it is 0.00" in done.failures[1]


def test_what_leads_the_template(scans, template, tmp_path):
    (scans / "body0.landmarks.json").unlink()
    pose = dataclasses.replace(QUICK, scan=dataclasses.replace(QUICK.scan, through="pose"))
    tasks = find_scans(scans)[:2]
    best = prepare(tasks, template, MARKS, tmp_path / "best", QUICK)
    assert best.registered.names == ("body1",) and "landmarks beside the scan" in best.failures[0]     # it has no limbs
    assert not any(task.landmarks for task in find_scans(scans, "none"))
    near = prepare(tasks, template, MARKS, tmp_path / "near", pose)
    assert [f.init for f in near.figures] == ["pose", "pose"] and np.isnan(near.figures[0].landmarks)


def test_correspondences_lead_where_there_are_no_landmarks(scans, template, tmp_path, monkeypatch):
    """A scan upside down, which its pose alone cannot lead to; how correspondences are found has tests of its own."""
    turned = template.with_vertices(template.vertices @ Rotation.from_rotvec([2.0, 0, 0]).as_matrix().T)
    write_mesh(scans / "body0.ply", turned)
    (scans / "body0.landmarks.json").unlink()
    some = np.arange(0, 642, 30)
    pairs = Correspondences(some, turned.vertices[some], np.ones(len(some)))
    monkeypatch.setattr(unmarked, "find_seeds", lambda *args: pairs)
    monkeypatch.setattr(unmarked, "find_correspondences", lambda *args: pairs)
    done = prepare(find_scans(scans)[:2], template, MARKS, tmp_path / "set", QUICK)
    assert [f.init for f in done.figures] == ["22 correspondences", "5 landmarks"]
    found = done.registered.vertices(["body0"])[0]
    assert np.linalg.norm(found - turned.vertices, axis=1).max() < 0.05


def test_clutter_is_cleaned_off_when_asked(scans, template, tmp_path):
    body = read_mesh(scans / "body0.ply")
    chair = body.with_vertices(body.vertices * 0.2 + [2, 2, 2])
    write_mesh(scans / "body0.ply", Mesh(np.vstack([body.vertices, chair.vertices]),
                                         np.vstack([body.faces, chair.faces + 642])))
    asked = dataclasses.replace(QUICK, scan=dataclasses.replace(QUICK.scan, clean=CleanScanConfig()))
    plain = prepare(find_scans(scans)[:1], template, MARKS, tmp_path / "plain", QUICK).figures[0]
    clean = prepare(find_scans(scans)[:1], template, MARKS, tmp_path / "clean", asked).figures[0]
    assert (plain.removed, clean.removed) == (0, 0.5)
    # a fifth as large, the chair has a twenty-fifth of the surface
    assert plain.missed == pytest.approx(0.04 / 1.04, abs=0.002) and clean.missed == 0


@pytest.mark.slow
def test_other_settings_or_template_do_all_anew(scans, template, tmp_path):
    tasks = find_scans(scans)[:2]
    prepare(tasks, template, MARKS, tmp_path / "set", QUICK)
    clean = dataclasses.replace(QUICK, scan=dataclasses.replace(QUICK.scan, clean=CleanScanConfig()))
    assert prepare(tasks, template, MARKS, tmp_path / "set", clean).fresh == 2
    wider = template.with_vertices(1.05 * template.vertices)
    assert prepare(tasks, wider, MARKS, tmp_path / "set", clean).fresh == 2
    moved = {**MARKS, "left": int(np.linalg.norm(wider.vertices - wider.vertices[MARKS["left"]], axis=1).argsort()[1])}
    assert prepare(tasks, wider, moved, tmp_path / "set", clean).fresh == 2
    prepare(tasks, wider, moved, tmp_path / "fresh", clean)
    assert contents(tmp_path / "set") == {name: data.replace(b"Scans of fresh", b"Scans of set")
                                          for name, data in contents(tmp_path / "fresh").items()}
    with pytest.raises(ValueError, match="1 other scans that were registered with another template"):
        prepare(tasks[:1], template, MARKS, tmp_path / "set", clean)


def test_a_table_that_was_corrected_registers_nothing_anew(scans, template, tmp_path):
    prepare(find_scans(scans), template, MARKS, tmp_path / "set", QUICK)
    (scans / "scans.csv").write_text("name,subject,sex\nbody0,zoe,female\n")
    done = prepare(find_scans(scans), template, MARKS, tmp_path / "set", QUICK)
    assert done.fresh == 0 and done.registered.entries[0].subject == "zoe"


@pytest.mark.slow
def test_relative_paths_from_another_folder(scans, template, tmp_path, monkeypatch):
    """Processes are kept from one call to the next, and were started elsewhere."""
    monkeypatch.chdir(tmp_path)
    two = dataclasses.replace(QUICK, workers=Workers(2))
    assert not prepare(find_scans("scans"), template, MARKS, "set", two).failures
    (tmp_path / "elsewhere").mkdir()
    shutil.move(tmp_path / "scans", tmp_path / "elsewhere" / "scans")
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert not prepare(find_scans("scans"), template, MARKS, "set", two).failures
