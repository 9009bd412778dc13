"""A folder of scans: resumable, one bad scan stops no other, and the workers change nothing."""
import dataclasses
import json
import shutil

import igl
import numpy as np
import pytest

from scanprep import Mesh, RegisteredSet, write_landmarks, write_mesh
from scanprep.matching.nonrigid import GraphStage, RegistrationConfig, ShellStage
from scanprep.pipeline import PrepareConfig, ScanSettings, find_scans, prepare

MARKS = {"top": 0, "left": 1, "right": 2, "front": 3, "back": 4}
QUICK = PrepareConfig(ScanSettings(RegistrationConfig(
    graph=(GraphStage(40, 0.35, 0.035, 0.7, 0.01, 0.2, slide=0.3, rounds=2),),
    shell=(ShellStage(0.02, 0.007, 0.0002, 0.05),))), min_poses=99, workers=1)


@pytest.fixture(scope="module")
def template():
    vertices, faces = igl.icosahedron()
    vertices, faces = igl.upsample(vertices, faces.astype(np.int64), 3)
    vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    return Mesh(vertices * [0.3, 0.2, 0.9], faces)


@pytest.fixture
def scans(tmp_path, template):
    folder = tmp_path / "scans"
    rng = np.random.default_rng(1)
    for k in range(3):
        body = template.with_vertices(template.vertices * (1 + 0.1 * rng.normal(size=3)) + rng.normal(size=3))
        write_mesh(folder / f"body{k}.ply", body)
        write_landmarks(folder / f"body{k}.landmarks.json", {name: body.vertices[v] for name, v in MARKS.items()})
    (folder / "scans.csv").write_text("name,subject,sex\nbody0,anna,female\nbody1,anna,female\nbody2,ben,male\n")
    return folder


def test_scans_and_what_is_known_of_them(scans):
    tasks = find_scans(scans)
    assert [(t.name, t.subject, t.sex) for t in tasks] == [
        ("body0", "anna", "female"), ("body1", "anna", "female"), ("body2", "ben", "male")]
    assert all(t.landmarks.name == f"{t.name}.landmarks.json" for t in tasks)
    (scans / "scans.csv").unlink()
    assert [t.subject for t in find_scans(scans)] == ["body0", "body1", "body2"]
    assert {t.subject for t in find_scans(scans, subject="carl")} == {"carl"}


def test_table_that_names_no_scan(scans):
    (scans / "scans.csv").write_text("name,subject\nnobody,anna\n")
    with pytest.raises(ValueError, match=r"scans\.csv: no scan is called nobody"):
        find_scans(scans)
    (scans / "scans.csv").write_text("scan,subject\nbody0,anna\n")
    with pytest.raises(ValueError, match="expected a column 'name'"):
        find_scans(scans)


def test_registers_all(scans, template, tmp_path):
    calls = []
    done = prepare(find_scans(scans), template, MARKS, tmp_path / "set", QUICK, lambda *a: calls.append(a))
    assert not done.failures and done.registered.names == ("body0", "body1", "body2")
    assert calls[0] == (0, 3) and calls[-1] == (3, 3)
    assert all(f.distance < 0.01 and f.seen > 0.9 for f in done.figures)
    again = RegisteredSet.load(tmp_path / "set")
    assert again.subjects == ("anna", "ben") and len(again.poses()) == 2
    assert json.loads((tmp_path / "set" / "landmarks.json").read_text()) == MARKS


def test_goes_on_and_does_nothing_twice(scans, template, tmp_path):
    tasks = find_scans(scans)
    prepare(tasks[:2], template, MARKS, tmp_path / "set", QUICK)
    written = {p: p.stat().st_mtime_ns for p in (tmp_path / "set" / "meshes").iterdir()}
    done = prepare(tasks, template, MARKS, tmp_path / "set", QUICK)
    assert len(done.figures) == 3
    assert all(p.stat().st_mtime_ns == t for p, t in written.items())
    assert not [p for p in (tmp_path / "set").rglob("*") if ".part" in p.name]


def test_interrupted_keeps_what_was_done(scans, template, tmp_path):
    def stop(done, total):
        if done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        prepare(find_scans(scans), template, MARKS, tmp_path / "set", QUICK, stop)
    assert len(RegisteredSet.load(tmp_path / "set").entries) == 1
    done = prepare(find_scans(scans), template, MARKS, tmp_path / "set", QUICK)
    assert len(done.figures) == 3


def test_workers_change_nothing(scans, template, tmp_path):
    one = prepare(find_scans(scans), template, MARKS, tmp_path / "one", QUICK)
    two = prepare(find_scans(scans), template, MARKS, tmp_path / "two", dataclasses.replace(QUICK, workers=2))
    for name in one.registered.names:
        np.testing.assert_allclose(one.registered.vertices([name]), two.registered.vertices([name]), atol=1e-9)


def test_bad_scans_stop_no_other(scans, template, tmp_path):
    (scans / "body0.ply").write_bytes((scans / "body0.ply").read_bytes()[:-100])
    (scans / "body1.landmarks.json").write_text('{"nose": [0, 0, 0], "ear": [1, 0, 0], "chin": [0, 1, 0]}')
    shutil.copy(scans / "body2.ply", scans / "broken.ply")
    (scans / "broken.landmarks.json").write_text("{")
    done = prepare(find_scans(scans), template, MARKS, tmp_path / "set", QUICK)
    assert done.registered.names == ("body2",)
    assert len(done.failures) == 3 and all("\n" not in line for line in done.failures)
    joined = " | ".join(sorted(done.failures))
    assert "body0.ply" in joined and "body1.landmarks.json" in joined and "broken.landmarks.json" in joined
    assert "nose" in joined and "top" in joined


def test_other_settings_or_template_in_the_folder(scans, template, tmp_path):
    prepare(find_scans(scans)[:1], template, MARKS, tmp_path / "set", QUICK)
    with pytest.raises(ValueError, match="other settings"):
        prepare(find_scans(scans), template, MARKS, tmp_path / "set", dataclasses.replace(QUICK, scan=dataclasses.replace(QUICK.scan, unit="mm")))
    with pytest.raises(ValueError, match="another template"):
        prepare(find_scans(scans), template.with_vertices(2 * template.vertices), MARKS, tmp_path / "set", QUICK)


def test_template_that_cannot_serve(scans, template, tmp_path):
    two = Mesh(np.vstack([template.vertices, template.vertices + 5]), np.vstack([template.faces, template.faces + 642]))
    with pytest.raises(ValueError, match="2 components"):
        prepare(find_scans(scans), two, MARKS, tmp_path / "set", QUICK)
    assert not (tmp_path / "set").exists()


def test_relative_paths_from_another_folder(scans, template, tmp_path, monkeypatch):
    """Processes are kept from one call to the next, and were started elsewhere."""
    monkeypatch.chdir(tmp_path)
    two = dataclasses.replace(QUICK, workers=2)
    assert not prepare(find_scans("scans"), template, MARKS, "set", two).failures
    (tmp_path / "elsewhere").mkdir()
    shutil.move(tmp_path / "scans", tmp_path / "elsewhere" / "scans")
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert not prepare(find_scans("scans"), template, MARKS, "set", two).failures
