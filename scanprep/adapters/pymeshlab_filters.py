"""Decimation by MeshLab.

pymeshlab is licensed under the GPL, version 3. It is imported in this file alone, when its function
is called; a program that distributes pymeshlab together with this package must respect that licence.
"""
from __future__ import annotations

import numpy as np

from ..geometry.mesh import Mesh
from .open3d_filters import library


def meshlab_decimation(mesh: Mesh, faces: int) -> Mesh:
    """Decimate by MeshLab's quadric edge collapses, keeping the topology."""
    pymeshlab = library("pymeshlab")
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(vertex_matrix=mesh.vertices, face_matrix=mesh.faces.astype(np.int32),
                                   v_normals_matrix=mesh.vertex_normals))
    meshes.meshing_decimation_quadric_edge_collapse(targetfacenum=faces, preservetopology=True,
                                                    preserveboundary=True)
    smaller = meshes.current_mesh()
    return Mesh(smaller.vertex_matrix(), smaller.face_matrix())
