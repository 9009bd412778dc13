"""Distances along the surface: known solids, libigl's exact ones, metric axioms."""
import igl
import numpy as np
import pytest
import trimesh

from scanprep.geometry.geodesics import SurfaceGraph
from scanprep.geometry.mesh import Mesh


def ball(subdivisions=3):
    sphere = trimesh.creation.icosphere(subdivisions, 1.0)
    return Mesh(sphere.vertices, sphere.faces)


def lumpy(seed=0):
    """A closed surface with uneven triangles, stretched, many of them obtuse."""
    points = np.random.default_rng(seed).normal(size=(400, 3))
    mesh = trimesh.convex.convex_hull(points / np.linalg.norm(points, axis=1, keepdims=True))
    return Mesh(mesh.vertices * (0.3, 0.4, 0.9), mesh.faces)


def exact(mesh, source):
    none = np.array([], dtype=np.int64)
    return igl.exact_geodesic(np.array(mesh.vertices), np.array(mesh.faces), np.array([source]), none,
                              np.arange(len(mesh.vertices)), none)


@pytest.mark.parametrize(("mesh", "longer"), [(ball(), 1.02), (lumpy(), 1.07), (lumpy(1), 1.07)])
def test_against_exact_geodesics(mesh, longer):
    for source in (0, 57, 200):
        true = exact(mesh, source)
        far = true > 0.2
        graph = SurfaceGraph(mesh).distances(source)
        assert (graph > true - 1e-9).all()               # a real way on the surface is never too short
        assert (graph / np.maximum(true, 1e-12))[far].mean() < longer


def test_one_source_many_sources_and_a_limit_agree():
    graph = SurfaceGraph(ball(2))
    sources = np.array([3, 70, 11])
    many = graph.distances(sources)
    assert many.shape == (3, 162)
    for row, source in zip(many, sources, strict=True):
        np.testing.assert_array_equal(row, graph.distances(int(source)))
    limited = graph.distances(3, limit=0.8)
    np.testing.assert_array_equal(limited, np.where(many[0] <= 0.8, many[0], np.inf))
    distance, which = graph.nearest(sources)
    np.testing.assert_allclose(distance, many.min(axis=0))
    np.testing.assert_allclose(many[which, np.arange(162)], distance)
    np.testing.assert_array_equal(which[sources], [0, 1, 2])


def test_farthest_points_are_the_greedy_ones_and_cover_the_surface():
    mesh = lumpy(3)
    graph = SurfaceGraph(mesh)
    d = graph.distances(np.arange(len(mesh.vertices)))
    chosen = graph.farthest_points(30, first=5)
    assert chosen[0] == 5 and len(set(chosen)) == 30
    for i in range(1, 30):
        nearest = d[chosen[:i]].min(axis=0)
        assert nearest[chosen[i]] == pytest.approx(nearest.max())
    assert sorted(graph.farthest_points(len(mesh.vertices))) == list(range(len(mesh.vertices)))


def test_thin_and_flat_triangles_do_no_harm_to_paths():
    mesh = Mesh([[0, 0, 0], [1, 0, 0], [2, 0, 0], [1, 1e-9, 0], [1, -1, 0], [0, 0, 0]],
                [[0, 1, 2], [0, 2, 3], [0, 4, 1], [0, 5, 4]])
    d = SurfaceGraph(mesh).distances(0)
    np.testing.assert_allclose(d, [0, 1, 2, 1, np.sqrt(2), 0], atol=1e-8)


def test_what_is_refused():
    fin = Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]], [[0, 1, 2], [1, 0, 3], [0, 1, 4]])
    graph = SurfaceGraph(fin)
    with pytest.raises(ValueError, match=r"sources: expected vertices of 0\.\.4, got 9"):
        graph.distances(9)
    with pytest.raises(ValueError, match=r"count: expected 1\.\.5, got 6"):
        graph.farthest_points(6)


def test_a_mesh_without_edges_has_paths_of_no_length():
    for count in (0, 1, 3):
        bare = Mesh(np.zeros((count, 3)), np.zeros((0, 3), dtype=int))
        graph = SurfaceGraph(bare)
        if count:
            assert graph.distances(0).tolist() == [0.0] + [np.inf] * (count - 1)
            assert sorted(graph.farthest_points(count)) == list(range(count))
