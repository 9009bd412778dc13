"""Reduce the triangles of a mesh that is only looked at."""
from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from ..geometry.mesh import Mesh
from .colors import Heat
from .shading import Solid

MOST = 40_000                        # triangles of a shape in the browser, which turns them smoothly


def thin_solid(solid: Solid, most: int = MOST) -> Solid:
    """Return a solid with at most about `most` triangles, each vertex coloured like the nearest original one."""
    mesh = solid.mesh
    if len(mesh.faces) <= most:
        return solid
    import fast_simplification

    # about its middle, as the library works in single precision
    middle = mesh.vertices.mean(axis=0)
    points, faces = fast_simplification.simplify((mesh.vertices - middle).astype(np.float32),
                                                 mesh.faces.astype(np.int32), target_count=most)
    points = points.astype(float) + middle
    nearest = cKDTree(mesh.vertices).query(points)[1]
    small = Mesh(points, faces.astype(np.int64), None if mesh.colors is None else mesh.colors[nearest])

    def transfer(shade: np.ndarray | Heat) -> np.ndarray | Heat:
        """Transfer a colouring to the new vertices."""
        if isinstance(shade, Heat):
            return replace(shade, values=shade.values[nearest])
        values = np.asarray(shade)
        return values if values.ndim == 1 else of_vertices(values, mesh)[nearest]

    color = solid.color if solid.color is None or isinstance(solid.color, Heat) else np.asarray(solid.color)
    return replace(solid, mesh=small, color=None if color is None else transfer(color),
                   shades={name: transfer(shade) for name, shade in solid.shades.items()})


def of_vertices(colors: np.ndarray, mesh: Mesh) -> np.ndarray:
    """Return colours of vertices (N, 3) from those of vertices or of triangles."""
    if len(colors) != len(mesh.faces) or len(colors) == len(mesh.vertices):
        return colors
    out = np.zeros(mesh.vertices.shape, dtype=colors.dtype)
    out[mesh.faces.ravel()] = np.repeat(colors, 3, axis=0)
    return out
