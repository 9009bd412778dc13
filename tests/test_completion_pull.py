"""The fast ways of a completion against the plain ones: weighed points, few vertices, distances by one product."""
import numpy as np
import pytest
from completion_bodies import worm_with_prior
from scipy.spatial import cKDTree

from model.fitting import energy
from model.fitting.bodies import FixedBody, ShapedBody
from model.fitting.limbs import nearest_squared
from model.fitting.pull import MatchTargets
from scanprep.geometry.least_squares import Residual, normal_equations

RNG = np.random.default_rng(3)
IDS, MATCHED = np.array([3, 90, 91, 200, 310, 395]), np.array([200, 3, 90, 200, 310, 90])
TARGETS, NORMALS = RNG.normal(0, 0.3, (6, 3)), RNG.normal(size=(6, 3))
NORMALS /= np.linalg.norm(NORMALS, axis=1)[:, None]
TO_POINT, TO_PLANE = np.array([1.0, 0, 0.3, 2, 0, 1]), np.array([0.0, 1, 3, 0.5, 2, 0])
MODEL = worm_with_prior()
BODIES = {"known": FixedBody(MODEL.subject(None)), "shaped": ShapedBody(MODEL)}


def unknowns(body):
    return RNG.normal(0, 0.2, body.n_angles + 3 + body.n_betas)


@pytest.mark.parametrize("body", BODIES.values(), ids=BODIES)
def test_one_residual_of_three_rows_is_that_of_place_and_plane(body):
    x = unknowns(body)
    points = body.follow(MATCHED, x)(x[None])
    off, root = points.positions - TARGETS, np.sqrt(TO_PLANE)
    to_planes = Residual(root * (NORMALS * off).sum(axis=-1),
                         root[:, None] * np.einsum("ld,...ldp->...lp", NORMALS, points.jacobian))
    plain = normal_equations([energy.point_to_point(points, TARGETS, TO_POINT), to_planes])
    pull = MatchTargets(*body.gather(MATCHED, x), TARGETS, NORMALS, TO_POINT, TO_PLANE)
    nothing = normal_equations([energy.stay_near(x[None], x, np.zeros(len(x)))])
    for ours, theirs in zip(pull.equations(x[None], nothing).dense, plain, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-9)
    assert sum(part.sum() for part in pull.energies(x)) == pytest.approx(plain.energy[0])


def test_few_vertices_of_a_body_are_those_of_the_whole():
    x = unknowns(BODIES["known"])
    few = BODIES["known"].some(IDS)
    np.testing.assert_allclose(few.vertices(x), BODIES["known"].vertices(x)[IDS], atol=1e-12)
    np.testing.assert_allclose(few.near(np.array([1, 4]), x).positions(x), few.vertices(x)[[1, 4]], atol=1e-12)


@pytest.mark.parametrize("ids", [[4, 1, 4], [5, 0, 1, 5, 3, 2]], ids=["some", "most"])
def test_vertices_are_found_among_the_points_that_are_gathered(ids):
    few, x = BODIES["known"].some(IDS), unknowns(BODIES["known"])
    points, at = few.gather(np.array(ids), x)
    y, columns = points.columns(x)
    np.testing.assert_allclose(y[at], few.vertices(x)[ids], atol=1e-12)
    np.testing.assert_allclose(columns[..., at], few.near(np.array(ids), x).columns(x)[1], atol=1e-12)


def test_few_vertices_of_an_unknown_shape_are_rough_and_their_own_derivative():
    whole = BODIES["shaped"]
    few, x = whole.some(IDS), unknowns(whole)
    rest = np.r_[np.zeros(whole.n_angles + 3), x[whole.n_angles + 3:]]
    np.testing.assert_allclose(few.vertices(rest), whole.vertices(rest)[IDS], atol=1e-9)     # at rest it is exact
    y, columns = few.near(np.arange(6), x).columns(x)
    np.testing.assert_allclose(y, few.vertices(x), atol=1e-12)
    ahead = x.copy()
    ahead[-1] += 1e-4
    np.testing.assert_allclose(columns[-1].T, (few.vertices(ahead) - few.vertices(x)) / 1e-4, atol=1e-8)
    assert np.linalg.norm(few.vertices(x) - whole.vertices(x)[IDS], axis=1).max() < 0.02
    held = few.fix_shape(x)
    np.testing.assert_allclose(held.vertices(x[:held.n_angles + 3]), whole.vertices(x)[IDS], atol=1e-9)


def test_nearest_places_as_a_tree_finds_them():
    places, points = RNG.normal(0, 0.5, (5, 40, 3)) + 2, RNG.normal(0, 0.5, (30, 3)) + 2
    there = np.stack([cKDTree(one).query(points)[0] for one in places])
    np.testing.assert_allclose(np.sqrt(nearest_squared(places, points)), there, atol=1e-3)
