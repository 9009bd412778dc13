"""Non-rigid registration: a known deformation comes back, derivatives, invariances, bad input."""
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from derivatives import slope
from jointed_bodies import bent, crab

from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.registration import folds
from scanprep.registration import graph_energy as energy
from scanprep.registration.deformation_graph import build_graph, deform
from scanprep.registration.graph_fit import start_fit
from scanprep.registration.matches import pull
from scanprep.registration.nonrigid import register
from scanprep.registration.schedule import GraphStage, RegistrationConfig

LEFT, RIGHT = np.array([0.0, 0.0, 1.2]), np.array([0.0, 1.4, 0.0])
MARKS = np.array([820, 821, 9 * 20, 9 * 20 + 10, 20 * 20, 20 * 20 + 10, 31 * 20 + 5, 31 * 20 + 15])


def small(config: RegistrationConfig | None = None) -> RegistrationConfig:
    """The default schedule with fewer nodes, for a small body."""
    config = config or RegistrationConfig()
    return replace(config, graph=tuple(replace(s, nodes=min(s.nodes, 100), rounds=min(s.rounds, 8))
                                       for s in config.graph))


def scan_of(body: Mesh, rng: np.random.Generator, count: int = 6000, noise: float = 0.001) -> np.ndarray:
    """Points on the body with a hole around the middle of one arm and one on the back."""
    points, face, _ = body.sample(count, rng)
    points = points + noise * rng.normal(size=(count, 1)) * body.face_normals[face]
    hole = (np.linalg.norm(points - body.vertices[33 * 20 + 8], axis=1) < 0.05) \
        | (np.linalg.norm(points - body.vertices[21 * 20 + 3], axis=1) < 0.06)
    return points[~hole]


@pytest.fixture(scope="module")
def truth() -> Mesh:
    return crab().with_vertices(bent(crab(), LEFT, RIGHT))


@pytest.fixture(scope="module")
def found(truth):
    scan = scan_of(truth, np.random.default_rng(0))
    return register(crab(), scan, (MARKS, truth.vertices[MARKS]), small())


def test_large_bends_come_back_from_a_cloud_with_holes(truth, found):
    apart = np.linalg.norm(found.mesh.vertices - truth.vertices, axis=1)
    assert apart.mean() < 0.008 and apart.max() < 0.06
    assert Surface(truth).closest(found.mesh.vertices).distances.mean() < 0.0015
    assert found.inverted == 0 and found.landmark_rms < 0.01


def test_holes_are_reported_and_filled_with_volume(truth, found):
    hole = np.linalg.norm(truth.vertices - truth.vertices[33 * 20 + 8], axis=1) < 0.035
    assert not found.seen[hole].any()
    assert found.seen.mean() > 0.8
    assert np.isnan(found.distances[~found.seen]).all() and np.isfinite(found.distances[found.seen]).all()
    assert Surface(truth).closest(found.mesh.vertices[hole]).distances.max() < 0.012
    assert abs(found.mesh.volume / truth.volume - 1) < 0.03


@pytest.mark.slow
def test_moves_and_scales_with_the_input(truth):
    config = replace(small(), final_fit=False)
    scan = scan_of(truth, np.random.default_rng(1), 2500)
    first = register(crab(), scan, (MARKS, truth.vertices[MARKS]), config).mesh.vertices
    s, R, t = 7.0, rotations.exp(np.array([0.3, -1.0, 2.0])), np.array([4.0, -2.0, 1.0])
    body = crab().with_vertices(s * crab().vertices)
    moved = register(body, s * scan @ R.T + t, (MARKS, s * truth.vertices[MARKS] @ R.T + t), config).mesh.vertices
    np.testing.assert_allclose((moved - t) @ R / s, first, atol=0.010)   # thinning keeps other points
    assert np.abs((moved - t) @ R / s - first).mean() < 1e-3


@pytest.mark.slow
def test_another_size_is_followed():
    body = crab()
    wanted = body.vertices * [1.2, 1.15, 1.1]
    scan = Mesh(wanted, body.faces)
    found = register(body, scan, (MARKS, wanted[MARKS]), small())
    assert np.linalg.norm(found.mesh.vertices - wanted, axis=1).mean() < 0.008
    assert Surface(scan).closest(found.mesh.vertices).distances.mean() < 0.001


def test_without_landmarks_a_near_pose_is_found():
    body = crab()
    wanted = bent(body, 0.2 * LEFT, 0.2 * RIGHT) + [0.02, 0.01, -0.02]
    found = register(body, Mesh(wanted, body.faces), config=small())
    assert np.linalg.norm(found.mesh.vertices - wanted, axis=1).mean() < 0.008
    assert np.isnan(found.landmark_rms)


def test_progress_ends_at_its_total_and_the_result_repeats(truth):
    calls = []
    config = replace(small(), graph=small().graph[2:4])
    args = crab(), truth, (MARKS, truth.vertices[MARKS]), config
    first = register(*args, progress=lambda done, total: calls.append((done, total)))
    assert calls[-1][0] == calls[-1][1] and [c[0] for c in calls] == sorted(c[0] for c in calls)
    np.testing.assert_array_equal(first.mesh.vertices, register(*args).mesh.vertices)


def test_a_folded_patch_is_laid_flat_again():
    body = crab()
    x = body.vertices.copy()
    x[[405, 406]] = x[[406, 405]]                                # two neighbours have changed places
    x[700] += 0.05 * body.vertex_normals[700] + 0.05 * (body.vertices[721] - body.vertices[700]) / 0.02
    assert folds.find_inverted_triangles(body, x).sum() >= 2
    laid = folds.without_inverted(body, x)
    assert not folds.find_inverted_triangles(body, laid).any()
    assert np.linalg.norm(laid - body.vertices, axis=1).max() < 0.5 * np.linalg.norm(x - body.vertices, axis=1).max()


# ---- the graph and the energy terms -------------------------------------------------------------------------

def small_graph():
    return build_graph(crab(), 40)


def random_motion(g, rng, size=0.3):
    M = len(g.node_vertices)
    step = size * rng.normal(size=(M, 7)) * [1, 1, 1, 0.3, 0.1, 0.1, 0.1]
    return start_fit(crab(), np.eye(4), M).motion.advance(step)


def test_a_similarity_is_free_and_exact():
    g = small_graph()
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotations.exp(np.array([1.0, 2.0, -0.5])), [1, 2, 3]
    motion = replace(start_fit(crab(), T, 40).motion, log_scale=np.full(len(g.nodes), np.log(1.3)),
                     positions=1.3 * g.nodes @ T[:3, :3].T + T[:3, 3])
    np.testing.assert_allclose(deform(g, motion), 1.3 * crab().vertices @ T[:3, :3].T + T[:3, 3], atol=1e-12)
    for term in (energy.stretch_term, energy.bend_term, energy.growth_term):
        assert term(g, motion, 1.0).value < 1e-20


def wanted_pull(rng):
    body = crab()
    at = rng.integers(0, len(body.vertices), 300)
    normals = rng.normal(size=(300, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return pull(len(body.vertices), at, rng.normal(size=(300, 3)), rng.random(300), normals, 0.1)


@pytest.mark.parametrize("name", ["data", "stretch", "bend", "growth"])
def test_gradient_matches_finite_differences(name):
    rng = np.random.default_rng(7)
    g = small_graph()
    motion, wanted = random_motion(g, rng), wanted_pull(rng)
    stage = GraphStage(40, 0.7, 0.3, 0.0, 0.0)
    term = energy.terms(g, motion, wanted, stage, 2.0)[name]
    blocks, half = term.normal(energy.NodePattern(g))
    for _ in range(4):
        direction = rng.normal(size=half.shape)
        expected = slope(lambda s, d=direction: energy.terms(g, motion.advance(s * d), wanted, stage, 2.0)[name].value,
                         1e-5)
        np.testing.assert_allclose(2 * np.sum(half * direction), expected, rtol=1e-6, atol=1e-7 * abs(term.value))
    H = energy.NodePattern(g).matrix(blocks)
    assert abs(H - H.T).max() <= 1e-12 * abs(H).max()
    assert np.linalg.eigvalsh(H.toarray()).min() > -1e-9 * abs(H).max()


# ---- bad input ----------------------------------------------------------------------------------------------

@pytest.mark.parametrize(("landmarks", "word"), [
    ((np.array([1, 2]), np.zeros((2, 3))), "at least 3"),
    ((np.array([1, 2, 5000]), np.zeros((3, 3))), "5000"),
    ((np.array([1, 2, -1]), np.zeros((3, 3))), "-1"),
    ((np.array([1, 2, 3]), np.full((3, 3), np.nan)), "not finite"),
    ((np.array([1, 2, 3]), np.zeros((4, 3))), "landmarks"),
    ((np.array([1.0, 2.0, 3.0]), np.zeros((3, 3))), "vertex numbers")])
def test_bad_landmarks_are_named(landmarks, word):
    with pytest.raises(ValueError, match=word):
        register(crab(), crab(), landmarks)


def test_bad_scans_and_templates_are_named():
    body = crab()
    with pytest.raises(ValueError, match="scan: expected at least"):
        register(body, np.zeros((0, 3)))
    with pytest.raises(ValueError, match="scan: 1 points are not finite"):
        register(body, np.vstack([body.vertices, [[np.nan, 0, 0]]]))
    with pytest.raises(ValueError, match="scan"):
        register(body, np.zeros((10, 2)))
    with pytest.raises(ValueError, match="template"):
        register(Mesh(np.vstack([body.vertices, [[9, 9, 9]]]), body.faces), body)
