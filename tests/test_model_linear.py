import numpy as np
import pytest
from model_bodies import random_poses, worm_model

from model.scape import ScapeModel
from scanprep.geometry import rotations
from scanprep.skeleton.tree import Skeleton

BETAS = np.array([0.7, -1.2, 0.4])


@pytest.fixture(scope="module")
def model():
    return worm_model()


@pytest.fixture(scope="module")
def subject(model):
    return model.subject(BETAS)


def differences(function, x, h=1e-6):
    """Central differences of `function` by every entry of x, in a last axis."""
    slopes = []
    for i in range(x.size):
        step = np.zeros(x.size)
        step[i] = h
        slopes.append((function(x + step.reshape(x.shape)) - function(x - step.reshape(x.shape))) / (2 * h))
    return np.stack(slopes, axis=-1)


@pytest.mark.parametrize("betas", [None, BETAS])
@pytest.mark.parametrize("size", [0.0, 0.5, 2.0])
def test_agrees_with_the_sparse_solve(model, betas, size):
    rng = np.random.default_rng(0)
    poses, trans = random_poses(model, 4, rng, size), rng.normal(size=(4, 3))
    np.testing.assert_allclose(model.subject(betas).vertices(poses, trans), model.vertices(poses, betas, trans),
                               rtol=0, atol=1e-12)


def test_batch_is_the_loop(model, subject):
    rng = np.random.default_rng(1)
    poses, trans = random_poses(model, 5, rng), rng.normal(size=(5, 3))
    y = subject.vertices(poses, trans)
    assert y.shape == (5, *model.template.vertices.shape)
    for b in range(5):
        np.testing.assert_allclose(y[b], subject.vertices(poses[b], trans[b]), atol=1e-13)
    np.testing.assert_allclose(subject.vertices(poses, trans[0])[3], subject.vertices(poses[3], trans[0]),
                               atol=1e-13)
    assert subject.vertices(poses[:0]).shape == (0, *model.template.vertices.shape)


def test_float32_agrees_to_micrometres(model, subject):
    poses = random_poses(model, 4, np.random.default_rng(2))
    y = model.subject(BETAS, dtype=np.float32).vertices(poses)
    assert y.dtype == np.float32
    np.testing.assert_allclose(y, subject.vertices(poses), rtol=0, atol=2e-6)


def test_root_pose_turns_the_body_about_its_root(model, subject):
    """Rigid equivariance: pose_0 turns about the centroid of part 0 and trans shifts."""
    rng = np.random.default_rng(3)
    pose, trans = random_poses(model, 1, rng)[0], rng.normal(size=3)
    R = rotations.exp([0.4, 2.0, -1.0])
    other = pose.copy()
    other[0] = rotations.log(R @ rotations.exp(pose[0]))
    centre = model.skeleton.joints[0] + trans
    np.testing.assert_allclose(subject.vertices(other, trans),
                               (subject.vertices(pose, trans) - centre) @ R.T + centre, atol=1e-12)
    root = model.skeleton.part_of_vertex(model.template) == 0
    np.testing.assert_allclose(subject.vertices(pose, trans)[root].mean(axis=0), centre, atol=1e-12)


def test_points_are_the_vertices_they_are_made_of(model, subject):
    rng = np.random.default_rng(4)
    pose, trans = random_poses(model, 1, rng)[0], rng.normal(size=3)
    y = subject.vertices(pose, trans)
    ids = rng.choice(subject.n_vertices, 9)
    np.testing.assert_allclose(subject.points(ids).evaluate(pose, trans), y[ids], atol=1e-13)
    corners, weights = rng.choice(subject.n_vertices, (9, 3)), rng.dirichlet(np.ones(3), 9)
    np.testing.assert_allclose(subject.points(corners, weights).evaluate(pose, trans),
                               np.einsum("lk,lkd->ld", weights, y[corners]), atol=1e-13)


@pytest.mark.parametrize("size", [0.0, 0.5, 2.5])            # at rest, usual, and beyond π
def test_jacobian_matches_differences(model, subject, size):
    rng = np.random.default_rng(5)
    pose, trans = random_poses(model, 1, rng, size)[0], rng.normal(size=3)
    corners, weights = rng.choice(subject.n_vertices, (20, 3)), rng.dirichlet(np.ones(3), 20)
    for operator in (subject.points(corners[:, 0]), subject.points(corners, weights)):
        y, d_pose = operator.jacobian(pose, trans)
        np.testing.assert_allclose(y, operator.evaluate(pose, trans), atol=1e-13)
        expected = differences(lambda x, op=operator: op.evaluate(x, trans), pose)
        np.testing.assert_allclose(d_pose, expected, atol=2e-9)


def test_jacobian_of_a_batch_is_the_loop(model, subject):
    rng = np.random.default_rng(6)
    poses, trans = random_poses(model, 3, rng), rng.normal(size=(3, 3))
    operator = subject.points(np.arange(7))
    y, d_pose = operator.jacobian(poses, trans)
    assert d_pose.shape == (3, 7, 3, 12)
    for b in range(3):
        one = operator.jacobian(poses[b], trans[b])
        np.testing.assert_allclose(y[b], one[0], atol=1e-13)
        np.testing.assert_allclose(d_pose[b], one[1], atol=1e-13)


def test_points_of_free_shape_agree_with_the_subject(model, subject):
    rng = np.random.default_rng(7)
    pose, trans = random_poses(model, 1, rng)[0], rng.normal(size=3)
    corners, weights = rng.choice(subject.n_vertices, (8, 3)), rng.dirichlet(np.ones(3), 8)
    points = model.points(corners, weights)
    for betas in (None, BETAS, BETAS[:2]):
        np.testing.assert_allclose(points.operator(betas).evaluate(pose, trans),
                                   model.subject(betas).points(corners, weights).evaluate(pose, trans), atol=1e-12)
    expected = differences(lambda b: points.operator(b).evaluate(pose, trans), BETAS, 1e-3)
    np.testing.assert_allclose(points.shape_jacobian(pose), expected, atol=1e-10)
    whole = np.einsum("lk,lkdc->ldc", weights, model.shape_jacobian(pose)[corners])
    np.testing.assert_allclose(points.shape_jacobian(pose), whole, atol=1e-12)


def test_a_body_of_one_part():
    model = worm_model()
    skeleton = Skeleton(np.zeros(len(model.template.faces), int), [-1], [model.template.vertices.mean(axis=0)])
    from model.pose_space import PoseSpace

    whole = ScapeModel(model.template, skeleton, PoseSpace.identity(skeleton), model.shape_space,
                       np.zeros((1, 3)), np.zeros((3, 3)))
    pose = np.array([[0.3, 0.2, -0.5]])
    R = rotations.exp(pose[0])
    centre = model.template.vertices.mean(axis=0)
    subject = whole.subject()
    np.testing.assert_allclose(subject.vertices(pose), (model.template.vertices - centre) @ R.T + centre,
                               atol=1e-12)
    operator = subject.points(np.arange(5))
    np.testing.assert_allclose(operator.jacobian(pose)[1], differences(operator.evaluate, pose), atol=2e-9)


@pytest.mark.parametrize("pose, trans, word", [
    (np.zeros((3, 3)), None, "pose"), (np.zeros(12), None, "pose"), (np.full((4, 3), np.nan), None, "finite"),
    (np.zeros((4, 3)), np.zeros(2), "trans"), (np.zeros((2, 4, 3)), np.zeros((3, 3)), "trans"),
    (np.zeros((4, 3)), np.array([np.inf, 0, 0]), "finite")])
def test_refuses_bad_poses(model, subject, pose, trans, word):
    for call in (subject.vertices, lambda p, t: model.vertices(p, None, t), subject.points([0]).evaluate):
        with pytest.raises(ValueError, match=word):
            call(pose, trans)


@pytest.mark.parametrize("ids, weights", [([-1], None), ([10**6], None), ([[0, 1, 2]], None), ([0], [[1.0]]),
                                          ([[0, 1]], [[0.5, 0.6]])])
def test_refuses_bad_points(subject, ids, weights):
    with pytest.raises(ValueError, match=r"vertex_ids|weights"):
        subject.points(ids, weights)
