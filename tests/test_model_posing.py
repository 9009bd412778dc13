from dataclasses import replace

import numpy as np
import pytest
from derivatives import differences
from model_bodies import random_poses, worm_model
from posing_bodies import symmetric_worm

from model.posing.poses import pose_from_angles
from model.priors import JointLimits, sample_poses
from scanprep.geometry import rotations


def test_poses_from_angles():
    skeleton = symmetric_worm()[1]
    pose = pose_from_angles(skeleton, {"left": [0.1, 0.2, 0.3], 2: ("x", 90), "left end": ((0, 3, 4), -180)})
    expected = np.zeros((5, 3))
    expected[1], expected[2], expected[3] = [0.1, 0.2, 0.3], [np.pi / 2, 0, 0], -np.pi * np.array([0, 0.6, 0.8])
    np.testing.assert_allclose(pose, expected, atol=1e-12)
    assert not pose_from_angles(skeleton, {}).any()


@pytest.mark.parametrize(("angles", "message"), [
    ({"arm": [0, 0, 0]}, "got 'arm'"), ({7: [0, 0, 0]}, "below 5"), ({1: [0, 0, 0], "left": [0, 0, 0]}, "twice"),
    ({1: [1, 2]}, "axis-angle vector"), ({1: ("u", 30)}, "x, y or z"), ({1: ((0, 0, 0), 30)}, "no direction"),
    ({1: [0, np.nan, 0]}, "axis-angle vector")])
def test_angles_that_are_none(angles, message):
    with pytest.raises(ValueError, match=message):
        pose_from_angles(symmetric_worm()[1], angles)


@pytest.fixture(scope="module")
def limits():
    """A hinge about (1, 1, 0), a ball joint around a bent position, and two that hardly move."""
    rng = np.random.default_rng(3)
    poses = rng.normal(0, 0.01, (300, 5, 3))
    poses[:, 0] = rng.normal(0, 2, (300, 3))
    poses[:, 1] += rng.uniform(0, 2, (300, 1)) * np.array([1, 1, 0]) / np.sqrt(2)
    poses[:, 2] = rotations.log(rotations.exp([3.0, 0, 0]) @ rotations.exp(rng.uniform(-0.5, 0.5, (300, 3))))
    return JointLimits.from_poses(poses, coverage=1.0, slack=0.05), poses


def test_limits_hold_what_they_were_made_of(limits):
    bounds, poses = limits
    assert bounds.excess(poses).max() == 0
    np.testing.assert_array_equal(bounds.clip(poses), poses)
    r, dr = bounds.residual(poses[0])
    assert not r.any() and not dr.any()


def test_a_hinge_is_bounded_at_its_ends(limits):
    bounds, _ = limits
    hinge = np.array([1, 1, 0]) / np.sqrt(2)
    pose = np.zeros((4, 5, 3))
    pose[:, 2] = [3.0, 0, 0]
    pose[:, 1] = np.array([-0.5, 1.0, 2.6, 0])[:, None] * hinge
    pose[3, 1] = [0, 0, 0.5]
    np.testing.assert_allclose(bounds.excess(pose)[:, 1], [0.45, 0, 0.55, 0.45 - 0.02], atol=0.04)
    np.testing.assert_allclose(bounds.clip(pose)[[0, 2], 1], [-0.05 * hinge, 2.05 * hinge], atol=0.04)


def test_bounds_have_no_seam_at_a_half_turn(limits):
    """The ball joint's poses lie on both sides of π, where axis-angle vectors jump."""
    bounds, poses = limits
    assert (poses[:, 2, 0] > 0).any() and (poses[:, 2, 0] < 0).any()
    assert (bounds.high[2] - bounds.low[2]).max() < np.sqrt(3) + 0.1         # at most the diagonal of the cube
    assert np.abs(rotations.log(rotations.exp(-bounds.mean[2]) @ rotations.exp([3.0, 0, 0]))).max() < 0.1


def test_the_root_is_free(limits):
    bounds, _ = limits
    pose = np.zeros((5, 3))
    pose[0], pose[2] = [3, 0.2, -0.4], [3.0, 0, 0]
    assert not bounds.excess(pose).any()


def test_clipping_reaches_the_bounds_and_stays(limits):
    bounds, _ = limits
    pose = np.random.default_rng(0).normal(0, 1, (50, 5, 3))
    clipped = bounds.clip(pose)
    assert bounds.excess(pose).max() > 1 and bounds.excess(clipped).max() < 1e-9
    np.testing.assert_allclose(bounds.clip(clipped), clipped, atol=1e-9)


def test_the_residual_is_the_excess_and_its_slope_a_difference(limits):
    bounds, _ = limits
    for pose in np.random.default_rng(1).normal(0, 0.9, (5, 5, 3)):
        r, dr = bounds.residual(pose)
        np.testing.assert_allclose(np.linalg.norm(r.reshape(5, 3), axis=1), bounds.excess(pose), atol=1e-12)
        np.testing.assert_allclose(dr, differences(lambda x: bounds.residual(x)[0], pose), atol=1e-7)
    poses = np.random.default_rng(1).normal(0, 0.9, (5, 5, 3))
    each = [bounds.residual(pose) for pose in poses]
    np.testing.assert_allclose(bounds.residual(poses)[0], [r for r, _ in each], atol=1e-12)
    np.testing.assert_allclose(bounds.residual(poses)[1], [dr for _, dr in each], atol=1e-12)


def test_coverage_leaves_out_what_is_rare():
    poses = np.random.default_rng(0).normal(0, 0.2, (400, 5, 3))
    poses[0, 1] = [2.5, 0, 0]
    every, most = (JointLimits.from_poses(poses, coverage, 0.0) for coverage in (1.0, 0.95))
    assert every.high[1].max() > 2 or every.low[1].min() < -2
    assert (most.high - most.low)[1:].max() < 0.9
    inside = (most.excess(poses)[:, 1:] == 0).mean(axis=0)
    assert (inside > 0.8).all() and (inside < 0.95).all()


def test_limits_refuse_too_little():
    with pytest.raises(ValueError, match="at least 5 finite poses"):
        JointLimits.from_poses(np.zeros((4, 5, 3)))
    with pytest.raises(ValueError, match="coverage"):
        JointLimits.from_poses(np.zeros((9, 5, 3)), coverage=0)
    with pytest.raises(ValueError, match="finite"):
        JointLimits.from_poses(np.full((9, 5, 3), np.nan))


def test_sampled_poses_follow_the_prior_and_the_limits():
    rng = np.random.default_rng(0)
    A = rng.normal(size=(12, 12)) * 0.1
    A[:3] = 0
    mean = np.r_[np.zeros((1, 3)), rng.normal(0, 0.1, (3, 3))]
    model = replace(worm_model(), pose_mean=mean, pose_covariance=A @ A.T)
    poses = sample_poses(model, 20000, np.random.default_rng(1))
    flat = poses.reshape(-1, 12)
    np.testing.assert_allclose(flat.mean(axis=0), mean.ravel(), atol=0.01)
    np.testing.assert_allclose(np.cov(flat.T), A @ A.T, atol=0.01)
    assert not poses[:, 0].any()
    np.testing.assert_array_equal(poses, sample_poses(model, 20000, np.random.default_rng(1)))
    limits = JointLimits.from_poses(random_poses(model, 50, rng, 0.1))
    within = sample_poses(model, 200, np.random.default_rng(1), limits)
    assert limits.excess(poses[:200]).max() > 0.1 and limits.excess(within).max() < 1e-9
