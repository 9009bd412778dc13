from dataclasses import replace

import numpy as np
import pytest
from model_bodies import worm_model
from posing_bodies import symmetric_worm

from model.posing.poses import pose_from_angles
from model.priors import sample_poses


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


def test_sampled_poses_follow_the_prior():
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
