import numpy as np
import pytest
from completion_bodies import MEAN, worm_with_prior

from model.fitting import energy
from model.fitting.bodies import FixedBody, ShapedBody
from model.fitting.confidence import distance_to_seen, estimate_error, posterior_error, probability_within
from model.priors import gaussian_prior
from scanprep.geometry.least_squares import normal_equations

MODEL = worm_with_prior()
PRIOR = gaussian_prior(MODEL.pose_mean, MODEL.pose_covariance)


def precision(body, x, ids):
    follow = body.follow(ids, x)
    weights = np.full(len(ids), 0.005**-2)
    targets = body.vertices(x)[ids]
    terms = [energy.point_to_point(follow(x[None]), targets, weights), energy.pose_prior_term(x[None], PRIOR),
             energy.shape_prior(x[None], body.n_angles + 3)]
    return normal_equations(terms).hessian[0]


@pytest.mark.parametrize("body", [FixedBody(MODEL.subject(None)), ShapedBody(MODEL)], ids=["known", "unknown"])
def test_posterior_error_is_the_spread_of_draws_from_the_posterior(body):
    x = np.concatenate([MEAN.ravel(), [0.1, 0, 0.2], np.full(body.n_betas, 0.3)])
    H = precision(body, x, np.arange(0, 398, 2))                     # all over the body: the error is small
    drawn = x + np.linalg.solve(np.linalg.cholesky(H).T, np.random.default_rng(0).normal(size=(len(x), 400))).T
    places = np.stack([body.vertices(d) for d in drawn])
    measured = np.sqrt(((places - body.vertices(x))**2).sum(axis=2).mean(axis=0))
    np.testing.assert_allclose(posterior_error(body, x, H), measured, rtol=0.15)


def test_what_nobody_saw_is_less_certain():
    """Points on the middle of the worm alone: the ends, that hang on joints, may be anywhere the prior allows."""
    body = FixedBody(MODEL.subject(None))
    x = np.concatenate([MEAN.ravel(), np.zeros(3)])
    part = MODEL.skeleton.part_of_vertex(MODEL.template)
    error = posterior_error(body, x, precision(body, x, np.flatnonzero(part == 0)))
    far = [error[part == p].mean() for p in (0, 2, 3)]
    assert far[0] < 0.005 and far[1] > 10 * far[0] and far[2] > 1.5 * far[1]


def test_the_error_sets_in_away_from_the_data():
    posterior, away = np.full(6, 0.02), np.array([0, 0.01, 0.03, 0.1, 1, np.inf])
    error = estimate_error(posterior, away, 0.001)
    assert error[0] == pytest.approx(0.001) and (np.diff(error) >= 0).all()
    assert error[-1] > 0.02 and error[-1] == pytest.approx(error[-2], rel=1e-3)
    assert (estimate_error(2 * posterior, away, 0.001)[1:] > error[1:]).all()
    assert np.isfinite(estimate_error(posterior, away, np.nan)).all()   # no point of the scan was used


def test_errors_set_in_within_millimetres_and_add_up_as_squares():
    """As chosen on half views of tuning bodies (`half_views.py`): half of the square is there at 14 mm times log 2."""
    half, far = 0.014 * np.log(2), np.inf
    for left_out, beyond in ((0.01, 0.0085), (None, 0.0075)):
        error = estimate_error(np.full(3, 0.02), np.array([0, half, far]), 0.002, left_out)
        square = (1.4 * 0.02)**2 + beyond**2
        np.testing.assert_allclose(error**2, 0.002**2 + square * np.array([0, 0.5, 1]))


def test_distance_to_the_nearest_seen_vertex_runs_along_the_surface():
    mesh = MODEL.template
    x = mesh.vertices[:, 0] - mesh.vertices[:, 0].min()
    away = distance_to_seen(mesh, x < 0.3)
    assert away[x < 0.3].max() == 0
    far = np.argmax(x)
    assert x[far] - 0.3 <= away[far] < 1.2 * (x[far] - 0.2)
    assert np.isinf(distance_to_seen(mesh, np.zeros(len(x), bool))).all()


@pytest.mark.parametrize("error", [0.003, 0.01, 0.05])
def test_confidence_is_the_share_of_gaussian_errors_within_the_tolerance(error):
    off = np.linalg.norm(np.random.default_rng(0).normal(0, error / np.sqrt(3), (40000, 3)), axis=1)
    np.testing.assert_allclose(probability_within(np.array([error]), 0.01), (off < 0.01).mean(), atol=0.008)
