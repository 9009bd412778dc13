"""Closest points, compatible matches and rays against brute force."""
import warnings

import numpy as np
import pytest
import trimesh

from model.posing.character import points_inside
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import OrientedPoints, Rays, Surface, barycentric

RNG = np.random.default_rng


def ball(subdivisions=1, radius=0.5, centre=(0, 0, 0)):
    sphere = trimesh.creation.icosphere(subdivisions, radius)
    return Mesh(sphere.vertices + centre, sphere.faces)


def brute_force(mesh, points):
    """Distance to the surface: the best of all triangles' insides, sides and corners."""
    best = np.full(len(points), np.inf)
    for a, b, c in mesh.corners:
        normal = np.cross(b - a, c - a)
        normal /= np.linalg.norm(normal)
        flat = points - ((points - a) @ normal)[:, None] * normal
        inside = np.ones(len(points), dtype=bool)
        for p, q in ((a, b), (b, c), (c, a)):
            inside &= (flat - p) @ np.cross(normal, q - p) >= 0
            t = np.clip((points - p) @ (q - p) / ((q - p) @ (q - p)), 0, 1)
            best = np.minimum(best, np.linalg.norm(points - p - t[:, None] * (q - p), axis=1))
        best = np.where(inside, np.minimum(best, np.abs((points - a) @ normal)), best)
    return best


def test_closest_points_against_brute_force():
    mesh, points = ball(), RNG(0).normal(size=(400, 3))
    found = Surface(mesh).closest(points)
    np.testing.assert_allclose(found.distances, brute_force(mesh, points), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(points - found.points, axis=1), found.distances, atol=1e-12)
    np.testing.assert_allclose(np.einsum("nc,ncd->nd", found.bary, mesh.corners[found.faces]), found.points,
                               atol=1e-12)
    assert found.bary.min() > -1e-9


def test_barycentric_coordinates_come_back_and_flat_triangles_give_their_first_corner():
    corners, bary = RNG(4).normal(size=(200, 3, 3)), RNG(5).dirichlet((1, 1, 1), 200)
    points = np.einsum("nc,ncd->nd", bary, corners)
    np.testing.assert_allclose(barycentric(points, corners), bary, atol=1e-8)
    off_plane = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    np.testing.assert_allclose(barycentric(points + off_plane, corners), bary, atol=1e-8)
    np.testing.assert_array_equal(barycentric(np.ones((1, 3)), np.ones((1, 3, 3))), [[1, 0, 0]])


def test_matches_are_the_best_in_six_dimensions_within_the_limits():
    rng, scale = RNG(7), 0.05
    unit = lambda n: n / np.linalg.norm(n, axis=1, keepdims=True)            # noqa: E731
    points, normals = rng.normal(size=(200, 3)), unit(rng.normal(size=(200, 3)))
    query, theirs = rng.normal(size=(100, 3)), unit(rng.normal(size=(100, 3)))
    found = OrientedPoints(points, normals, scale).match(query, theirs, max_distance=0.5, min_cosine=0.3)
    apart, turned = ((query[:, None] - points) ** 2).sum(axis=2), ((theirs[:, None] - normals) ** 2).sum(axis=2)
    cost = apart + scale**2 * turned
    best = cost.argmin(axis=1)
    good = (np.linalg.norm(points[best] - query, axis=1) <= 0.5) & ((normals[best] * theirs).sum(axis=1) >= 0.3)
    np.testing.assert_array_equal(found.index, np.where(good, best, -1))
    np.testing.assert_array_equal(found.valid, good)
    assert np.isinf(found.distances[~good]).all() and 0 < good.sum() < 100


@pytest.mark.parametrize("centre", [(0, 0, 0), (100, -50, 20)])
def test_rays_hit_a_ball_where_they_should(centre):
    mesh, rng = ball(4, centre=centre), RNG(8)
    origins = rng.normal(size=(300, 3))
    origins *= 2 / np.linalg.norm(origins, axis=1, keepdims=True)
    aim = rng.normal(size=(300, 3)) * 0.4 - origins
    aim /= np.linalg.norm(aim, axis=1, keepdims=True)
    face, distance = Rays(mesh).cast(origins + centre, aim)
    along = -(origins * aim).sum(axis=1)
    miss = np.sqrt(np.maximum((origins**2).sum(axis=1) - along**2, 0))       # how far the line passes the middle
    sure = np.abs(miss - 0.5) > 0.01
    np.testing.assert_array_equal((face >= 0)[sure], (miss < 0.5)[sure])
    np.testing.assert_array_equal(np.isnan(distance), face < 0)
    hit = (face >= 0) & (miss < 0.4)
    np.testing.assert_allclose(distance[hit], (along - np.sqrt(np.maximum(0.25 - miss**2, 0)))[hit], atol=5e-3)
    points = origins[hit] + centre + distance[hit, None] * aim[hit]
    plane = np.einsum("nd,nd->n", points - mesh.corners[face[hit], 0], mesh.face_normals[face[hit]])
    assert np.abs(plane).max() < 1e-5


QUERIES = {
    "closest": lambda bad: Surface(ball()).closest(bad),
    "match": lambda bad: OrientedPoints(ball().vertices, ball().vertex_normals).match(bad, np.zeros((3, 3))),
    "match, normals": lambda bad: OrientedPoints(ball().vertices, ball().vertex_normals).match(np.zeros((3, 3)), bad),
    "match, among": lambda bad: OrientedPoints(bad, np.zeros((3, 3))),
    "cast": lambda bad: Rays(ball()).cast(bad, np.array([0, 0, 1.0])),
    "cast, directions": lambda bad: Rays(ball()).cast(np.zeros((3, 3)), bad),
    "occluded": lambda bad: Rays(ball()).test_occlusion(bad, np.array([0, 0, 1.0])),
    "inside": lambda bad: points_inside(ball(), bad)}


@pytest.mark.parametrize("query", QUERIES.values(), ids=QUERIES)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e200])
def test_no_query_answers_for_a_point_that_is_nowhere(query, value):
    query(np.zeros((3, 3)))
    with pytest.raises(ValueError, match=r"1 points are not finite, or beyond 1e\+30 m; the first is number 1: "):
        query(np.array([[0, 0, 0.1], [0, value, 0], [0.1, 0, 0]]))


@pytest.mark.parametrize("vertices", [0, 1])
def test_without_triangles_nothing_is_nearest_and_nothing_is_hit(vertices):
    bare = Mesh(np.zeros((vertices, 3)), np.zeros((0, 3), dtype=int))
    points = np.array([[0, 0, 1.0]])
    for ask in (lambda: Surface(bare), lambda: points_inside(bare, points)):
        with pytest.raises(ValueError, match=rf"mesh: expected at least one triangle, got Mesh\({vertices} vertices"):
            ask()
    with pytest.raises(ValueError, match="points: expected at least one to search among, got none"):
        OrientedPoints(points[:0], points[:0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        face, distance = Rays(bare).cast(points, -points)
    assert face.tolist() == [-1] and np.isnan(distance).all()
