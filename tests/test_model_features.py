import numpy as np
import pytest
from derivatives import differences
from model_bodies import random_poses, worm_model, worm_skeleton

from model.features import (
    LinearLift,
    PoseFeatures,
    QuadraticLift,
    QuaternionLift,
    RotationLift,
    restore_features,
    twists,
)


def lifts():
    return [LinearLift(), QuadraticLift(), RotationLift(), QuaternionLift()]


def features_of(lift):
    """Three mixed features a part, all joints used."""
    rng = np.random.default_rng(1)
    part = np.repeat(np.arange(4), 3)
    mix = rng.normal(size=(4, lift.width, 12))
    mix[0], mix[:, :, ::3] = 0, 0
    return PoseFeatures(worm_skeleton(worm_model().template), lift, part, mix)


@pytest.mark.parametrize("lift", lifts(), ids=lambda lift: lift.kind)
@pytest.mark.parametrize("size", [0.4, 2.5])                 # 2.5: many joints beyond π
def test_derivative_matches_differences(lift, size):
    features = features_of(lift)
    pose = random_poses(worm_model(), 1, np.random.default_rng(2), size)[0]
    d = features.derivative(pose)
    assert d.shape == (12, 4, 3)
    slopes = differences(features.evaluate, pose).reshape(d.shape)
    assert (np.abs(d - slopes) <= 2e-8 * np.maximum(1, np.abs(slopes).max(axis=0))).all()


@pytest.mark.parametrize("lift", lifts(), ids=lambda lift: lift.kind)
def test_batch_is_the_loop_and_the_first_feature_of_a_part_is_one(lift):
    features = features_of(lift)
    poses = random_poses(worm_model(), 5, np.random.default_rng(3), 2.0)
    whole, slope = features.evaluate(poses), features.derivative(poses)
    np.testing.assert_allclose(whole, [features.evaluate(p) for p in poses], atol=1e-12)
    np.testing.assert_allclose(slope, [features.derivative(p) for p in poses], atol=1e-12)
    np.testing.assert_array_equal(whole[:, features.starts], 1)
    assert features.starts.tolist() == [0, 3, 6, 9]


def test_quadratic_lift_has_all_products():
    value = QuadraticLift().evaluate(np.array([[1.0, 2.0, 5.0]]))[0]
    assert value.tolist() == [1, 2, 5, 1, 2, 5, 4, 10, 25]


def test_twists_are_the_short_way_round():
    axis = np.array([0.6, 0.0, 0.8])
    np.testing.assert_allclose(twists((2 * np.pi - 0.5) * axis), -0.5 * axis, atol=1e-12)
    np.testing.assert_array_equal(twists(3.0 * axis), 3.0 * axis)


def test_refuses_shapes_that_do_not_agree():
    features = features_of(LinearLift())
    with pytest.raises(ValueError, match="mix"):
        PoseFeatures(features.skeleton, LinearLift(), features.part, features.mix[:, :2])
    with pytest.raises(ValueError, match="part"):
        PoseFeatures(features.skeleton, LinearLift(), features.part[::-1], features.mix)
    with pytest.raises(ValueError, match="not known"):
        restore_features(features.skeleton, {"lift": "cubic"}, {})
