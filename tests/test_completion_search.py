from dataclasses import replace

import numpy as np
import pytest
from completion_bodies import half_view, worm_with_prior

from completion.partial.completion import complete
from completion.partial.settings import CompletionConfig
from model.fitting.bodies import FixedBody
from model.fitting.scan import prepare_scan
from model.fitting.scan_fit import scan_fit
from model.fitting.starts import AXES, all_rotations, from_nothing, placements, starting_poses
from scanprep.geometry import rotations
from scanprep.geometry.surface import Surface

NOTHING = (np.zeros(0, dtype=np.int64), np.zeros((0, 3)))
POSE = np.array([[0.3, -0.5, 2.8], [0.2, 0.5, -0.4], [-0.1, -0.6, 0.3], [0.3, 0.1, 0.5]])
TRANS = np.array([0.4, -0.3, 1.1])
MARKS = np.array([6, 75, 130, 200, 255, 330, 396])
QUICK = CompletionConfig(random_starts=12, rounds=6, scan_points=800, model_points=300)


@pytest.fixture(scope="module")
def model():
    """A worm that kept its training poses; the one of the scan is not among them."""
    examples = np.random.default_rng(4).normal(0, 0.35, (20, 4, 3)) + worm_with_prior().pose_mean
    examples[:, 0] = 0
    return replace(worm_with_prior(), pose_examples=examples)


@pytest.fixture(scope="module")
def scene(model):
    body = model.template.with_vertices(model.vertices(POSE, None, TRANS))
    points, _ = half_view(body, np.array([0.3, -1, 0.5]), noise=0.001)
    return body, points


def test_turns_are_rotations_that_leave_no_gap():
    turns = all_rotations(600)
    np.testing.assert_allclose(turns @ np.swapaxes(turns, 1, 2), np.broadcast_to(np.eye(3), (600, 3, 3)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(turns), 1)
    any_turn = rotations.exp(np.random.default_rng(0).normal(0, 2, (300, 3)))
    cosine = (np.einsum("aij,bij->ab", any_turn, turns).max(axis=1) - 1) / 2
    assert np.degrees(np.arccos(cosine.min())) < 35                       # of any turn, one is near
    assert np.degrees(np.arccos(cosine.mean())) < 20


def test_neighbouring_twists_are_damped_and_the_root_is_not(model, scene):
    """[SCAPE] Eq. 11: with an endless weight no joint turns, and the body still moves to the scan as a whole."""
    fit = scan_fit(FixedBody(model.subject(None)), prepare_scan(scene[1]), *NOTHING, QUICK)
    x = fit.body.join(POSE, TRANS + 0.02)
    x[3:12] += np.random.default_rng(2).normal(0, 0.1, 9)
    turned = []
    for weight in (0.0, 1e9):
        ahead, _ = replace(fit, config=replace(QUICK, twist_weight=weight)).step(x, fit.thin, 0.2)
        assert np.abs(ahead[12:15] - x[12:15]).max() > 1e-3
        turned.append(np.abs(ahead[3:12] - x[3:12]).max())
    assert turned[0] > 1e-3 and turned[1] < 1e-3 * turned[0]


def test_what_is_laid_on_the_scan_lies_there(model, scene):
    _, points = scene
    fit = scan_fit(FixedBody(model.subject(None)), prepare_scan(points), *NOTHING, QUICK)
    x, cost = placements(fit)
    assert (np.diff(cost) >= 0).all()
    best = Surface(fit.mesh(x[0])).closest(points).distances
    assert best.mean() < 0.04 and Surface(fit.mesh(x[-1])).closest(points).distances.mean() > best.mean()
    starts = from_nothing(fit)
    places = np.array([fit.body.vertices(start) for start in starts])
    assert len(starts) > 3 and np.linalg.norm(places[0] - places[1], axis=1).mean() > 0.07


@pytest.mark.parametrize("kept", [20, 0], ids=["examples", "moments"])
def test_half_a_scan_without_landmarks_gives_the_whole_body(model, scene, kept):
    """A worm looks alike from both ends, so its surface is compared and not its vertices."""
    body, points = scene
    some = replace(model, pose_examples=model.pose_examples[:kept])
    assert len(starting_poses(scan_fit(FixedBody(some.subject(None)), prepare_scan(points), *NOTHING, QUICK))) == (
        21 if kept else 1 + 2 * AXES)
    result = complete(some.subject(None), points, None, QUICK)
    assert result.explained > 0.97 and np.isnan(result.landmark_rms)
    assert Surface(result.completed).closest(body.vertices).distances.mean() < 0.015


@pytest.mark.slow
def test_correspondences_complete_half_a_worm(model, scene):
    body, points = scene
    result = complete(model.subject(None), points, (MARKS, body.vertices[MARKS]), replace(QUICK, correspondences=True))
    assert np.linalg.norm(result.completed.vertices - body.vertices, axis=1).mean() < 0.008
