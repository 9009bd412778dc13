import numpy as np
import pytest
from model_bodies import worm_model

from model.blend_weights import face_weights, skin_weights, to_neighbours
from model.scape import BlendScapeModel


@pytest.fixture(scope="module")
def model():
    return worm_model()


@pytest.mark.parametrize("weights", [skin_weights, face_weights])
def test_weights_are_shares_that_fade_with_distance(model, weights):
    given = weights(model.template, model.skeleton, 0.1)
    x = (model.template.vertices if weights is skin_weights else model.template.corners.mean(axis=1))[:, 0] - 0.3
    assert given.min() >= 0
    np.testing.assert_allclose(given.sum(axis=1), 1, atol=1e-12)
    for a, b, border in ((0, 1, -0.35), (0, 2, 0.35), (2, 3, 0.7)):
        near = np.abs(x - border) < 0.04
        assert (given[near][:, [a, b]].min(axis=1) > 0.15).all(), (a, b)
        assert given[near][:, [a, b]].sum(axis=1) == pytest.approx(1, abs=0.1)
    assert (given[np.abs(x + 0.9) < 0.1, 1] > 0.97).all()


def test_only_linked_parts_share(model):
    """Parts 1 and 3 are two steps apart: what reaches over counts for the part between."""
    spread = np.array([[0.1, 0.6, 0.0, 0.3], [0.0, 0.0, 0.0, 1.0], [0.2, 0.0, 0.3, 0.5]])
    moved = to_neighbours(spread, model.skeleton)
    np.testing.assert_allclose(moved, [[0.4, 0.6, 0, 0], [0, 0, 0, 1], [0, 0, 0.5, 0.5]])
    weights = face_weights(model.template, model.skeleton, 0.3)
    assert (weights[model.skeleton.part_of_face == 1][:, 2:] == 0).all()


def test_blending_with_own_rotations_alone_is_scape(model):
    own = np.eye(4)[model.skeleton.part_of_face]
    blended = BlendScapeModel(model.template, model.skeleton, model.pose_space, model.shape_space, model.pose_mean,
                              model.pose_covariance, blend=own)
    pose = np.random.default_rng(0).normal(0, 0.5, (4, 3))
    np.testing.assert_allclose(blended.vertices(pose, [1.0, 0.5]), model.vertices(pose, [1.0, 0.5]), atol=1e-12)
    with pytest.raises(ValueError, match="blend"):
        BlendScapeModel(model.template, model.skeleton, model.pose_space, model.shape_space, model.pose_mean,
                        model.pose_covariance, blend=2 * own)
