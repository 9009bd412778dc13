"""The virtual scanner and the synthetic data set."""
from __future__ import annotations

import json

import numpy as np
import pytest

from scanprep.geometry.files import read_mesh
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.synthetic import data_set, people
from scanprep.synthetic.people import BodyShape, SyntheticPerson
from scanprep.synthetic.scanner import ScannerConfig, scan

COARSE = ScannerConfig(resolution=0.014)


@pytest.fixture(scope="module")
def body() -> Mesh:
    return SyntheticPerson(BodyShape()).mesh


@pytest.fixture(scope="module")
def scanned(body):
    return scan(body, ScannerConfig(), np.random.default_rng(5))


def test_points_lie_on_the_body_with_the_noise_along_the_ray(body, scanned):
    """Distance along the ray between each point and the true surface: zero mean, the asked deviation."""
    from scanprep.geometry.surface import Rays

    rays = Rays(body)
    for view in scanned.views:
        ray = view.points - view.camera
        measured = np.linalg.norm(ray, axis=1)
        _, true = rays.cast(np.broadcast_to(view.camera, ray.shape), ray / measured[:, None])
        error = (measured - true)[np.isfinite(true)]
        error = error[np.abs(error) < 0.02]
        assert len(error) > 0.99 * len(ray)
        assert abs(error.mean()) < 3e-4 and error.std() == pytest.approx(0.002, rel=0.1)


def test_normals_face_the_camera_and_agree_with_the_body(body, scanned):
    for view in scanned.views:
        away = view.camera - view.points
        assert (np.einsum("nd,nd->n", view.mesh.face_normals,
                          view.camera - view.mesh.corners.mean(axis=1)) > 0).all()
        assert (np.einsum("nd,nd->n", view.normals, away) > 0).mean() > 0.999
        hit = Surface(body).closest(view.points)
        assert np.median(np.einsum("nd,nd->n", view.normals, body.face_normals[hit.faces])) > 0.9


def test_armpits_and_inner_thighs_are_holes(body, scanned):
    """The blind regions are far from every measured point, the chest is not."""
    from scipy.spatial import cKDTree

    d, _ = cKDTree(scanned.merged.vertices).query(body.vertices)
    assert (d > 0.012).mean() > 0.005
    assert np.median(d) < 0.006
    hidden = body.vertices[d > 0.012]
    chest = np.abs(hidden - [0, -0.1, 1.25]).max(axis=1) < 0.08
    assert not chest.any()
    near_crotch = np.linalg.norm(body.vertices - body.vertices[people.LANDMARKS["crotch"]], axis=1) < 0.04
    assert d[near_crotch].max() > 0.015
    assert all(view.mesh.boundary_loops for view in scanned.views)


def test_the_scan_has_its_own_triangulation_and_the_seed_decides(body):
    one, two, three = (scan(body, COARSE, np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert np.array_equal(one.merged.vertices, two.merged.vertices)
    assert np.array_equal(one.merged.faces, two.merged.faces)
    assert not np.array_equal(one.merged.vertices, three.merged.vertices)


def scans(folder, seed, poses, people):
    return [data_set.synthetic_scan(folder, seed, *which, COARSE) for which in data_set.scan_plan(poses, people)]


@pytest.mark.slow
def test_synthetic_scans_are_complete_repeatable_and_resumable(tmp_path):
    first = scans(tmp_path / "a", 3, 2, 2)
    assert [e.sex for e in first[2:]] == ["female", "male"] and len({e.name for e in first}) == 4
    for entry in first:
        mesh = read_mesh(entry.path)
        truth = data_set.GroundTruth.load(entry.truth)
        assert Surface(truth.mesh).closest(mesh.vertices).distances.mean() < 0.003
        assert truth.vertices[:, 2].min() == pytest.approx(0, abs=1e-9)
        person = SyntheticPerson(truth.shape)
        assert np.abs(person.in_pose(truth.pose, truth.trans) - truth.vertices).max() < 1e-9
        clicked = json.loads(entry.landmarks.read_text())
        errors = np.array([np.linalg.norm(point - truth.vertices[people.LANDMARKS[name]]) for name,
                           point in clicked.items()])
        assert len(clicked) >= 20 and 0.002 < errors.mean() < 0.009
    stamps = [entry.path.stat().st_mtime_ns for entry in first]
    bytes_before = first[1].path.read_bytes()
    first[1].path.unlink()
    again = scans(tmp_path / "a", 3, 2, 2)
    assert again == first
    assert first[1].path.read_bytes() == bytes_before
    assert again[0].path.stat().st_mtime_ns == stamps[0]
