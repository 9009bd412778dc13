import os
from pathlib import Path

import numpy as np
import pytest
from scanned_shapes import SIX, bumpy, view

from scanprep.cleaning.decimate import DecimateConfig, decimate
from scanprep.cleaning.merge import MergeConfig
from scanprep.cleaning.open3d_filters import MissingLibrary
from scanprep.cleaning.remesh import triangle_quality
from scanprep.cleaning.template import TemplateConfig, make_template
from scanprep.geometry.files import read_mesh
from scanprep.geometry.mesh import Mesh, template_problem
from scanprep.geometry.surface import Surface
from scanprep.scanning.scanner import ScannerConfig, scan


@pytest.mark.parametrize("method", ["quadric", "even", "fast"])
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


def test_a_border_stays_where_it_is():
    mesh = bumpy(5)
    open_mesh = mesh.submesh(mesh.corners.mean(axis=1)[:, 2] > 0)[0]
    small = decimate(open_mesh, 2000)
    assert len(small.boundary_loops) == len(open_mesh.boundary_loops) == 1
    assert np.abs(small.vertices[small.boundary_vertices, 2]).max() < 2 * open_mesh.mean_edge


def test_even_triangles_are_even():
    small = decimate(bumpy(5), 4000, DecimateConfig("even", improve=True))
    assert small.edge_lengths.std() / small.mean_edge < 0.2
    assert np.percentile(triangle_quality(small), 1) > 0.75


def test_colours_are_kept():
    mesh = bumpy(4)
    colored = Mesh(mesh.vertices, mesh.faces, np.clip(mesh.vertices + 0.5, 0, 1))
    small = decimate(colored, 1000)
    assert np.abs(small.colors - np.clip(small.vertices + 0.5, 0, 1)).max() < mesh.mean_edge


def test_no_more_triangles_than_there_are():
    mesh = bumpy(3)
    assert decimate(mesh, 10**6) is mesh


def test_arguments_are_checked():
    mesh = bumpy(3)
    with pytest.raises(ValueError, match="faces: expected at least 4"):
        decimate(mesh, 2)
    with pytest.raises(ValueError, match=r"config\.method"):
        decimate(mesh, 100, DecimateConfig("magic"))
    doubled = Mesh(mesh.vertices, np.concatenate([mesh.faces, mesh.faces[:1]]))
    with pytest.raises(ValueError, match="manifold"):
        decimate(doubled, 100)


@pytest.mark.gl
@pytest.mark.parametrize("library", ["open3d", "pymeshlab"])
def test_other_libraries_as_settings(library):
    try:
        __import__(library)
    except (ImportError, OSError) as error:
        pytest.skip(f"{library} cannot be imported: {error}")
    mesh = bumpy(5)
    small = decimate(mesh, 3000, DecimateConfig(library))
    assert small.is_closed and len(small.faces) == pytest.approx(3000, abs=4)
    assert Surface(small).closest(mesh.vertices).distances.mean() < 0.03 * small.mean_edge


@pytest.mark.parametrize("library", ["open3d", "pymeshlab"])
def test_a_missing_library_is_named(library, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, library, None)
    with pytest.raises(MissingLibrary, match=f"{library} cannot be imported.*libegl1 libgl1 libx11-6 libusb-1.0-0"):
        decimate(bumpy(3), 100, DecimateConfig(library))


def test_views_become_a_template():
    shape = bumpy(5)
    rng = np.random.default_rng(0)
    some = [d for d in SIX if tuple(d) != (0, 0, -1)]               # nobody looks from below
    views = [view(shape, d, rng, noise=0.0005) for d in some]
    done = []
    template = make_template(views, 3000, TemplateConfig(merge=MergeConfig(voxel=0.005)),
                             progress=lambda *state: done.append(state))
    assert template.is_closed and template_problem(template) is None
    assert done == [(i, 4) for i in range(1, 5)]
    at = Surface(shape).closest(template.vertices)
    assert at.distances.mean() < 0.001
    assert (np.einsum("nd,nd->n", template.vertex_normals, shape.face_normals[at.faces]) > 0).all()
    assert np.percentile(triangle_quality(template), 1) > 0.7


@pytest.mark.real
def test_views_of_a_real_body_become_a_template():
    folder = os.environ.get("SCAPEKIT_DATA")
    if not folder:
        pytest.skip("SCAPEKIT_DATA does not point at the real scans")
    body = read_mesh(Path(folder) / "scape_poses" / "mesh000.ply")
    views = scan(body, ScannerConfig(views=4, noise=0.002)).views
    template = make_template(views, 8000, TemplateConfig(merge=MergeConfig(voxel=0.007, min_cosine=0.15)))
    assert template.is_closed and template_problem(template) is None
    at = Surface(body).closest(template.vertices)
    assert at.distances.mean() < 0.002
    assert (np.einsum("nd,nd->n", template.vertex_normals, body.face_normals[at.faces]) > 0).mean() > 0.99
    assert template.volume == pytest.approx(body.volume, rel=0.03)
