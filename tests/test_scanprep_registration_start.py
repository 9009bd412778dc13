"""Where a registration begins and what it says of itself: paths to landmarks, hints, ends that turn, clutter."""
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from jointed_bodies import bent, crab

from scanprep.correspondence.correspondences import Correspondences
from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.target import target_of
from scanprep.registration.limb_ends import RigidFit, find_ends, rotate_ends
from scanprep.registration.matches import initial_transform, prepare_problem, pull, tukey
from scanprep.registration.nonrigid import register
from scanprep.registration.paths import descriptors, path_lengths
from scanprep.registration.schedule import RegistrationConfig

BEND = np.array([0.0, 0.0, 1.2]), np.array([0.0, 1.4, 0.0])


def body() -> Mesh:
    return crab(81, 40)


def size_of(mesh: Mesh) -> float:
    return float(np.sqrt(mesh.face_areas.sum()))


def moved(points: np.ndarray) -> np.ndarray:
    """Far away and upside down."""
    return points @ rotations.exp(np.array([2.5, 0.4, 1.0])).T + [3.0, -1.0, 2.0]


def small() -> RegistrationConfig:
    config = RegistrationConfig()
    return replace(config, graph=tuple(replace(s, nodes=min(s.nodes, 100), rounds=min(s.rounds, 5))
                                       for s in config.graph))


# ---- paths --------------------------------------------------------------------------------------------------

def test_what_draws_vertices_is_the_weighted_squared_distance_and_less_along_the_surface():
    """Two targets of one vertex, one of another; across a surface all of the force, along it a share."""
    rng = np.random.default_rng(0)
    x, targets, weights = rng.normal(size=(4, 3)), rng.normal(size=(3, 3)), np.array([1.0, 2, 3])
    normals = np.array([[0.0, 0, 1], [0, 1, 0], [0.6, 0, 0.8]])
    off = x[[2, 2, 0]] - targets
    across = np.einsum("nd,nd->n", off, normals)
    for slide in (0.0, 0.1, 1.0):
        drawn = pull(4, np.array([2, 2, 0]), targets, weights, normals, slide)
        expected = weights @ (across**2 + slide * ((off**2).sum(axis=1) - across**2))
        assert drawn.energy(x) == pytest.approx(expected)


def test_matches_lose_their_weight_towards_their_reach():
    """Tukey's (1 - (d/r)²)²: nine sixteenths at the half."""
    np.testing.assert_allclose(tukey(np.array([0.0, 0.01, 0.02, 0.05]), 0.02), [1, 9 / 16, 0, 0])


def test_paths_cross_gaps_but_leave_crumbs_out():
    line = np.stack([np.linspace(0, 1, 201), np.zeros(201), np.zeros(201)], axis=1)
    line = line[(line[:, 0] < 0.4) | (line[:, 0] > 0.6)]
    crumb = np.array([[5.0, 5, 5]])
    points = np.vstack([np.repeat(line, 3, axis=0) + np.tile([[0, 0, 0], [0, 0.005, 0], [0, 0.01, 0]], (len(line), 1)),
                        crumb])
    lengths = path_lengths(points, np.tile([0.0, 0, 1], (len(points), 1)), np.array([[0.0, 0, 0]]), 0.004)[:, 0]
    at_end = lengths[np.argmin(np.linalg.norm(points - [1.0, 0, 0], axis=1))]
    assert 0.98 < at_end < 1.06
    assert lengths[-1] > np.linalg.norm(crumb) - 1 and np.isfinite(descriptors(lengths[:, None], 1.0)).all()


def test_a_body_upside_down_and_bent_is_placed_by_its_descriptors():
    mesh = body()
    x = moved(bent(mesh, *BEND))
    T = initial_transform(prepare_problem(mesh, Mesh(x, mesh.faces), (spread(mesh), x[spread(mesh)])))
    R, _ = rotations.procrustes(mesh.vertices, x)
    assert np.linalg.norm(rotations.log(T[:3, :3] @ R.T)) < 0.2
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(T[:3, :3]) > 0


def spread(mesh: Mesh) -> np.ndarray:
    """Six vertices: both tips, one on either arm, two of the chest."""
    N = len(mesh.vertices)
    return np.array([N - 2, N - 1, 20 * 40, 60 * 40 + 10, 43 * 40, 43 * 40 + 20])


# ---- anchors and hints --------------------------------------------------------------------------------------

def test_wrong_hints_among_right_ones_do_no_harm():
    mesh = crab()
    x = moved(bent(mesh, 0.5 * BEND[0], 0.5 * BEND[1]))
    rng = np.random.default_rng(4)
    vertices = rng.choice(len(x), 60, replace=False)
    points = x[vertices] + 0.005 * rng.normal(size=(60, 3))
    points[:6] = x[rng.choice(len(x), 6)]
    confidence = np.r_[np.full(6, 0.3), np.ones(54)]
    found = register(mesh, Mesh(x, mesh.faces), config=small(),
                     correspondences=Correspondences(vertices, points, confidence))
    assert np.linalg.norm(found.mesh.vertices - x, axis=1).mean() < 0.01
    assert np.isnan(found.landmark_rms) and found.inverted == 0


@pytest.mark.parametrize(("pairs", "word"), [
    (Correspondences(np.array([9999]), np.zeros((1, 3)), np.ones(1)), "9999"),
    (Correspondences(np.array([1]), np.full((1, 3), np.nan), np.ones(1)), "not finite"),
    (Correspondences(np.array([1]), np.zeros((1, 3)), np.ones(2)), "confidences")])
def test_bad_correspondences_are_named(pairs, word):
    with pytest.raises(ValueError, match=f"correspondences.*{word}"):
        register(crab(), crab(), correspondences=pairs)


# ---- ends ---------------------------------------------------------------------------------------------------

def test_an_end_that_is_rotated_about_itself_is_found():
    mesh = body()
    ends = find_ends(mesh, 2, 0.25)
    assert {int(np.sign(e.axis[0])) for e in ends} == {-1, 1} and all(abs(e.axis[0]) > 0.95 for e in ends)
    end = ends[0]
    share = np.clip((end.axis[0] * mesh.vertices[:, 0] - 0.1) / 0.05, 0, 1)
    truth = np.einsum("nij,nj->ni", rotations.exp(1.0 * share[:, None] * end.axis), mesh.vertices)
    target = target_of(Mesh(truth, mesh.faces))
    size = size_of(mesh)
    rotated = rotate_ends(mesh, end, mesh.vertices, RigidFit(target, size))[0]
    before = np.linalg.norm(mesh.vertices - truth, axis=1)[end.vertices].mean()
    assert np.linalg.norm(rotated - truth[end.vertices], axis=1).mean() < 0.35 * before


@pytest.mark.slow
def test_clutter_beside_the_body_changes_little_and_noise_is_told():
    mesh = crab()
    x = bent(mesh, 0.3 * BEND[0], 0.3 * BEND[1])
    truth = Mesh(x, mesh.faces)
    rng = np.random.default_rng(2)
    points = truth.sample(5000, rng)[0]
    board = np.stack([rng.uniform(-0.4, 0.4, 1500), rng.uniform(-0.3, 0.3, 1500), np.full(1500, -0.2)], axis=1)
    marks = np.array([820, 821, 9 * 20, 9 * 20 + 10, 31 * 20 + 5, 31 * 20 + 15])
    clean, cluttered, noisy = (register(mesh, scan, (marks, x[marks]), small()) for scan in (
        points, np.vstack([points, board]), points + 0.005 * rng.normal(size=points.shape)))
    apart = [np.linalg.norm(found.mesh.vertices - x, axis=1).mean() for found in (clean, cluttered, noisy)]
    assert apart[0] < 0.008 and apart[1] < 0.012 and apart[2] < 0.014
    assert noisy.rms > 2 * clean.rms
    # the board has 0.8 x 0.6 m, however few of the points lie on it
    share = 0.48 / (0.48 + truth.face_areas.sum())
    assert clean.uncovered < 0.005 and cluttered.uncovered == pytest.approx(share, abs=0.03)


@pytest.fixture(scope="module")
def near_the_origin():
    """A body, points of it, four marks, and the registration that they lead to."""
    template = body()
    points = template.vertices[::3] + 0.002 * np.sin(40 * template.vertices[::3])
    marks = np.array([3, 400, 900, 1500])
    near = template.vertices[marks]
    hints = Correspondences(marks, near, np.ones(4))
    return template, points, marks, hints, register(template, points, (marks, near), small(), None, hints, np.eye(4))


@pytest.mark.slow
@pytest.mark.parametrize("away", [(3.0, -3.0, 3.0), (5e5, 5e6, 100.0)], ids=["a room", "UTM"])
def test_a_scan_far_from_the_origin_is_registered_as_one_near_it(near_the_origin, away):
    """And is given back there: what led it and where it began come along.

    In UTM the scan itself is rounded, to a nanometre, which tips a few matches.
    """
    template, points, marks, hints, here = near_the_origin
    start, near = np.eye(4), hints.scan_points
    start[:3, 3] = away
    there = register(template, points + away, (marks, near + away), small(), None,
                     replace(hints, scan_points=near + away), start)
    np.testing.assert_allclose(there.mesh.vertices - away, here.mesh.vertices, atol=1e-4)
    assert there.landmark_rms == pytest.approx(here.landmark_rms, abs=1e-4)
