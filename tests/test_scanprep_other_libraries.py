"""Meshes of trimesh, pyvista and Open3D go into every public function, and ours come out as theirs."""
import importlib
import inspect
from types import SimpleNamespace

import numpy as np
import pytest

from scanprep import Mesh, clean_scan, decimate, register, write_mesh
from scanprep.synthetic.topology import load_topology

BODY = load_topology().mesh
PACKAGES = ("scanprep", "model", "completion")
# they read meshes, show anything, or wait for `find_skeleton`
OTHERS = {"read_mesh", "view", "find_skeleton"}


class Polygons:
    """A mesh as `pyvista.PolyData` holds it: squares, whose corners are counted in one flat array."""

    points = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    faces = np.array([4, 0, 1, 2, 3])

    def triangulate(self):
        return SimpleNamespace(faces=np.array([3, 0, 1, 2, 3, 0, 2, 3]))


def test_bounds_are_the_corners_of_the_box():
    np.testing.assert_array_equal(Mesh([[0, 2, 1], [3, 0, 1], [1, 1, -4]], [[0, 1, 2]]).bounds, [[0, 0, -4], [3, 2, 1]])


def test_polygons_are_cut_into_triangles():
    assert Mesh.of(Polygons()).faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    with pytest.raises(TypeError, match="trimesh, pyvista or Open3D, got dict"):
        Mesh.of({})
    assert Mesh.of(BODY) is BODY


@pytest.mark.parametrize("library", ["trimesh", "pyvista", pytest.param("open3d", marks=pytest.mark.gl)])
def test_a_mesh_comes_back_from_another_library(library):
    pytest.importorskip(library)
    colored = Mesh(BODY.vertices, BODY.faces, np.random.default_rng(0).integers(0, 256, BODY.vertices.shape) / 255)
    for mesh in (BODY, colored):
        back = Mesh.of(getattr(mesh, f"to_{library}")())
        np.testing.assert_array_equal(back.faces, mesh.faces)
        np.testing.assert_array_equal(back.vertices, mesh.vertices)
    if library != "pyvista":
        np.testing.assert_allclose(back.colors, colored.colors, atol=1e-6)


def test_functions_take_meshes_of_other_libraries(tmp_path):
    theirs = BODY.to_trimesh()
    assert len(decimate(mesh=theirs, faces=2000).faces) == 2000
    assert clean_scan(theirs).judgement.verdict == "good"
    write_mesh(tmp_path / "body.ply", theirs)
    with pytest.raises(ValueError, match="landmarks: expected at least"):
        register(theirs, theirs, (np.zeros(1, dtype=int), np.zeros((1, 3))))


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_function_with_a_mesh_takes_any(package):
    wrong = []
    for name in importlib.import_module(package).__all__:
        function = getattr(importlib.import_module(package), name)
        if inspect.isfunction(function) and name not in OTHERS:
            asked = [str(one.annotation) for one in inspect.signature(function).parameters.values()]
            takes_any = "take_mesh" in function.__code__.co_names
            wrong += [name] if any("Mesh" in one or one == "Scan" for one in asked) and not takes_any else []
    assert not wrong
