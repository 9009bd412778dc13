import numpy as np
import pytest
from derivatives import differences
from model_bodies import random_poses, worm_model

from model.fitting.vertices import FitConfig, _equations, fit_pose, fit_shape, share_of_vertices, spread_vertices
from scanprep.geometry import rotations


@pytest.fixture(scope="module")
def model():
    return worm_model()


def test_pose_follows_a_rigid_motion_of_the_data(model):
    rng = np.random.default_rng(1)
    subject = model.subject()
    data = subject.vertices(random_poses(model, 1, rng)[0]) + rng.normal(0, 0.005, model.template.vertices.shape)
    R, shift = rotations.exp([1.0, -2.0, 0.5]), np.array([3.0, -1, 2])
    tight = FitConfig(tolerance=1e-12)
    a, b = fit_pose(subject, data, tight), fit_pose(subject, data @ R.T + shift, tight)
    np.testing.assert_allclose(b.vertices, a.vertices @ R.T + shift, atol=1e-5)
    np.testing.assert_allclose(b.pose[1:], a.pose[1:], atol=1e-4)
    assert 0.005 < a.rms < 0.005 * np.sqrt(3)               # the noise is left, and not more


@pytest.mark.parametrize("sample", [60, 10**6])
def test_shape_and_pose_of_the_models_own_bodies(model, sample):
    rng = np.random.default_rng(2)
    for _ in range(3):
        pose, betas, trans = random_poses(model, 1, rng, 0.3)[0], rng.normal(size=3), rng.normal(size=3)
        fit = fit_shape(model, model.vertices(pose, betas, trans), FitConfig(sample=sample))
        assert fit.converged and fit.rms < 1e-5
        np.testing.assert_allclose(fit.betas, betas, atol=1e-3)


def test_polish_finds_the_minimum_over_all_vertices(model):
    """From 60 vertices with gradients alone, as from derivatives of them all."""
    rng = np.random.default_rng(4)
    body = model.vertices(random_poses(model, 1, rng, 0.3)[0], [1.0, 0, -1]) + rng.normal(0, 0.01, (398, 3))
    rough, fast, whole = (fit_shape(model, body, FitConfig(sample=sample, polish=polish, tolerance=1e-10))
                          for sample, polish in ((60, 0), (60, 40), (398, 0)))
    assert fast.converged and rough.rms > 1.001 * whole.rms
    assert fast.rms == pytest.approx(whole.rms, rel=1e-8)
    np.testing.assert_allclose(fast.vertices, whole.vertices, atol=2e-6)
    np.testing.assert_allclose(fast.betas, whole.betas, atol=1e-4)


def test_shares_count_every_vertex_once(model):
    vertices = model.template.vertices
    chosen = spread_vertices(vertices, 40)
    far = np.linalg.norm(vertices[:, None] - vertices[chosen], axis=2)
    share = share_of_vertices(vertices, chosen)
    assert share.sum() == len(vertices) and share.min() >= 1
    at_least = ((far <= far.min(axis=1, keepdims=True) + 1e-12).sum(axis=1) == 1)      # those with one nearest
    assert (share >= np.bincount(far[at_least].argmin(axis=1), minlength=40)).all()


def test_points_count_by_their_weights(model):
    """The energy is the weighted sum of squared distances, and its derivative that of the finite difference."""
    ids, rng = np.arange(0, 398, 40), np.random.default_rng(6)
    x, target, weights = rng.normal(0, 0.3, 3 * 4 + 3 + model.n_betas), rng.normal(size=(10, 3)), rng.uniform(1, 9, 10)
    equations = _equations(model.points(ids), target, weights)

    def energy(x):
        return weights @ ((model.vertices(x[:12].reshape(4, 3), x[15:], x[12:15])[ids] - target)**2).sum(axis=1)
    found = equations(x[None])
    np.testing.assert_allclose(found.energy, energy(x), rtol=1e-6)
    np.testing.assert_allclose(2 * found.gradient[0], differences(energy, x, 1e-5), rtol=1e-4, atol=1e-3)


def test_shape_with_fewer_components(model):
    truth = model.vertices(np.zeros((4, 3)), [1.5])
    fit = fit_shape(model, truth, FitConfig(n_betas=1))
    assert fit.betas.shape == (3,) and fit.betas[1] == fit.betas[2] == 0
    assert fit.betas[0] == pytest.approx(1.5, abs=1e-3)


@pytest.mark.parametrize("vertices, word", [(np.zeros((5, 3)), "shape"), (np.full((398, 3), np.nan), "finite")])
def test_refuses_bad_vertices(model, vertices, word):
    with pytest.raises(ValueError, match=word):
        fit_pose(model.subject(), vertices)
    with pytest.raises(ValueError, match=word):
        fit_shape(model, vertices)
