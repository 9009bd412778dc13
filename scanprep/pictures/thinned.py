"""Surfaces with no more triangles than a screen can show."""
from __future__ import annotations

import numpy as np

from ..geometry.mesh import Mesh

SHOWN = 120_000                      # triangles


def thinned(mesh: Mesh, faces: int = SHOWN) -> Mesh:
    """A mesh of at most about so many triangles, with its colours; for pictures only, it may not be manifold."""
    if len(mesh.faces) <= faces:
        return mesh
    cell = np.sqrt(2 * mesh.face_areas.sum() / faces)
    return coarsened(mesh, float(cell))


def coarsened(mesh: Mesh, cell: float) -> Mesh:
    """The mesh with all vertices of a cubic cell (metres) in one; for pictures only, it may not be manifold."""
    key = np.floor((mesh.vertices - mesh.vertices.min(axis=0)) / cell).astype(np.int64)
    _, first, place = np.unique(key, axis=0, return_index=True, return_inverse=True)
    faces = place.reshape(-1)[mesh.faces]
    apart = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    count = np.bincount(place.reshape(-1))
    means = np.stack([np.bincount(place.reshape(-1), axis) / count for axis in mesh.vertices.T], axis=1)
    colors = None if mesh.colors is None else mesh.colors[first]
    return Mesh(means, faces[apart], colors)
