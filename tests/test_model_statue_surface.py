"""The shape-constrained deformable surface: local shape, soft assignment, fit."""
import numpy as np
import pytest
from derivatives import slope
from scanned_shapes import distortion
from scipy.spatial import ConvexHull
from scipy.special import logsumexp

from model.statue.fit import spread_flat
from model.statue.registration.local_shape import local_shape
from model.statue.registration.soft_assignment import DirectedPoints, assign_softly
from model.statue.registration.surface_fit import fit_surface
from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh, template_problem
from scanprep.geometry.surface import Surface


def ball(count: int, seed: int) -> Mesh:
    """An irregular triangulation of the unit sphere: the hull of points on a spiral, shaken a little."""
    k = np.arange(count) + 0.5
    turn, z = np.pi * (1 + 5**0.5) * k, 1 - 2 * k / count
    p = np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z], axis=1)
    p += 0.8 / np.sqrt(count) * (np.random.default_rng(seed).random((count, 3)) - 0.5)
    p /= np.linalg.norm(p, axis=1, keepdims=True)
    f = ConvexHull(p).simplices
    outward = np.einsum("fd,fd->f", np.cross(p[f[:, 1]] - p[f[:, 0]], p[f[:, 2]] - p[f[:, 0]]), p[f[:, 0]]) > 0
    return Mesh(p, np.where(outward[:, None], f, f[:, ::-1]))


def bumpy(p: np.ndarray) -> np.ndarray:
    """Points of the unit sphere on a body of 0.3 m that is neither round nor symmetric."""
    wave = 1 + 0.12 * np.sin(3 * p[:, 0] + 1) * np.cos(2 * p[:, 1]) + 0.1 * p[:, 2]
    return 0.3 * wave[:, None] * p * [1.0, 0.8, 1.2]


@pytest.fixture(scope="module")
def body() -> Mesh:
    mesh = ball(300, 1)
    return mesh.with_vertices(bumpy(mesh.vertices))


def test_every_similar_copy_of_the_rest_shape_is_at_rest(body):
    shape = local_shape(body)
    R = rotations.exp(np.array([0.4, -1.1, 0.7]))
    copy = 2.5 * body.vertices @ R.T + [1.0, -2.0, 0.5]
    assert len(shape.held) > 0.95 * 3 * len(body.faces)
    assert shape.energy(copy) < 1e-25
    assert np.abs(shape.gradient(copy)).max() < 1e-12
    moved = body.vertices + 0.01 * np.random.default_rng(0).standard_normal(body.vertices.shape)
    assert shape.energy(2.5 * moved @ R.T + 1) == pytest.approx(2.5**2 * shape.energy(moved), rel=1e-9)
    assert shape.paper_force(moved @ R.T) == pytest.approx(shape.paper_force(moved) @ R.T, abs=1e-12)


def test_gradient_is_the_finite_difference_of_the_energy_and_the_published_force_is_not(body):
    shape, rng = local_shape(body), np.random.default_rng(2)
    x = body.vertices + 0.01 * rng.standard_normal(body.vertices.shape)
    for _ in range(3):
        d = rng.standard_normal(x.shape)
        assert (shape.gradient(x) * d).sum() == pytest.approx(slope(lambda s, d=d: shape.energy(x + s * d)), rel=1e-5)
        ahead = slope(lambda s, d=d: shape.residuals(x + s * d))
        assert shape.derivative(x, d) == pytest.approx(ahead, abs=1e-6 * np.abs(ahead).max())
        r = rng.standard_normal(ahead.shape)
        assert (shape.apply_transpose(x, r) * d).sum() == pytest.approx((shape.derivative(x, d) * r).sum(), rel=1e-9)
    exact, published = -shape.gradient(x) / 2, shape.paper_force(x)
    assert np.abs(exact - published).max() > 0.1 * np.abs(exact).max()
    # With all frames held still it would be: the residual of each vertex, averaged over its frames.
    v = 17
    rows = shape.held == v
    assert published[v] == pytest.approx(-shape.residuals(x)[rows].mean(axis=0), abs=1e-15)


def test_borders_and_flat_frames_hold_nothing(body):
    open_mesh, _ = body.submesh(body.faces.min(axis=1) > 20)
    shape = local_shape(open_mesh)
    inner = (open_mesh.edge_use[open_mesh.face_edges] == 2).all(axis=1)
    assert 0.9 * 3 * inner.sum() < len(shape.held) <= 3 * inner.sum()
    # A vertex of three triangles: the frames of its triangles have two corners in one place.
    a, b, c = body.faces[0]
    new = len(body.vertices)
    faces = np.vstack([body.faces[1:], [[a, b, new], [b, c, new], [c, a, new]]])
    pointed = Mesh(np.vstack([body.vertices, body.corners[0].mean(axis=0) * 1.02]), faces)
    shape = local_shape(pointed)
    assert new not in shape.held and new in shape.corners
    assert np.isfinite(shape.gradient(pointed.vertices + 0.01)).all()
    with pytest.raises(ValueError, match="three sides"):
        local_shape(Mesh(np.eye(3), np.array([[0, 1, 2]])))


@pytest.mark.parametrize("published", [False, True])
@pytest.mark.parametrize("temperature", [0.3, 0.03, 0.01])
def test_soft_assignment_agrees_with_a_dense_one(published, temperature):
    rng = np.random.default_rng(4)
    x, y = rng.random((20, 3)), rng.random((50, 3))
    up = np.tile([0.0, 0.0, 1.0], (50, 1))
    near, squared = DirectedPoints(y, up, np.zeros(50, bool)).nearest(x, up[:20], 12)
    m = assign_softly(near, squared, 50, temperature, published, tolerance=1e-9, most=500).toarray()
    logs = np.full((20, 50), -np.inf)
    logs[np.arange(20)[:, None], near] = -((x[:, None] - y[near]) ** 2).sum(axis=2) / temperature
    least = np.where(np.isinf(logs), 0, logs).min(axis=0)
    v = np.zeros(50)
    for _ in range(3000):
        u = -logsumexp(logs + v, axis=1)
        total = logsumexp(logs + u[:, None], axis=0)
        before, v = v, -np.logaddexp(total, least) if published else np.minimum(-total, 0)
        if np.abs(v - before).max() < 1e-14:
            break
    dense = np.exp(logs - logsumexp(logs + v, axis=1)[:, None] + v)
    assert m == pytest.approx(dense, abs=1e-5)
    assert m.sum(axis=1) == pytest.approx(np.ones(20), abs=1e-12)
    assert m.min() >= 0 and m.sum(axis=0).max() < 1 + 1e-5


def test_cold_assignment_is_that_of_the_closest_points_on_the_same_side(body):
    rng = np.random.default_rng(5)
    points, face, _ = body.sample(4000, rng)
    normals = body.face_normals[face]
    x, n = 0.9 * body.vertices, body.vertex_normals
    near, squared = DirectedPoints(points, normals, np.zeros(4000, bool)).nearest(x, n, 12)
    assert (np.einsum("ikd,id->ik", normals[near], n)[near >= 0] > 0).all()
    agree = np.where(normals @ n.T > 0, ((points[:, None] - x) ** 2).sum(axis=2), np.inf)
    closest = agree.argmin(axis=0)
    assert (near[:, 0] == closest).all()
    cold = assign_softly(near, squared, 4000, 1e-12).toarray()
    assert cold.sum(axis=0).max() < 1 + 1e-6
    alone = np.bincount(closest, minlength=4000)[closest] == 1   # several vertices cannot share one point
    assert cold[np.flatnonzero(alone), closest[alone]] == pytest.approx(1, abs=1e-6)
    published = assign_softly(near, squared, 4000, 1e-4, True, most=200).toarray()
    assert (assign_softly(near, squared, 4000, 1e-4).toarray().argmax(axis=1) == closest)[alone].mean() > 0.9
    assert (published.argmax(axis=1) == closest).mean() < 0.5    # why it is not the default


def test_a_vertex_that_knows_no_point_and_more_vertices_than_points():
    near = np.array([[0, 1], [0, 1], [1, 0], [-1, -1]])
    squared = np.array([[0.0, 1.0], [0.1, 0.9], [0.0, 1.2], [np.inf, np.inf]])
    m = assign_softly(near, squared, 2, 0.05)
    assert np.diff(m.indptr).tolist() == [2, 2, 2, 0] and m.sum(axis=1) == pytest.approx([1, 1, 1, 0])
    assert 1.1 < m.sum(axis=0).max() <= 2                                     # Eq. 14 has no solution


@pytest.fixture(scope="module")
def scanned() -> Mesh:
    fine = ball(2500, 7)
    return fine.with_vertices(bumpy(fine.vertices))


def test_fit_lies_on_the_scan_without_inverted_triangles(body, scanned):
    """From an ellipsoid of another size, turned and moved: every vertex has data."""
    rest = body.with_vertices(0.3 * ball(300, 1).vertices * [1.0, 0.8, 1.2])
    start = rest.vertices @ rotations.exp(np.array([0.0, 0.05, 0.08])).T * 1.08 + [0.01, 0.0, -0.01]
    calls = []
    fit = fit_surface(rest, start, scanned, progress=lambda *done: calls.append(done))
    assert fit.converged and fit.seen.all() and fit.inverted == 0
    assert fit.rms < 2e-5 and fit.largest < 1e-4
    assert fit.rms == pytest.approx(np.sqrt(np.mean(Surface(scanned).closest(fit.vertices).distances**2)))
    assert distortion(rest, fit.vertices) < 0.12
    assert calls == [(k + 1, len(calls)) for k in range(len(calls))]


def test_holes_are_crossed_by_the_shape(body, scanned):
    """Data cut away on one side: the rest shape, which is the right one here, closes the hole."""
    side = scanned.corners.mean(axis=1)[:, 0] > 0.15
    holed, _ = scanned.submesh(~side)
    fit = fit_surface(body, 1.05 * body.vertices, holed)
    assert 0.1 < (~fit.seen).mean() < 0.3 and fit.inverted == 0
    over_hole = body.vertices[:, 0] > 0.21
    assert not fit.seen[over_hole].any()
    sag = Surface(scanned).closest(body.corners.mean(axis=1)).distances.max()        # flat triangles on a round body
    off = Surface(scanned).closest(fit.vertices).distances
    assert off[fit.seen].max() < sag and off[over_hole].max() < 1.5 * sag
    assert fit.largest < 1e-4                                  # of those seen


def test_fit_moves_with_the_scan_and_the_mesh(body, scanned):
    """Axes are exchanged, since points of the scan are thinned along them."""
    R, t, start = np.eye(3)[[1, 2, 0]], np.array([3.0, -1.0, 2.0]), 1.05 * body.vertices
    here = fit_surface(body, start, scanned)
    there = fit_surface(body, start @ R.T + t, scanned.with_vertices(scanned.vertices @ R.T + t))
    assert there.vertices == pytest.approx(here.vertices @ R.T + t, abs=1e-5)


@pytest.mark.slow
def test_the_published_steps_approach_the_scan():
    """Not onto it: the printed slack does not tend to the closest points."""
    rest, scan = (mesh.with_vertices(bumpy(mesh.vertices)) for mesh in (ball(40, 1), ball(300, 7)))
    start = 1.15 * rest.vertices
    fit = fit_surface(rest, start, scan, True)
    assert fit.converged and fit.seen.all() and fit.inverted == 0
    assert fit.rms < 0.3 * np.sqrt(np.mean(Surface(scan).closest(start).distances**2))


def test_what_cannot_be_fitted_is_told(body, scanned):
    with pytest.raises(ValueError, match="start"):
        fit_surface(body, body.vertices[:-1], scanned)
    with pytest.raises(ValueError, match="scan"):
        fit_surface(body, body.vertices, Mesh(scanned.vertices, np.zeros((0, 3), int)))
    hidden = fit_surface(body, body.vertices, scanned, hidden=np.ones(len(body.vertices), dtype=bool))
    assert not hidden.converged and not hidden.seen.any() and np.isnan(hidden.rms)


def test_vertices_that_met_on_a_corner_are_spread_again(body):
    assert spread_flat(body) is body
    x, (a, b) = body.vertices.copy(), body.edges[7]
    x[a] = x[b]
    met = body.with_vertices(x)
    spread = spread_flat(met)
    assert template_problem(met) and template_problem(spread) is None
    moved = np.flatnonzero((spread.vertices != met.vertices).any(axis=1))
    assert {a, b} <= set(moved) and len(moved) < 6
    assert np.linalg.norm(spread.vertices - met.vertices, axis=1).max() < body.edge_lengths.max()
