import numpy as np
import pytest

from model.shape_space import learn_shape_space


@pytest.fixture(scope="module")
def people():
    rng = np.random.default_rng(0)
    betas = rng.normal(size=(40, 3)) * [3, 2, 1]
    U = np.linalg.qr(rng.normal(size=(9 * 20, 3)))[0].T
    mean = rng.normal(size=9 * 20)
    return (mean + betas @ U).reshape(40, 20, 3, 3), U


def test_spans_what_the_data_span(people):
    S, U = people
    space = learn_shape_space(S, 10)
    assert space.count == 3
    flat = space.components.reshape(3, -1).astype(float)
    np.testing.assert_allclose(flat @ U.T @ U, flat, atol=1e-5)
    assert space.explained[-1] == pytest.approx(1, abs=1e-6)
    assert (np.diff(space.variances) < 0).all()


def test_betas_have_zero_mean_and_unit_variance(people):
    S, _ = people
    space = learn_shape_space(S, 3)
    flat = space.components.reshape(3, -1).astype(float)
    betas = np.linalg.lstsq(flat.T, (S - space.mean).reshape(40, -1).T, rcond=None)[0]
    np.testing.assert_allclose(betas.mean(axis=1), 0, atol=1e-5)
    np.testing.assert_allclose(betas @ betas.T / 40, np.eye(3), atol=1e-4)
    np.testing.assert_allclose(space.betas_of(S), betas.T, atol=1e-4)
    np.testing.assert_allclose((flat**2).sum(axis=1), space.variances, rtol=1e-5)
    for i in (0, 17):
        np.testing.assert_allclose(space.gradients(betas[:, i]), S[i], atol=1e-5)


def test_zero_is_the_mean_and_none_the_template(people):
    space = learn_shape_space(people[0], 2)
    np.testing.assert_allclose(space.gradients(np.zeros(2)), people[0].mean(axis=0), atol=1e-6)
    np.testing.assert_array_equal(space.gradients(None), np.broadcast_to(np.eye(3), (20, 3, 3)))
    np.testing.assert_array_equal(space.gradients([0.5]), space.gradients([0.5, 0.0]))


@pytest.mark.parametrize("flipped", [1, -1])
def test_more_of_a_component_is_more_volume(people, flipped):
    """Whatever sign the decomposition gives."""
    S, U = people
    volumes = 0.07 + 0.01 * flipped * (S.reshape(40, -1) @ U.T) @ [1.0, -2.0, 3.0]
    space = learn_shape_space(S, 3, volumes)
    betas = space.betas_of(S)
    assert ((volumes - volumes.mean()) @ betas > 0).all()


def test_never_more_components_than_people_allow():
    S = np.random.default_rng(1).normal(size=(4, 20, 3, 3))
    assert learn_shape_space(S, 40).count == 3


@pytest.mark.parametrize("betas", [np.zeros(4), np.zeros((1, 2)), [np.nan]])
def test_refuses_bad_betas(people, betas):
    with pytest.raises(ValueError, match="betas"):
        learn_shape_space(people[0], 3).gradients(betas)
