import numpy as np
import pytest
from model_bodies import random_poses, worm_model

from model.features import PoseFeatures, QuadraticLift
from model.learning.config import LearnConfig
from model.learning.regression import Design, by_edges, choose_design, compress, predict_left_out
from model.pose_space import PoseSpace


@pytest.fixture(scope="module")
def model():
    return worm_model()


def edge_error(model, Q):
    v_hat = np.swapaxes(model.template.corners[:, 1:] - model.template.corners[:, :1], -1, -2)
    return lambda predicted: float(np.sqrt((((predicted - Q) @ v_hat) ** 2).sum() / (2 * len(Q) * len(v_hat))))


def learn(model, poses, Q, **settings) -> tuple[Design, PoseSpace]:
    config = LearnConfig(**{"prunings": (0.0,), "ridges": (1e-9,), **settings})
    design = choose_design(model.template, model.skeleton, poses, config, by_edges(model.template, poses, Q))
    return design, design.fit(poses, Q)


def curved(model, poses):
    """Q that also goes with the square of a twist: no linear function of it."""
    return model.pose_space.gradients(poses) + 0.3 * (poses[:, 1, 1]**2)[:, None, None, None] * (
        (model.skeleton.part_of_face == 1)[:, None, None] * np.diag([1.0, -0.5, 0.2]))


def test_a_linear_truth_is_learned_exactly(model):
    rng = np.random.default_rng(4)
    poses = random_poses(model, 30, rng)
    poses[:, 3, 2] = 0                                        # the truth does not use this axis
    design, space = learn(model, poses, model.pose_space.gradients(poses), prunings=(1e-4,))
    new = random_poses(model, 5, rng)
    new[:, 3, 2] = 0
    np.testing.assert_allclose(space.gradients(new), model.pose_space.gradients(new), atol=2e-6)  # float32
    assert design.features.count == model.pose_space.features.count


def test_a_quadratic_truth_needs_products(model):
    rng = np.random.default_rng(5)
    poses, new = random_poses(model, 60, rng), random_poses(model, 8, rng)
    truth = curved(model, new)
    off = {kind: np.abs(learn(model, poses, curved(model, poses), features=kind)[1].gradients(new) - truth).max()
           for kind in ("linear", "quadratic")}
    assert off["quadratic"] < 1e-5 and off["linear"] > 0.05


def test_support_vectors_shrug_off_a_wrong_body(model):
    """One body whose Q is nonsense in one part pulls least squares more than support vectors."""
    rng = np.random.default_rng(7)
    poses, new = random_poses(model, 40, rng), random_poses(model, 10, rng)
    Q = model.pose_space.gradients(poses)
    Q[3, model.skeleton.part_of_face == 1] += 3.0
    judge = edge_error(model, model.pose_space.gradients(new))
    errors = {r: judge(learn(model, poses, Q, regressor=r, ridges=(1e-2,))[1]
                       .gradients(new)) for r in ("ridge", "svr")}
    assert errors["svr"] < 0.5 * errors["ridge"]


@pytest.mark.parametrize("features", ["linear", "quadratic"])
def test_sums_over_the_poses_tell_least_squares_as_much_as_every_pose(model, features):
    """Against ridge regression as it stands in the books, of one group of triangles; more features than poses too."""
    rng = np.random.default_rng(12)
    poses = random_poses(model, 25, rng)
    Q = curved(model, poses) + rng.normal(0, 0.05, (25, len(model.template.faces), 3, 3))
    design, space = learn(model, poses, Q, features=features, ridges=(0.05,))
    _, used, faces = design.groups[1]
    X, flat = design.features.evaluate(poses)[:, used], Q[:, faces].reshape(25, -1)
    slope = np.linalg.solve((X - X.mean(axis=0)).T @ (X - X.mean(axis=0)) + 25 * 0.05 * np.eye(len(used)),
                            (X - X.mean(axis=0)).T @ flat)
    fitted = flat.mean(axis=0) + (X - X.mean(axis=0)) @ slope
    np.testing.assert_allclose(space.gradients(poses)[:, faces].reshape(25, -1), fitted, atol=5e-6)   # float32
    seen = design.prepare(poses)
    np.testing.assert_allclose(seen.of_space(space), seen.sums(space.gradients(poses)), atol=1e-12)


@pytest.mark.parametrize("features", ["linear", "quadratic"])
def test_left_out_predictions_are_those_of_leaving_out(model, features):
    rng = np.random.default_rng(8)
    poses = random_poses(model, 12, rng)
    Q = model.pose_space.gradients(poses) + rng.normal(0, 0.05, (12, len(model.template.faces), 3, 3))
    design, _ = learn(model, poses, Q, features=features, ridges=(0.05,))
    predicted = predict_left_out(design, poses, Q)
    assert design.left_out_error == pytest.approx(edge_error(model, Q)(predicted), rel=1e-9)
    for i in (0, 7):
        rest = np.delete(np.arange(12), i)
        # the penalty counts poses, so it must stay what it was with all of them
        fit = Design(**{**vars(design), "ridge": 0.05 * 12 / 11}).fit(poses[rest], Q[rest])
        np.testing.assert_allclose(predicted[i], fit.gradients(poses[i]), atol=5e-6)


def test_what_predicts_best_is_chosen(model):
    rng = np.random.default_rng(9)
    poses = random_poses(model, 14, rng)
    Q = model.pose_space.gradients(poses) + rng.normal(0, 0.05, (14, len(model.template.faces), 3, 3))
    tried = {}
    for ridge in (1e-4, 0.1, 30.0):
        tried[ridge] = learn(model, poses, Q, ridges=(ridge,))[0].left_out_error
    chosen, _ = learn(model, poses, Q, ridges=tuple(tried))
    assert chosen.ridge == min(tried, key=tried.get)
    assert chosen.left_out_error == pytest.approx(min(tried.values()), rel=1e-12)
    again = choose_design(model.template, model.skeleton, poses, LearnConfig("linear", "ridge", (0.0,), tuple(tried)),
                          by_edges(model.template, poses, Q), chosen)
    assert again.ridge == chosen.ridge


def test_pruning_is_chosen_by_what_it_predicts(model):
    """An axis that hardly moves but decides much must stay; noise on all axes must not."""
    rng = np.random.default_rng(10)
    poses = random_poses(model, 40, rng)
    poses[:, 1, 2] *= 0.1
    design, _ = learn(model, poses, model.pose_space.gradients(poses), prunings=(1e-4, 0.05))
    assert design.pruning == 1e-4


def test_compressing_loses_no_more_than_told(model):
    rng = np.random.default_rng(11)
    poses = random_poses(model, 60, rng)
    _, space = learn(model, poses, curved(model, poses), features="quadratic")
    fewer = compress(space, poses, model.template, 1e-4)
    v_hat = np.swapaxes(model.template.corners[:, 1:] - model.template.corners[:, :1], -1, -2)
    off = ((fewer.gradients(poses) - space.gradients(poses)) @ v_hat) ** 2
    for p, faces in enumerate(space.faces_of_part):
        assert np.sqrt(off[:, faces].sum() / (2 * len(poses) * len(faces))) <= 1.01e-4, p
    assert fewer.features.count < 0.7 * space.features.count
    exact = compress(space, poses, model.template, 0.0)
    np.testing.assert_allclose(exact.gradients(poses), space.gradients(poses), atol=1e-5)


def test_pruned_axes_stay_out_of_the_products(model):
    rng = np.random.default_rng(12)
    poses = random_poses(model, 30, rng)
    poses[:, 1, 0] = 0
    design, _ = learn(model, poses, model.pose_space.gradients(poses), features="quadratic", prunings=(1e-4,))
    moved = poses.copy()
    moved[:, 1, 0] = 1.0
    assert isinstance(design.features, PoseFeatures) and isinstance(design.features.lift, QuadraticLift)
    np.testing.assert_allclose(design.features.evaluate(moved), design.features.evaluate(poses), atol=1e-9)
