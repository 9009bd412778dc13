import numpy as np
import pytest
from completion_bodies import worm_with_prior
from derivatives import differences

from model.fitting import energy
from model.fitting.bodies import FixedBody, ShapedBody, anchor_at
from model.priors import gaussian_prior
from scanprep.geometry import rotations

RNG = np.random.default_rng(3)
MODEL = worm_with_prior()
FIXED, SHAPED = FixedBody(MODEL.subject(None)), ShapedBody(MODEL)
PRIOR = gaussian_prior(MODEL.pose_mean, MODEL.pose_covariance)
IDS = RNG.choice(398, 5, replace=False)
TRIPLES = RNG.choice(398, (6, 3), replace=False)
TARGETS = RNG.normal(size=(5, 3))
HOLED = np.where(np.arange(5)[:, None] == 2, np.nan, TARGETS)
NORMALS = RNG.normal(size=(5, 3)) / 2
WEIGHTS = RNG.random(5)


def unknowns(body, seed=0):
    return np.random.default_rng(seed).normal(0, 0.4, body.n_angles + 3 + body.n_betas)


def points(body, x0):
    follow = body.follow(IDS, x0)
    return lambda x: energy.point_to_point(follow(x), HOLED, WEIGHTS)


def skin(body, x0):
    follow = body.follow(TRIPLES, x0, np.tile([0.5, 0.3, 0.2], (6, 1)))
    return lambda x: energy.point_to_point(energy.above_skin(follow(x), np.array([0.01, 0.03])), TARGETS[:2],
                                           WEIGHTS[:2])


ENERGIES = {
    "point_to_point": points,
    "above_skin": skin,
    "pose_prior": lambda body, x0: lambda x: energy.pose_prior_term(x, PRIOR, 2.0),
    "upright": lambda body, x0: lambda x: energy.upright_term(x, np.array([0, 0.6, 0.8]), np.array([0, 1.0, 0]), 0.3),
    "shape_prior": lambda body, x0: lambda x: energy.shape_prior(x, body.n_angles + 3, 2.0),
    "stay_near": lambda body, x0: lambda x: energy.stay_near(x, x0 + 0.1, np.arange(len(x0)) / 3),
}


@pytest.mark.parametrize("name", ENERGIES)
@pytest.mark.parametrize("body", [FIXED, SHAPED], ids=["known", "unknown"])
def test_jacobian_is_the_finite_difference(name, body):
    x = unknowns(body)
    residual = ENERGIES[name](body, x)
    got = residual(x[None])
    # what turns with the pose in the derivative by betas is held between two matchings, so it is tested at betas
    # of the subject that is held
    np.testing.assert_allclose(got.jacobian, differences(lambda x: residual(x[None]).values, x), atol=2e-7)


@pytest.mark.parametrize("name", ENERGIES)
def test_batch_is_the_loop(name):
    x = np.stack([unknowns(FIXED, s) for s in range(3)])
    residual = ENERGIES[name](FIXED, x[0])
    all_at_once = residual(x)
    for b in range(3):
        one = residual(x[b][None])
        np.testing.assert_allclose(all_at_once.values[b], one.values[0], atol=1e-12)
        np.testing.assert_allclose(all_at_once.jacobian[b], one.jacobian[0], atol=1e-12)
        np.testing.assert_allclose(all_at_once.energy[b], (one.values[0]**2).sum())


def test_what_is_expected_costs_nothing_and_what_is_off_its_weight():
    """[SCAPE] Eq. 11 as damping: w d² for every unknown that is off by d."""
    x, weights = np.arange(1.0, 6.0), np.array([0.0, 1, 2, 3, 4])
    assert energy.stay_near(x, x, weights).energy == 0
    assert energy.stay_near(x + 0.1, x, weights).energy == pytest.approx(0.01 * 10)


def test_outliers_lose_all_but_a_quarter_of_their_weight_at_the_scale():
    """1 / (1 + (d/s)²)², so that what an outlier costs, w d², falls beyond the scale."""
    found = energy.geman_mcclure(np.array([0.0, 0.05, 0.1, 0.15]), 0.05)
    np.testing.assert_allclose(found, [1, 1 / 4, 1 / 25, 1 / 100])


def test_a_target_that_was_not_seen_counts_nothing():
    x = unknowns(FIXED)[None]
    follow = FIXED.follow(IDS, x[0])
    seen = [0, 1, 3, 4]
    whole = energy.point_to_point(follow(x), HOLED, WEIGHTS)
    some = energy.point_to_point(FIXED.follow(IDS[seen], x[0])(x), TARGETS[seen], WEIGHTS[seen])
    np.testing.assert_allclose(whole.energy, some.energy)
    np.testing.assert_allclose(np.einsum("bmp,bm->bp", whole.jacobian, whole.values),
                               np.einsum("bmp,bm->bp", some.jacobian, some.values), atol=1e-12)


def test_points_above_the_skin_keep_their_distance_and_turn_with_the_body():
    x = unknowns(FIXED)
    follow, distance = FIXED.follow(TRIPLES, x, np.tile([0.5, 0.3, 0.2], (6, 1))), np.array([0.01, 0.03])
    supports, points = follow(x[None]), energy.above_skin(follow(x[None]), distance)
    base = supports.positions[0].reshape(2, 3, 3)
    up = points.positions[0] - base[:, 0]
    np.testing.assert_allclose(np.linalg.norm(up, axis=1), distance)
    for side in (1, 2):
        np.testing.assert_allclose(np.einsum("ld,ld->l", up, base[:, side] - base[:, 0]), 0, atol=1e-14)
    np.testing.assert_allclose(energy.rise_above_skin(supports.positions, distance), points.positions, atol=1e-14)
    turned = x.copy()
    turn = rotations.exp(np.array([0.3, -0.2, 0.9]))
    turned[:3] = rotations.log(turn @ rotations.exp(x[:3]))
    again = energy.above_skin(follow(turned[None]), distance).positions[0]
    np.testing.assert_allclose(again - again[0], (points.positions[0] - points.positions[0, 0]) @ turn.T, atol=1e-12)


def test_known_and_unknown_shape_agree_with_the_model():
    x = unknowns(SHAPED)
    pose, trans, betas = SHAPED.split(x)
    y = MODEL.vertices(pose, betas, trans)
    np.testing.assert_allclose(SHAPED.vertices(x), y, atol=1e-12)
    np.testing.assert_allclose(SHAPED.follow(IDS, x)(x[None]).positions[0], y[IDS], atol=1e-9)
    held = ShapedBody(MODEL)
    held.RENEW = np.inf                                            # never rebuilds, yet affine in betas
    np.testing.assert_allclose(held.follow(IDS, x)(x[None]).positions[0], y[IDS], atol=1e-9)


def test_derivatives_by_betas_are_carried_with_the_bones():
    """They are exact where they were stitched and after a turn of the whole, and close after a turn of the joints."""
    x = unknowns(SHAPED)
    pose = x[:12].reshape(4, 3)
    anchor = anchor_at(MODEL, pose)
    ids = np.arange(0, 398, 7)
    np.testing.assert_allclose(anchor.carry(ids, pose), MODEL.shape_jacobian(pose, ids), atol=1e-12)
    whole = pose.copy()
    whole[0] = rotations.log(rotations.exp(np.array([1.0, -0.4, 0.3])) @ rotations.exp(pose[0]))
    np.testing.assert_allclose(anchor.carry(ids, whole), MODEL.shape_jacobian(whole, ids), atol=1e-12)
    np.testing.assert_allclose(anchor.largest_angle(whole), np.linalg.norm([1.0, -0.4, 0.3]), atol=1e-9)
    bent = pose + np.random.default_rng(5).normal(0, 0.1, (4, 3)) * [[0], [1], [1], [1]]
    exact = MODEL.shape_jacobian(bent, ids)
    off = np.linalg.norm(anchor.carry(ids, bent) - exact) / np.linalg.norm(exact)
    still = np.linalg.norm(anchor.carry(ids, pose) - exact) / np.linalg.norm(exact)
    assert off < 0.05 and off < 0.6 * still
