"""Filters of MeshLab.

pymeshlab is licensed under the GPL, version 3. It is imported in this file alone, when one of these functions is
called; a program that distributes pymeshlab together with this package must respect that licence.
"""
from __future__ import annotations

from typing import Any

import numpy as np

from ..geometry.mesh import Mesh
from ..threads import threads_asked
from .open3d_filters import library, recolor


def meshlab_decimation(mesh: Mesh, faces: int) -> Mesh:
    """Decimate by MeshLab's quadric edge collapses, keeping the topology."""
    meshes = _meshes(mesh)
    meshes.meshing_decimation_quadric_edge_collapse(targetfacenum=faces, preservetopology=True,
                                                    preserveboundary=True)
    return _result(meshes)


def meshlab_poisson(mesh: Mesh, depth: int = 8) -> Mesh:
    """Reconstruct a closed surface near the mesh by screened Poisson reconstruction."""
    meshes = _meshes(mesh)
    meshes.generate_surface_reconstruction_screened_poisson(depth=depth, threads=threads_asked() or 1)
    return recolor(_result(meshes), mesh)


def _meshes(mesh: Mesh) -> Any:
    """Put a mesh into a MeshSet."""
    pymeshlab = library("pymeshlab")
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(vertex_matrix=mesh.vertices, face_matrix=mesh.faces.astype(np.int32),
                                   v_normals_matrix=mesh.vertex_normals))
    return meshes


def _result(meshes: Any) -> Mesh:
    """Return the current mesh of a MeshSet."""
    current = meshes.current_mesh()
    return Mesh(current.vertex_matrix(), current.face_matrix())
