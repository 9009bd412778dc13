from dataclasses import replace

import numpy as np
import pytest
from conformance_bodies import skinned_worm
from model_bodies import random_poses, worm, worm_skeleton

from model.blend_weights import diffuse_weights, fit_weights, strongest
from model.fitting.vertices import fit_pose, fit_shape
from model.learning.skinning import (
    SkinConfig,
    learn_skinning,
)
from scanprep.geometry import rotations
from scanprep.skeleton.tree import Skeleton

FEW = {"rounds": 4}


@pytest.fixture(scope="module")
def truth():
    return skinned_worm(True)


@pytest.fixture(scope="module")
def training(truth):
    rng = np.random.default_rng(0)
    poses = random_poses(truth, 40, rng, 0.4)
    poses[0] = 0
    people = np.stack([truth.vertices(p, b) for p, b in zip(random_poses(truth, 12, rng, 0.1),
                                                            rng.normal(size=(12, 3)), strict=True)])
    return truth.subject().vertices(poses), people


@pytest.fixture(scope="module")
def learned(truth, training):
    config = SkinConfig(components=5, **FEW)
    return learn_skinning(truth.template, *training, truth.skeleton, config)


def test_new_poses_of_the_truth_are_met(truth, training, learned):
    """Data a skinning model made come back, best with the correctives they were made with."""
    bodies = truth.subject().vertices(random_poses(truth, 6, np.random.default_rng(1), 0.4))
    plain = learn_skinning(truth.template, training[0], None, truth.skeleton, SkinConfig(correctives=False, **FEW))
    linear, none = (np.mean([fit_pose(m.subject(), y).mean for y in bodies]) for m in (learned, plain))
    assert linear < 2.2e-3
    assert linear < 0.6 * none
    assert learned.info["left_out_error"] < plain.info["left_out_error"]


def test_new_people_of_the_truth_are_met(truth, learned):
    rng = np.random.default_rng(3)
    bodies = [truth.vertices(p, b) for p, b in zip(random_poses(truth, 3, rng, 0.1), rng.normal(size=(3, 3)),
                                                   strict=True)]
    assert np.mean([fit_shape(learned, y).mean for y in bodies]) < 1e-3
    assert learned.explained[2] > 0.97 and learned.n_betas == 5


def test_a_person_is_unposed_exactly(truth):
    rng = np.random.default_rng(4)
    for pose, betas in zip(random_poses(truth, 3, rng, 0.4), rng.normal(size=(3, 3)), strict=True):
        back = truth.unpose(truth.vertices(pose, betas, rng.normal(size=3)), pose)
        x = truth.rest_vertices(betas)
        at = truth.skeleton.joints[0] - (truth.joint_regressor @ x)[0]
        np.testing.assert_allclose(back, x + at, rtol=0, atol=1e-12)


def test_weights_are_the_least_squares_solution():
    """Without the pull of neighbours every vertex agrees with non-negative least squares."""
    from scipy.optimize import nnls

    template, rng = worm(rings=5, around=6), np.random.default_rng(5)
    N, J, M = len(template.vertices), 4, 7
    carried, bodies = rng.normal(size=(M, J, N, 3)), rng.normal(0, 0.3, (M, N, 3))
    allowed = np.ones((N, J), dtype=bool)
    allowed[::2, 3] = False
    found = fit_weights(list(carried), bodies, template, np.full((N, J), 0.25), allowed, 0.0, steps=1000)
    for n in range(N):
        mine = np.flatnonzero(allowed[n])
        heavy = 1e4                                          # a heavy row holds the sum at 1
        A = np.vstack([carried[:, mine, n].transpose(0, 2, 1).reshape(-1, len(mine)), np.full(len(mine), heavy)])
        expected = np.zeros(J)
        expected[mine] = nnls(A, np.r_[bodies[:, n].ravel(), heavy])[0]
        np.testing.assert_allclose(found[n], expected, atol=1e-5)


def test_neighbours_draw_weights_together():
    template, rng = worm(rings=9, around=6), np.random.default_rng(6)
    N = len(template.vertices)
    carried, bodies = rng.normal(size=(5, 3, N, 3)), rng.normal(0, 0.3, (5, N, 3))
    free, start = np.ones((N, 3), dtype=bool), np.full((N, 3), 1 / 3)
    a, b = template.edges.T
    rough, even, flat = (np.linalg.norm(w[a] - w[b]) for w in (
        fit_weights(list(carried), bodies, template, start, free, s, steps=1000) for s in (0.0, 1.0, 100.0)))
    assert flat < 0.01 * rough < rough and even < 0.7 * rough


def test_few_weights_are_kept():
    w = np.array([[0.5, 0.3, 0.15, 0.0495, 0.0005], [1, 0, 0, 0, 0]])
    np.testing.assert_allclose(strongest(w, 2, 1e-3), [[0.625, 0.375, 0, 0, 0], [1, 0, 0, 0, 0]])
    assert (strongest(w, 5, 1e-3)[0] > 0).tolist() == [True, True, True, True, False]


def test_weights_pass_over_the_width_asked_for():
    template = worm(rings=65)
    skeleton = worm_skeleton(template)
    x = template.vertices[:, 0] - 0.3
    for width in (0.04, 0.12):
        w = diffuse_weights(template, skeleton, width)
        soft = np.abs(x[(w[:, 1] > 0.1) & (w[:, 1] < 0.9)] + 0.35)
        np.testing.assert_allclose(w.sum(axis=1), 1)
        assert 0.5 * width < soft.max() < 3 * width


def test_rigid_motion_of_the_data_changes_nothing_within(truth, training):
    rng = np.random.default_rng(9)
    bodies, config = training[0][:12], SkinConfig(rounds=1)
    R = rotations.exp(rng.normal(size=(12, 3)))
    moved = bodies @ np.swapaxes(R, -1, -2) + rng.normal(size=(12, 1, 3))
    a, b = (learn_skinning(truth.template, y, None, truth.skeleton, config) for y in (bodies, moved))
    pose = random_poses(truth, 1, rng)[0]
    np.testing.assert_allclose(b.vertices(pose), a.vertices(pose), atol=1e-4)


def test_same_input_gives_the_same_bytes(truth, training):
    config = SkinConfig(rounds=1)
    a, b = (learn_skinning(truth.template, training[0][:8], training[1][:4], truth.skeleton, config) for _ in range(2))
    for name in ("rest", "weights", "correctives", "shape_mean", "shape_components", "pose_covariance"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    assert a.info == b.info and len(a.info["digest"]) == 64


def test_a_body_of_one_part(training):
    template = worm()
    one = Skeleton(np.zeros(len(template.faces), int), [-1], [template.vertices.mean(axis=0)])
    model = learn_skinning(template, training[0][:3], training[1][:4], one, SkinConfig(rounds=1))
    fit = fit_pose(model.subject(), model.rest + [1.0, 0, 0])
    assert fit.pose.shape == (1, 3) and fit.rms < 1e-6


def test_refuses_weights_that_do_not_sum_to_one(truth):
    with pytest.raises(ValueError, match="weights: expected rows"):
        replace(truth, weights=truth.weights * 1.01)
    with pytest.raises(ValueError, match="correctives: expected shape"):
        replace(truth, correctives=truth.correctives[:-1])
