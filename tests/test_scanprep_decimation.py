
import sys

import numpy as np
import pytest
from scanned_shapes import SIX, bumpy, triangle_quality, view
from scipy.spatial import cKDTree

from scanprep.adapters.open3d_filters import MissingLibraryError
from scanprep.decimation.decimate import DecimateConfig, decimate
from scanprep.decimation.quadrics import minimise_quadrics, plane_quadrics, point_quadrics, surface_quadrics, value
from scanprep.geometry.mesh import Mesh, template_problem
from scanprep.geometry.surface import Surface
from scanprep.repair.intersections import intersecting_faces
from scanprep.surfaces.template import template_of_views


@pytest.mark.parametrize("method", ["quadric", "even"])
@pytest.mark.parametrize("improve", [False, True])
def test_closed_stays_closed_and_near(method, improve):
    mesh = bumpy(5)
    small = decimate(mesh, 3000, DecimateConfig(method, improve))
    assert small.is_closed and template_problem(small) is None
    assert len(small.faces) == pytest.approx(3000, abs=4)
    assert Surface(small).closest(mesh.vertices).distances.mean() < 0.03 * small.mean_edge
    assert small.volume == pytest.approx(mesh.volume, rel=0.01)


def test_quadrics_beat_short_edges_where_it_bends():
    mesh = bumpy(5)
    far = {m: Surface(decimate(mesh, 1500, DecimateConfig(m))).closest(mesh.vertices).distances.mean()
           for m in ("quadric", "even")}
    assert far["quadric"] < 0.8 * far["even"]


def test_kept_vertices_and_the_border_stay():
    mesh = bumpy(5)
    mesh = mesh.submesh(mesh.corners.mean(axis=1)[:, 2] > 0)[0]
    keep = np.random.default_rng(0).choice(len(mesh.vertices), 40, replace=False)
    small = decimate(mesh, 1000, keep=keep)
    assert cKDTree(small.vertices).query(mesh.vertices[keep])[0].max() == 0
    assert len(small.boundary_loops) == 1 and not len(intersecting_faces(small))
    a, b = (mesh.vertices[mesh.edges[mesh.edge_use == 1][:, side]] for side in (0, 1))
    line = np.concatenate([a * t + b * (1 - t) for t in np.linspace(0, 1, 20)])
    far = np.linalg.norm(line - small.vertices[small.boundary_vertices][:, None], axis=2).min(axis=1)
    assert far.mean() < 0.25 * mesh.mean_edge and far.max() < mesh.mean_edge


def test_even_triangles_are_even():
    small = decimate(bumpy(5), 4000, DecimateConfig("even", improve=True))
    assert small.edge_lengths.std() / small.mean_edge < 0.2
    assert np.percentile(triangle_quality(small), 1) > 0.75


def test_a_quadric_is_the_squared_distance_to_planes():
    rng = np.random.default_rng(0)
    n = rng.normal(size=(5, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    through, weight, x = rng.normal(size=(5, 3)), rng.random(5), rng.normal(size=(7, 1, 3))
    expected = weight * np.einsum("pd,npd->np", n, x - through) ** 2
    np.testing.assert_allclose(value(plane_quadrics(n, through, weight), x), expected, atol=1e-12)
    np.testing.assert_allclose(value(point_quadrics(through, weight), x), weight * ((x - through) ** 2).sum(axis=2),
                               atol=1e-12)
    total = plane_quadrics(n, through, weight).sum(axis=0)
    A, b = (np.sqrt(weight)[:, None] * n), np.sqrt(weight) * np.einsum("pd,pd->p", n, through)
    np.testing.assert_allclose(minimise_quadrics(total), np.linalg.lstsq(A, b, rcond=None)[0], atol=1e-9)


def test_the_quadric_of_a_vertex_has_the_planes_around_it_by_their_areas():
    mesh, rng = bumpy(2), np.random.default_rng(1)
    Q, facing = surface_quadrics(mesh.vertices[:, None], mesh.faces, 1e-3)
    for v, x in enumerate(rng.normal(size=(9, 3))):
        around = (mesh.faces == v).any(axis=1)
        area = mesh.face_areas[around]
        to_planes = ((x - mesh.vertices[v]) @ mesh.face_normals[around].T)**2
        expected = area @ to_planes + 1e-3 * area.sum() * ((x - mesh.vertices[v])**2).sum()
        assert value(Q[v, 0], x) == pytest.approx(expected, rel=1e-9)
        np.testing.assert_allclose(facing[v, 0], area @ mesh.face_normals[around], atol=1e-12)


def torus(around=48, through=24):
    a, b = np.meshgrid(np.arange(around), np.arange(through), indexing="ij")
    u, w = 2 * np.pi * a / around, 2 * np.pi * b / through
    r = 0.1 + 0.03 * np.cos(w)
    number = lambda i, j: (i % around) * through + j % through      # noqa: E731
    corner = [number(a + i, b + j).ravel() for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))]
    faces = np.concatenate([np.stack([corner[0], corner[1], corner[2]], axis=1),
                            np.stack([corner[0], corner[2], corner[3]], axis=1)])
    return Mesh(np.stack([r * np.cos(u), r * np.sin(u), 0.03 * np.sin(w)], axis=-1).reshape(-1, 3), faces)


def test_the_hole_of_a_ring_stays_however_few_triangles_are_wanted():
    small = decimate(torus(), 4)
    assert small.is_closed and template_problem(small) is None
    assert len(small.vertices) - len(small.edges) + len(small.faces) == 0
    assert len(small.faces) < 200


def test_progress_is_told():
    mesh, told = bumpy(4), []
    decimate(mesh, 1000, progress=lambda *state: told.append(state))
    done, total = zip(*told, strict=True)
    assert list(done) == sorted(done) and done[-1] == total[-1] == len(mesh.faces) - 1000


def test_where_the_mesh_lies_does_not_matter():
    mesh = bumpy(4)
    here, there = decimate(mesh, 800), decimate(mesh.with_vertices(mesh.vertices + [50, -20, 9]), 800)
    assert np.abs(np.sort(here.edge_lengths) - np.sort(there.edge_lengths)).mean() < 1e-3 * here.mean_edge


def test_colours_are_kept():
    mesh = bumpy(4)
    colored = Mesh(mesh.vertices, mesh.faces, np.clip(mesh.vertices + 0.5, 0, 1))
    small = decimate(colored, 1000)
    assert np.abs(small.colors - np.clip(small.vertices + 0.5, 0, 1)).max() < mesh.mean_edge


def test_arguments_are_checked():
    mesh = bumpy(3)
    with pytest.raises(ValueError, match="faces: expected at least 4"):
        decimate(mesh, 2)
    with pytest.raises(ValueError, match="keep: the method 'even' cannot"):
        decimate(mesh, 100, DecimateConfig("even"), keep=[1])
    with pytest.raises(ValueError, match="keep: expected vertices"):
        decimate(mesh, 100, keep=[10**6])
    with pytest.raises(ValueError, match=r"config\.method"):
        decimate(mesh, 100, DecimateConfig("magic"))
    doubled = Mesh(mesh.vertices, np.concatenate([mesh.faces, mesh.faces[:1]]))
    with pytest.raises(ValueError, match="manifold"):
        decimate(doubled, 100)


@pytest.mark.slow
def test_views_become_a_template():
    shape = bumpy(5)
    rng = np.random.default_rng(0)
    some = [d for d in SIX if tuple(d) != (0, 0, -1)]               # nobody looks from below
    views = [view(shape, d, rng, noise=0.0005) for d in some]
    done = []
    template = template_of_views(views, 3000, lambda *state: done.append(state), voxel=0.005)
    assert template.is_closed and template_problem(template) is None
    assert done == [(i, 4) for i in range(1, 5)]
    at = Surface(shape).closest(template.vertices)
    assert at.distances.mean() < 0.001
    assert (np.einsum("nd,nd->n", template.vertex_normals, shape.face_normals[at.faces]) > 0).all()
    assert np.percentile(triangle_quality(template), 1) > 0.7


def test_meshlab_as_a_method():
    pytest.importorskip("pymeshlab", exc_type=ImportError)
    mesh = bumpy(5)
    small = decimate(mesh, 3000, DecimateConfig("pymeshlab"))
    assert small.is_closed and len(small.faces) == pytest.approx(3000, abs=4)
    assert Surface(small).closest(mesh.vertices).distances.mean() < 0.03 * small.mean_edge


def test_a_missing_library_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pymeshlab", None)
    with pytest.raises(MissingLibraryError, match=r"pymeshlab cannot be imported.*libegl1 libgl1 libx11-6"):
        decimate(bumpy(3), 100, DecimateConfig("pymeshlab"))
