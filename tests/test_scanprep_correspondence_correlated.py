"""Correlated correspondence and automatic seeds: known poses come back, from sheets, clouds and with clutter."""
from __future__ import annotations

from dataclasses import replace

import igl
import numpy as np
import pytest

from scanprep.correspondence import potentials as ce
from scanprep.correspondence.correlated import find_correspondences, find_seeds
from scanprep.correspondence.potentials import SurfaceFeatures
from scanprep.correspondence.search import CorrelatedConfig
from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.synthetic.people import SyntheticPerson, find_pose

SMALL = CorrelatedConfig(points=100)


def dense(body: Mesh) -> Mesh:
    """The same surface with four triangles for one, as scans have points every centimetre and bodies have not."""
    return Mesh(*igl.upsample(body.vertices, body.faces, 1))


def sheets(body: Mesh, rng: np.random.Generator, noise: float = 0.001) -> Mesh:
    """Two overlapping sheets, seen from the front and from the back, each with its own triangles."""
    pieces, faces, start, body = [], [], 0, dense(body)
    for direction in ([0, -1, 0.2], [0, 1, 0.2]):
        keep = body.face_normals @ np.array(direction) > -0.35
        piece, _ = body.submesh(keep)
        pieces.append(piece.vertices + noise * rng.normal(size=piece.vertices.shape))
        faces.append(piece.faces + start)
        start += len(piece.vertices)
    return Mesh(np.vstack(pieces), np.vstack(faces))


@pytest.fixture(scope="module")
def person() -> SyntheticPerson:
    return SyntheticPerson()


@pytest.fixture(scope="module")
def kicking(person) -> Mesh:
    return person.mesh.with_vertices(person.in_pose(find_pose("kick_left")))


@pytest.fixture(scope="module")
def ends(person) -> np.ndarray:
    """Vertices of the finger tips, the toes and the crown: where the template reaches farthest."""
    x = person.mesh.vertices
    left = x[:, 0] > 0
    foot = x[:, 2] < np.quantile(x[:, 2], 0.03)
    far = [np.argmax(x[:, 0]), np.argmin(x[:, 0]), np.argmax(x[:, 2])]
    front = 1.0 if (x[foot, 1].mean() > x[:, 1].mean()) else -1.0
    far += [np.flatnonzero(foot & side)[np.argmax(front * x[foot & side, 1])] for side in (left, ~left)]
    return np.array(far)


@pytest.fixture(scope="module")
def found(person, kicking, ends):
    scan = sheets(kicking, np.random.default_rng(0))
    return find_correspondences(person.mesh, scan, (ends, kicking.vertices[ends]), SMALL)


def apart(found, truth: Mesh) -> np.ndarray:
    return np.linalg.norm(truth.vertices[found.template_vertices] - found.scan_points, axis=1)


@pytest.mark.slow
def test_five_seeds_on_overlapping_sheets_become_many_pairs(found, kicking):
    assert len(found) > 80
    error = apart(found, kicking)
    assert np.median(error) < 0.02 and (error > 0.1).mean() <= 0.03
    assert found.confidence.min() >= 0 and found.confidence.max() <= 1
    assert (np.diff(found.confidence) <= 0).all()


@pytest.mark.slow
def test_the_scan_may_stand_anywhere(person, kicking, ends, found):
    R, t = rotations.exp(np.array([0.3, -2.0, 1.1])), np.array([3.0, -1.0, 0.5])
    scan = sheets(kicking, np.random.default_rng(0))
    moved = kicking.with_vertices(kicking.vertices @ R.T + t)
    again = find_correspondences(person.mesh, scan.with_vertices(scan.vertices @ R.T + t),
                                 (ends, moved.vertices[ends]), SMALL)
    error = apart(again, moved)           # cells of the thinning fall elsewhere, so other points are chosen
    assert np.median(error) < 0.02 and (error > 0.1).mean() <= 0.03


@pytest.mark.slow
def test_the_scan_may_be_larger(person, kicking, ends, found):
    large = kicking.with_vertices(1.25 * kicking.vertices)
    again = find_correspondences(person.mesh, dense(large), (ends, large.vertices[ends]), SMALL)
    assert 1.15 < again.energies["scale"] < 1.32
    assert np.median(apart(again, large)) < 0.025


def test_wrong_seeds_are_refused(person, kicking):
    mesh = person.mesh
    with pytest.raises(ValueError, match="at least 3"):
        find_correspondences(mesh, kicking, (np.array([0, 1]), np.zeros((2, 3))))
    with pytest.raises(ValueError, match="expected vertices of 0"):
        find_correspondences(mesh, kicking, (np.array([0, 1, 10**6]), np.zeros((3, 3))))
    with pytest.raises(ValueError, match="shape"):
        find_correspondences(mesh, kicking, (np.array([0, 1, 2]), np.zeros((3, 2))))
    with pytest.raises(ValueError, match="finite"):
        find_correspondences(mesh, kicking, (np.array([0, 1, 2]), np.full((3, 3), np.nan)))


@pytest.mark.slow
def test_seeds_are_found_without_a_click_and_not_swapped(person, kicking, ends):
    seeds = find_seeds(person.mesh, sheets(kicking, np.random.default_rng(1)))
    assert len(seeds) == 5 and seeds.converged
    # The same five places as the farthest points of the template, give or take a hand's breadth.
    nearest = np.linalg.norm(person.mesh.vertices[seeds.template_vertices][:, None] - person.mesh.vertices[ends],
                             axis=2)
    assert sorted(nearest.argmin(axis=1)) == [0, 1, 2, 3, 4] and nearest.min(axis=1).max() < 0.12
    assert apart(seeds, kicking).max() < 0.08


def test_energies_of_true_images_are_zero_and_mirrors_cost():
    rng = np.random.default_rng(0)
    n = 12
    normals = rotations.exp(rng.normal(size=(n, 3)))[:, 2]
    places = SurfaceFeatures(rng.normal(size=(n, 3)), normals, rng.uniform(0.2, 1, (n, 4)), rng.uniform(-1, 1, (n, 6)),
                             np.ones((n, 4)))
    mirrored = replace(places, angles=-places.angles)
    edges = np.array([[0, 1], [4, 7], [3, 11]])
    own = np.arange(n)[:, None]
    assert np.allclose(np.diagonal(ce.place_energy(places, places, 1.0)), 0)
    assert (np.diagonal(ce.place_energy(places, mirrored, 1.0)) > 0.1).all()
    assert np.allclose(ce.edge_energy(places, places, edges, own, 1.0), 0, atol=1e-6)
    domains = np.tile(np.arange(n), (n, 1))
    table = ce.edge_energy(places, places, edges, domains, 1.0)
    assert table.max() <= ce.MOST_EDGE + 1e-5
    assert ce.place_energy(places, mirrored, 1.0).max() <= ce.most_place_energy(4)
    # The table of (i, j) is that of (j, i) turned over.
    assert np.allclose(table, ce.edge_energy(places, places, edges[:, ::-1], domains, 1.0).transpose(0, 2, 1),
                       atol=1e-5)
