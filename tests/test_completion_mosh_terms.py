from dataclasses import replace

import numpy as np
import pytest
from completion_bodies import worm_with_prior
from derivatives import differences

from completion.mocap.marker_sets.layout import MarkerLayout
from completion.mocap.pose.marked_body import supports
from completion.mocap.subject import latent_fit as terms
from completion.mocap.subject.attachment import above_triangles, latent_markers, simulate_markers
from completion.mocap.subject.latent_fit import LatentPoints
from model.fitting import energy
from model.fitting.energy import MovingPoints
from model.priors import gaussian_prior
from scanprep.geometry import rotations
from scanprep.geometry.least_squares import Residual

MODEL = worm_with_prior()
K, L, REST = MODEL.n_betas, 6, np.zeros((4, 3))
LATENT = LatentPoints(MODEL.vertices(REST, np.zeros(K)), MODEL.shape_jacobian(REST))
LAYOUT = MarkerLayout(tuple("ABCDEF"), np.array([6, 75, 130, 200, 255, 330]), 0.02)
PRIOR = gaussian_prior(MODEL.pose_mean, MODEL.pose_covariance)
KINDS = ["triangle", "neighbourhood"]


def mean_mesh(betas=None):
    return MODEL.template.with_vertices(LATENT.at(np.zeros(K) if betas is None else betas))


def signed_distance(points, mesh):
    """Distances (n,) from a surface by libigl, negative inside, with the nearest triangles and points."""
    import igl

    return igl.signed_distance(points, mesh.vertices, mesh.faces, sign_type=igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL)[:3]


def beside(mesh, seed=0, off=0.02):
    """Points a little above the skin, beside the vertices of the layout."""
    return LAYOUT.place(mesh) + np.random.default_rng(seed).normal(0, off, (L, 3))


def hung(kind, seed=0):
    mesh = mean_mesh()
    markers = latent_markers(mesh, beside(mesh, seed), kind)
    return markers, markers.coefficients(mesh.vertices, beside(mesh, seed))


def shared(seed=1):
    """Unknowns z: betas, and coefficients near those of the markers."""
    rng = np.random.default_rng(seed)
    return lambda c: np.concatenate([rng.normal(0, 1, K), (c + rng.normal(0, 0.004, c.shape)).ravel()])


def of_latent(make):
    """A term of the latent markers of both attachments, as a function of z."""
    def build(kind):
        markers, c = hung(kind)
        at = LATENT.combine(markers.ids, markers.weights)
        corners = LATENT.combine(markers.corners.reshape(-1, 1), np.ones((3 * L, 1)))
        usual = LATENT.combine(*supports(MODEL.template, LAYOUT))
        return lambda z: make(terms.latent_places(kind, at, z), corners.moving(z),
                              energy.above_skin(usual.moving(z), np.full(L, 0.02))), shared()(c)
    return build


def of_frames(kind):
    """The simulated markers of one frame against targets, as a function of (pose, trans, z)."""
    markers, c = hung(kind)
    points, targets = MODEL.points(markers.ids, markers.weights), np.random.default_rng(7).normal(0, 1, (1, L, 3))
    targets[:, 2] = np.nan
    z = shared()(c)
    x = np.concatenate([np.random.default_rng(2).normal(0, 0.4, 15), z])

    def term(x):
        pose, trans, betas = x[None, :12].reshape(1, 4, 3), x[None, 12:15], x[15:15 + K]
        y, d_pose = points.operator(betas).jacobian(pose, trans)
        moving = energy.moving_points(y, d_pose, points.shape_jacobian(pose))
        found, frame = simulate_markers(kind, moving, x[15 + K:].reshape(-1, 3))
        J = np.concatenate([found.jacobian, terms.each_own(frame)], axis=-1)
        residual = terms.marker_term(MovingPoints(found.positions, J), targets, np.arange(1.0, L + 1))
        return Residual(residual.values[0], residual.jacobian[0])

    return term, x


TERMS = {
    "data": of_frames,
    "surface": of_latent(lambda m, corners, usual: terms.surface_term(m, corners, *(np.full((2, L), 0.01)), 3.0)),
    "usual_place": of_latent(lambda m, corners, usual: terms.place_term(m, usual, np.arange(1.0, L + 1))),
    "shape": lambda kind: ((lambda z: terms.shape_term(z, K, 2.0)), np.random.default_rng(4).normal(size=K + 3 * L)),
    "pose": lambda kind: ((lambda x: energy.pose_prior_term(x, PRIOR, 0.25)), np.random.default_rng(5).normal(size=15)),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", TERMS)
def test_jacobian_is_the_finite_difference(name, kind):
    term, x = TERMS[name](kind)
    got = term(x)
    assert got.jacobian.shape == (len(got.values), len(x)) and np.abs(got.jacobian).max() > 0
    np.testing.assert_allclose(got.jacobian, differences(lambda x: term(x).values, x), atol=2e-5, rtol=1e-6)


@pytest.mark.parametrize(("height", "energy"), [
    (-0.01, 4.0), (0.0, 1.0), (0.0101, 0.0), (0.06, 0.0), (0.1099, 0.0), (0.13, 4.0)])
def test_an_unknown_distance_costs_nothing_between_its_limits(height, energy):
    """[MoSh] Eq. 18 with the best distance of 1 to 11 cm."""
    at = MovingPoints(np.array([[0.0, 0.0, height]]), np.eye(3)[None])
    corners = MovingPoints(np.array([[-1.0, -1, 0], [1, -1, 0], [0, 2, 0]]), np.zeros((3, 3, 3)))
    found = terms.surface_term(at, corners, np.array([0.01]), np.array([0.11]), 1.0)
    assert found.energy == pytest.approx(energy, abs=1e-9)
    assert np.any(found.jacobian) == (energy > 0)


def test_weights_are_per_square_centimetre():
    """A marker 2 cm from its place costs four times the weight, in every term of distances."""
    still = np.zeros((1, 3, 1))
    at, there = MovingPoints(np.array([[0.0, 0.0, 0.03]]), still), MovingPoints(np.array([[0.0, 0.0, 0.01]]), still)
    corners = MovingPoints(np.array([[-1.0, -1, 0], [1, -1, 0], [0, 2, 0]]), np.zeros((3, 3, 1)))
    assert terms.marker_term(at, there.positions, np.array([0.75])).energy == pytest.approx(3.0)
    assert terms.place_term(at, there, np.array([0.25])).energy == pytest.approx(1.0)
    assert terms.surface_term(at, corners, *np.array([[0.01], [0.01]]), 100.0).energy == pytest.approx(400.0)


def test_priors_are_annealed_and_data_and_distance_from_the_skin_are_not():
    """[MoSh] Eq. 23 begins with 40 times E_I, E_beta and E_theta, and with E_D and E_S as they are."""
    rng = np.random.default_rng(3)
    fit = terms.LatentFit(MODEL, LAYOUT, beside(mean_mesh())[None], terms.PersonConfig(n_betas=K))
    state = fit.start(rng.normal(0, 0.3, (1, 15)))
    z, weights, usual = state.z + rng.normal(0, 0.01, K + 3 * L), fit.weights(state), fit._usual(state.layout)

    def energies(factor):
        found = fit.of_frames(state, state.x, z, weights, factor) | fit.shared_terms(state, usual, z, factor)
        return {name: float(term.energy.sum()) for name, term in found.items()}

    once, begun = energies(1.0), energies(40.0)
    assert {name: begun[name] / value for name, value in once.items()} == pytest.approx(
        {"data": 1, "surface": 1, "initial": 40, "shape": 40, "pose": 40})


def test_wands_may_stand_off_and_bars_may_be_worn_without():
    """A wand reaches from the layout's distance outwards, a bar also down to the skin, at the radius of a marker."""
    layout = MarkerLayout(("on_skin", "wand", "bar"), np.arange(3), np.array([0.0095, 0.0095, 0.05]), wands=("wand",))
    least, greatest = terms.distance_reach(layout, 0.1)
    np.testing.assert_allclose(least, [0.0095, 0.0095, 0.0095])
    np.testing.assert_allclose(greatest, [0.0095, 0.1095, 0.15])
    for same in terms.distance_reach(layout, 0.0):
        np.testing.assert_array_equal(same, layout.distances)


def test_what_both_sides_say_of_their_distance_counts_where_they_are_worn_alike():
    """24 and 4 mm from the usual distance are 14 mm together, within 16 mm: neither is on a wand. One alone is."""
    off = np.array([0.024, 0.004, 0, 0, 0, 0])
    for labels, named in ((("LTHI", "RTHI", *"ABCD"), True), (("LTHI", "LTIB", *"ABCD"), False)):
        layout = MarkerLayout(labels, LAYOUT.vertices, 0.0095, wands=labels[:2])
        fit = terms.LatentFit(MODEL, layout, beside(mean_mesh())[None], terms.PersonConfig(n_betas=K))
        places = replace(layout, distances=0.0095 + off).place(mean_mesh())
        state = fit._attach(np.zeros((1, 15)), np.zeros(K), places, layout, fit.reach, False)
        np.testing.assert_allclose(fit._measure_distances(state, False).layout.distances, 0.0095 + off, atol=1e-9)
        last = np.asarray(fit._measure_distances(state, True).layout.distances)
        np.testing.assert_allclose(last[:2], [0.0095 if named else 0.0335, 0.0095], atol=1e-9)


def test_loose_markers_are_held_by_twenty_centimetres():
    layout = replace(LAYOUT, loose=("B",))
    fit = terms.LatentFit(MODEL, layout, beside(mean_mesh())[None], terms.PersonConfig(n_betas=K, initial=1.0))
    np.testing.assert_allclose(fit.place_weight, np.where(np.arange(L) == 1, 20.0**-2, 1.0))


@pytest.mark.parametrize("kind", KINDS)
def test_markers_are_where_they_were_hung_and_move_with_the_body(kind):
    mesh = mean_mesh()
    points = beside(mesh)
    markers = latent_markers(mesh, points, kind)
    c = markers.coefficients(mesh.vertices, points)
    np.testing.assert_allclose(markers.places(mesh.vertices, c), points, atol=1e-12)
    np.testing.assert_array_equal(markers.corners, mesh.faces[signed_distance(points, mesh)[1]])
    R, t = rotations.exp(np.array([0.4, -1.1, 0.7])), np.array([0.3, 2.0, -1.0])
    np.testing.assert_allclose(markers.places(mesh.vertices @ R.T + t, c), points @ R.T + t, atol=1e-12)
    pose = np.random.default_rng(2).normal(0, 0.4, (4, 3))
    posed = MODEL.vertices(pose, np.zeros(K))
    supports_ = MovingPoints(markers.supports(posed), np.zeros((3 * L, 3, 1)))
    np.testing.assert_allclose(simulate_markers(kind, supports_, c)[0].positions, markers.places(posed, c), atol=1e-12)


def test_the_neighbourhood_spreads_over_all_edges_of_the_nearest_vertex():
    """Its weights are those of least norm that reach the place in the tangent plane: [MoSh] Eq. 3."""
    mesh = mean_mesh()
    points = beside(mesh)
    markers = latent_markers(mesh, points, "neighbourhood")
    for i, point in enumerate(points):
        centre = markers.ids[3 * i, 0]
        corners = mesh.vertices[markers.corners[i]]
        assert centre == markers.corners[i][np.linalg.norm(corners - point, axis=1).argmin()]
        ring = np.setdiff1d(markers.ids[3 * i + 1], centre)
        adjacency = mesh.vertex_adjacency
        assert set(ring) == set(adjacency.indices[adjacency.indptr[centre]:adjacency.indptr[centre + 1]])
        sides = markers.supports(mesh.vertices)[3 * i + 1:3 * i + 3] - mesh.vertices[centre]
        normal = mesh.vertex_normals[centre]
        flat = sides - (sides @ normal)[:, None] * normal
        np.testing.assert_allclose(flat @ flat.T, np.eye(2), atol=1e-12)
        spokes = mesh.vertices[ring] - mesh.vertices[centre]
        spokes -= (spokes @ normal)[:, None] * normal
        for row, side in zip(markers.weights[3 * i + 1:3 * i + 3], flat, strict=True):
            mine = np.array([row[markers.ids[3 * i + 1] == v].sum() for v in ring])
            least = np.linalg.lstsq(spokes.T, side, rcond=None)[0]
            np.testing.assert_allclose(mine, least, atol=1e-10)
    with pytest.raises(ValueError, match="attachment: expected triangle or neighbourhood, got 'glue'"):
        latent_markers(mesh, points, "glue")


def test_distance_from_the_nearest_triangle_is_that_from_the_surface():
    mesh = mean_mesh()
    rng = np.random.default_rng(8)
    points = np.concatenate([beside(mesh, seed, 0.05) for seed in range(20)]) + rng.normal(0, 0.01, (20 * L, 3))
    whole, faces, nearest = signed_distance(points, mesh)
    values, by_points, by_corners = above_triangles(points, mesh.corners[faces])
    outside = whole > 1e-6                       # beyond a sharp edge the side of one triangle is not that of both
    np.testing.assert_allclose(np.abs(values), np.abs(whole), atol=1e-12)
    same = outside & (values > 0)
    assert same.sum() > 0.95 * outside.sum() > 20
    away = (points - nearest)[same] / whole[same, None]
    np.testing.assert_allclose(by_points[same], away, atol=1e-9)
    np.testing.assert_allclose(by_corners[same].sum(axis=1), -away, atol=1e-9)
