"""The commands of `scape prep`: each explains itself, and hands files from one to the next."""
import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from config_files import config_file
from scan_folders import MARKS, QUICK, ball, write_scans
from scipy.spatial.transform import Rotation

from completion.__main__ import main
from scanprep import Mesh, RegisteredSet, Skeleton, config_files, read_mesh, read_points, write_landmarks, write_mesh
from scanprep.cli import COMMANDS
from scanprep.correspondence.correspondences import Correspondences, read_correspondences, write_correspondences
from scanprep.geometry.files import PointCloud, write_points
from scanprep.geometry.storage import StorageError
from scanprep.pipeline.prepare import prepare
from scanprep.pipeline.scans import find_scans
from scanprep.registration import cli as registration_cli
from scanprep.registration import unmarked
from scanprep.registration.nonrigid import register

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def template():
    return ball()


@pytest.fixture(scope="module")
def place(tmp_path_factory, template):
    """A template with landmarks, three scans, and a set with a skeleton of three parts along the body."""
    place = tmp_path_factory.mktemp("cli")
    write_mesh(place / "template.ply", template)
    write_landmarks(place / "template.landmarks.json", MARKS)
    write_scans(place / "scans", template)
    registered = prepare(find_scans(place / "scans"), template, MARKS, place / "set", QUICK).registered
    height = template.vertices[template.faces].mean(axis=1)[:, 2]
    part = np.select([height < -0.3, height > 0.3], [1, 2], 0)
    joints = [[0, 0, 0], [0, 0, -0.3], [0, 0, 0.3]]
    registered.with_skeleton(Skeleton(part, [-1, 0, 0], joints, ("middle", "low", "top")))
    return place


@pytest.fixture
def quick(tmp_path, monkeypatch):
    """A file of settings for a registration with few steps."""
    def few_steps(body, scan, landmarks=None, config=None, *rest, **named):
        return register(body, scan, landmarks, QUICK.scan.registration, *rest, **named)

    for place in (registration_cli, unmarked):
        monkeypatch.setattr(place, "register", few_steps)
    path = tmp_path / "quick.toml"
    config = replace(QUICK, min_poses=5)
    path.write_text(config_files.write_settings({"config": config}))
    return path


def run(*words):
    return main(["prep", *map(str, words)])


def report(path):
    return {m["metric"]: m["value"] for m in json.loads(Path(path).read_text())["metrics"]}


def test_help_answers_at_once():
    """Nothing that takes long is imported for it; the time itself is for the benchmarks."""
    code = ("import sys\nfrom completion.__main__ import main\nassert main(['prep', '--help']) == 0\n"
            "slow = {'scipy', 'igl', 'distributed', 'loky', 'matplotlib', 'PIL', 'trimesh'} & set(sys.modules)\n"
            "assert not slow, slow")
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert all(f"\n  {command} " in done.stdout for command in COMMANDS)


def test_run(place, tmp_path, capsys, quick):
    (place / "scans" / "broken.ply").write_text("nothing")
    code = run("run", place / "scans", "--template", place / "template.ply", "-o", tmp_path / "set", "--config", quick)
    (place / "scans" / "broken.ply").unlink()
    shown = capsys.readouterr()
    assert code == 1 and "broken.ply" in shown.err and "needs a look" not in shown.err
    figures = report(tmp_path / "set" / "report.json")
    assert figures["scans registered"] == "3 of 4" and figures["of them in this run"] == 3
    assert figures["led by landmarks"] == 3 and figures["scans that need a look"] >= 1
    assert figures["  broken"] == "failed"
    page = (tmp_path / "set" / "report.html").read_text()
    assert '<section class="scan failed"><h3><span class="dot"></span>broken ' in page
    assert page.count("<figure data-scene=") == 3


def test_page_with_other_limits(place, capsys):
    page = place / "set" / "report.html"
    assert run("page", place / "set", "--config", config_file(place, unseen=0.5)) == 0
    assert re.search(r"scans that need a look\W+0\b", capsys.readouterr().out)
    assert page.read_text().count('class="scan fine"') == 3
    assert run("page", place / "set", "--config", config_file(place, distance=1e-9)) == 0
    shown = capsys.readouterr()
    assert re.search(r"scans that need a look\W+3\b", shown.out) and str(page) in shown.err
    assert page.read_text().count('class="scan look"') == 3


def test_no_landmarks_wanted(place, tmp_path, capsys, quick):
    scans = write_scans(tmp_path / "scans", ball(), 1)
    (tmp_path / "bare.ply").write_bytes((place / "template.ply").read_bytes())
    words = ["run", scans, "--template", tmp_path / "bare.ply", "-o", tmp_path / "set", "--config", quick]
    assert run(*words) == 1
    assert "expected its landmarks in bare.landmarks.json" in capsys.readouterr().err
    assert run(*words, "--through", "pose") == 0
    assert report(tmp_path / "set" / "report.json")["led by pose"] == 1


def test_edit_skeleton(place, tmp_path):
    out = tmp_path / "skeleton.json"
    assert run("edit-skeleton", place / "set", "--rename", "top", "head", "-o", out) == 0
    assert Skeleton.load(out).names == ("middle", "low", "head")
    words = ["edit-skeleton", out, "--template", place / "template.ply"]
    assert run(*words, "--merge", "middle", "head", "-o", tmp_path / "two.json") == 0
    two, three = Skeleton.load(tmp_path / "two.json"), Skeleton.load(out)
    assert two.names == ("middle", "low")
    np.testing.assert_array_equal(two.part_of_face == 1, three.part_of_face == 1)
    edits = [{"rename": {"low": "foot"}}, {"move_joint": "foot", "position": [0, 0, -0.31]}]
    (tmp_path / "edits.json").write_text(json.dumps(edits))
    assert run(*words, "--edits", tmp_path / "edits.json", "-o", tmp_path / "moved.json") == 0
    moved = Skeleton.load(tmp_path / "moved.json")
    assert moved.names == ("middle", "foot", "head")
    np.testing.assert_allclose(moved.joints[1], [0, 0, -0.31], atol=1e-9)


def test_decimate_keeps_landmarks(place, tmp_path):
    out = tmp_path / "small.ply"
    assert run("decimate", place / "template.ply", "--faces", 400, "--landmarks", place / "template.landmarks.json",
               "-o", out) == 0
    small, template = read_mesh(out), ball()
    assert len(small.faces) <= 400 and small.is_closed
    apart = np.linalg.norm(small.vertices[:, None] - template.vertices[list(MARKS.values())], axis=2).min(axis=0)
    assert apart.max() < 1e-9


def test_align_begins_at_landmarks(place, tmp_path, capsys):
    """A body that stands on its head, where surfaces alone end in another pose."""
    body, turn = read_mesh(place / "template.ply"), np.diag([1.0, -1.0, -1.0])
    write_mesh(tmp_path / "turned.ply", body.with_vertices(body.vertices @ turn + [0.3, 0, 2]))
    marks = {name: body.vertices[v] @ turn + [0.3, 0, 2] for name, v in MARKS.items()}
    write_landmarks(tmp_path / "turned.landmarks.json", marks)
    assert run("align", tmp_path / "turned.ply", place / "template.ply", "--landmarks",
               tmp_path / "turned.landmarks.json", "-o", tmp_path / "back.ply") == 0
    np.testing.assert_allclose(read_mesh(tmp_path / "back.ply").vertices, body.vertices, atol=1e-4)
    shutil.copy(place / "template.ply", tmp_path / "bare.ply")
    assert run("align", tmp_path / "turned.ply", tmp_path / "bare.ply", "--landmarks",
               tmp_path / "turned.landmarks.json", "-o", tmp_path / "no.ply") == 1
    assert "bare.ply has no landmarks; expected a file of its name beside it" in capsys.readouterr().err


def test_decimate_set(place, tmp_path, capsys):
    assert run("decimate", place / "set", "--faces", 500, "--method", "even", "-o", tmp_path / "no") == 2
    assert "--method: it says nothing about a registered set" in capsys.readouterr().err
    assert run("decimate", place / "set", "--faces", 500, "-o", tmp_path / "small") == 0
    assert len(RegisteredSet.load(tmp_path / "small").template.faces) <= 500


def test_clean(tmp_path):
    body = ball()
    specks = ball(0).with_vertices(ball(0).vertices * 0.02 + [1, 1, 0])
    raw = Mesh(np.vstack([body.vertices, specks.vertices]), np.vstack([body.faces, specks.faces + 642]))
    write_mesh(tmp_path / "raw.ply", raw)
    assert run("clean", tmp_path / "raw.ply", "-o", tmp_path / "body.ply") == 0
    np.testing.assert_array_equal(read_mesh(tmp_path / "body.ply").vertices, body.vertices)
    write_points(tmp_path / "raw.xyz", PointCloud(raw.vertices, None, None))
    assert run("clean", tmp_path / "raw.xyz", "-o", tmp_path / "body.xyz") == 0
    assert len(read_points(tmp_path / "body.xyz").points) == 642
    assert report(tmp_path / "body.ply.report.json")["points before"] == 654


def test_fill(tmp_path):
    body = ball()
    open_body = body.submesh(body.vertices[body.faces].mean(axis=1)[:, 2] < 0.8)[0]
    write_mesh(tmp_path / "open.ply", open_body)
    assert run("fill", tmp_path / "open.ply", "-o", tmp_path / "closed.ply") == 0
    closed, figures = read_mesh(tmp_path / "closed.ply"), report(tmp_path / "closed.ply.report.json")
    assert closed.is_closed and figures["holes before"] == 1 and figures["fair patches"] == 1
    np.testing.assert_array_equal(closed.vertices[:len(open_body.vertices)], open_body.vertices)


def test_views_come_together(tmp_path):
    """Two views of a bumpy body, one of them misplaced by a known motion."""
    body = ball(5, (0.5, 0.5, 0.5))
    body = body.with_vertices(body.vertices * (1 + 0.08 * np.sin(9 * body.vertices).sum(axis=1, keepdims=True)))
    cameras = {"a": [2.0, 0.0, 0.0], "b": [0.0, 2.0, 0.0]}
    R, t = Rotation.from_rotvec([0, 0.02, 0.03]).as_matrix(), np.array([0.01, -0.015, 0.008])
    for name, camera in cameras.items():
        sight = np.asarray(camera) - body.vertices[body.faces].mean(axis=1)
        view = body.submesh(np.einsum("fd,fd->f", sight, body.face_normals) > 0.2)[0]
        moved = view if name == "a" else view.with_vertices(view.vertices @ R.T + t)
        write_mesh(tmp_path / "views" / f"{name}.ply", moved)
    cameras["b"] = (R @ cameras["b"] + t).tolist()
    (tmp_path / "views" / "cameras.json").write_text(json.dumps(cameras))
    assert run("views", tmp_path / "views", "-o", tmp_path / "aligned") == 0
    found = json.loads((tmp_path / "aligned" / "cameras.json").read_text())
    assert np.linalg.norm(np.array(found["b"]) - [0, 2, 0]) < 0.006 < np.linalg.norm(np.array(cameras["b"]) - [0, 2, 0])
    marks = {f"m{k}": body.vertices[k] for k in (12, 700, 3000, 9000)}
    write_landmarks(tmp_path / "marks" / "a.json", marks)
    write_landmarks(tmp_path / "marks" / "b.json", {name: R @ p + t for name, p in marks.items()})
    assert run("views", tmp_path / "views", "--landmarks", tmp_path / "marks", "-o", tmp_path / "by_marks") == 0


def test_correspondences_in_a_file(place, tmp_path, capsys, quick):
    scan = place / "scans" / "body0.ply"
    words = ["correspond", scan, "--template", place / "template.ply", "--landmarks",
             place / "scans" / "body0.landmarks.json", "--config", config_file(tmp_path, points=40)]
    assert run(*words, "-o", tmp_path / "pairs.json") == 1   # on an egg all pairs are wrong by a third of it
    assert "MEANS NOTHING: 40 pairs were found with a median confidence of 0.03" in capsys.readouterr().err
    found = read_correspondences(tmp_path / "pairs.json")
    assert len(found) == report(tmp_path / "pairs.json.report.json")["correspondences"] > 5
    assert 0 <= found.template_vertices.min() and found.template_vertices.max() < 642
    assert ((found.confidence >= 0) & (found.confidence <= 1)).all()
    beside = [*words[:4], "--config", config_file(tmp_path, points=40)]     # the landmarks of its name beside the scan
    assert run(*beside, "-o", tmp_path / "beside.json") == 1
    assert (tmp_path / "beside.json").read_bytes() == (tmp_path / "pairs.json").read_bytes()
    capsys.readouterr()
    assert run(*beside, "--landmarks", "none", "-o", tmp_path / "none.json") == 1
    assert "at least three limbs" in capsys.readouterr().err
    few = read_mesh(scan).vertices[::90]
    write_correspondences(tmp_path / "few.json", Correspondences(np.arange(642)[::90], few, np.ones(len(few))))
    assert run("register", scan, "--template", place / "template.ply", "--through", tmp_path / "few.json",
               "-o", tmp_path / "registered.ply") == 0
    assert report(tmp_path / "registered.ply.report.json")["surface with data"] > 95


def test_files_of_correspondences(tmp_path):
    rng = np.random.default_rng(0)
    numbers, points, confidence = rng.integers(0, 99, 7), rng.normal(size=(7, 3)), rng.random(7)
    before = Correspondences(numbers, points, confidence, "by hand", {"a": 1.5}, False)
    write_correspondences(tmp_path / "c.json", before)
    after = read_correspondences(tmp_path / "c.json")
    for name in ("template_vertices", "scan_points", "confidence"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    assert (after.method, after.energies, after.converged) == ("by hand", {"a": 1.5}, False)
    for text, problem in (("{", "cannot read it"), ("{}", "something else"), ("[]", "something else"),
                          ('{"kind": "correspondences", "version": 9}', "version 9"),
                          ('{"kind": "correspondences", "version": 1, "pairs": [{"vertex": 1}]}', "point")):
        (tmp_path / "c.json").write_text(text)
        with pytest.raises(StorageError, match=problem):
            read_correspondences(tmp_path / "c.json")
