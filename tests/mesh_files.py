"""What tests of files of meshes share."""
import warnings

import numpy as np
import pytest
import trimesh

from scanprep.geometry.files import MeshFileError, read_mesh
from scanprep.geometry.mesh import Mesh

TETRAHEDRON = Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.5]], [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])


def body(rng, n=200):
    """A closed surface with vertices and faces in an order of no meaning, about a metre across."""
    points = rng.normal(size=(n, 3))
    mesh = trimesh.convex.convex_hull(points / np.linalg.norm(points, axis=1, keepdims=True))
    order = rng.permutation(len(mesh.vertices))
    vertices = np.empty_like(mesh.vertices)
    vertices[order] = mesh.vertices
    return Mesh(vertices * (0.3, 0.4, 0.9), order[rng.permutation(mesh.faces)], rng.random((len(vertices), 3)))


def quiet(read, *args):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return read(*args)


PLY_ROWS = "0 0 0\n1 0 0\n1 1 0\n0 1 0\n0.5 0.5 1\n"
PLY_HEADER = ("ply\nformat ascii 1.0\ncomment made by hand\nelement vertex 5\nproperty float x\nproperty float y\n"
              "property float z\nelement face 2\nproperty list uchar int vertex_indices\nend_header\n")


def refused(path, *words, read=read_mesh):
    with pytest.raises(MeshFileError) as caught:
        quiet(read, path)
    message = str(caught.value)
    assert str(path) in message and "\n" not in message, message
    for word in words:
        assert word in message, message
