import numpy as np
import pytest
from model_bodies import random_poses, worm_model

from model.pose_space import PoseSpace, nearest_joints, principal_directions


@pytest.fixture(scope="module")
def model():
    return worm_model()


def test_features_of_a_part_are_one_and_its_joints(model):
    features = model.pose_space.features
    pose = random_poses(model, 1, np.random.default_rng(0))[0]
    delta = features.evaluate(pose)
    np.testing.assert_allclose(delta[features.of_part(0)], [1, *pose[1], *pose[2]], atol=1e-15)
    np.testing.assert_allclose(delta[features.of_part(2)], [1, *pose[2], *pose[3, :2]], atol=1e-15)
    assert features.count == 7 + 4 + 6 + 3


def test_nearest_joints_are_those_of_the_part(model):
    near = nearest_joints(model.template, model.skeleton, count=1)
    parts, x = model.skeleton.part_of_face, model.template.corners.mean(axis=1)[:, 0] - 0.3
    assert near[parts == 1].tolist() == [[False, True, False, False]] * (parts == 1).sum()
    assert near[(parts == 0) & (x < -0.05), 1].all() and near[(parts == 0) & (x > 0.05), 2].all()
    assert nearest_joints(model.template, model.skeleton).sum(axis=1).max() == 2


def test_pruning_keeps_the_axes_that_move():
    rng = np.random.default_rng(3)
    poses = np.zeros((200, 2, 3))
    axis = np.array([1.0, 2.0, 2.0]) / 3
    poses[:, 1] = rng.normal(0, 0.8, (200, 1)) * axis + rng.normal(0, 0.02, (200, 3))
    kept = principal_directions(poses, 0.01)
    assert kept[0].shape == (3, 0) and kept[1].shape == (3, 1)
    assert abs(kept[1][:, 0] @ axis) > 0.999
    assert principal_directions(poses, 0.0)[1].shape == (3, 3)


def test_identity_space_is_rigid(model):
    space = PoseSpace.identity(model.skeleton)
    Q = space.gradients(random_poses(model, 3, np.random.default_rng(6)))
    np.testing.assert_array_equal(Q, np.broadcast_to(np.eye(3), Q.shape))
