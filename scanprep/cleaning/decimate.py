"""Fewer triangles for the same surface [QEM]."""
from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from ..geometry.mesh import Mesh
from ..geometry.surface import Surface
from .remesh import improve_triangles
from .repair import repair

Method = Literal["even", "quadric", "fast", "open3d", "pymeshlab"]


@dataclass(frozen=True)
class DecimateConfig:
    """Settings of `decimate`.

    Attributes
    ----------
    method : str
        "quadric": least-error collapses, small triangles where the surface bends [QEM]. "even": shortest edges
        first, triangles of one size. Both keep a closed manifold mesh closed and manifold. "fast": quadric in a
        quarter of the time, but what comes out is repaired by removing triangles, so that it may be open.
        "open3d" and "pymeshlab" need these libraries.
    improve : bool
        Turn edges and move vertices along the original surface for well-shaped triangles.
    """

    method: Method = "quadric"
    improve: bool = False


def decimate(mesh: Mesh, faces: int, config: DecimateConfig | None = None) -> Mesh:
    """Collapse edges until about `faces` triangles are left.

    Parameters
    ----------
    mesh : Mesh
        Manifold, closed or with borders.
    faces : int
        A mesh that has no more is returned as it is.
    config : DecimateConfig, optional

    Returns
    -------
    Mesh
        Vertex colours are those of the nearest original vertices.

    Raises
    ------
    ValueError
        Fewer than 4 triangles wanted, an unknown method, or a mesh that is not manifold.

    [QEM] pair contraction
    """
    config = config or DecimateConfig()
    if faces < 4:
        raise ValueError(f"faces: expected at least 4, got {faces}")
    if config.method not in _METHODS:
        raise ValueError(f"config.method: expected one of {', '.join(_METHODS)}, got {config.method!r}")
    if faces >= len(mesh.faces):
        return mesh
    if not (mesh.is_edge_manifold and mesh.is_vertex_manifold):
        raise ValueError("mesh: expected a manifold surface; repair it first")
    smaller = _METHODS[config.method](mesh, faces)
    if config.improve:
        smaller = improve_triangles(smaller, Surface(mesh))
    if mesh.colors is None:
        return Mesh(smaller.vertices, smaller.faces)
    nearest = cKDTree(mesh.vertices).query(smaller.vertices)[1]
    return Mesh(smaller.vertices, smaller.faces, mesh.colors[nearest])


def _quadric(mesh: Mesh, faces: int) -> Mesh:
    import igl

    vertices, triangles = igl.qslim(np.asfortranarray(mesh.vertices),
                                    np.asfortranarray(mesh.faces, dtype=np.int32), faces)[:2]
    return Mesh(vertices, triangles)


def _even(mesh: Mesh, faces: int) -> Mesh:
    """Shortest edges collapse to their middles, which are then put back onto the surface."""
    import igl

    vertices, triangles = igl.decimate(np.asfortranarray(mesh.vertices),
                                       np.asfortranarray(mesh.faces, dtype=np.int32), faces)[:2]
    smaller = Mesh(vertices, triangles)
    placed = np.array(vertices)
    inner = np.setdiff1d(np.arange(len(placed)), smaller.boundary_vertices)
    placed[inner] = Surface(mesh).closest(placed[inner]).points
    return smaller.with_vertices(placed)


def _fast(mesh: Mesh, faces: int) -> Mesh:
    import fast_simplification

    vertices, triangles = fast_simplification.simplify(mesh.vertices.astype(np.float32),
                                                       mesh.faces.astype(np.int32), target_count=faces)
    return repair(Mesh(vertices, triangles))


def _open3d(mesh: Mesh, faces: int) -> Mesh:
    from .open3d_filters import quadric_decimation

    return quadric_decimation(mesh, faces)


def _pymeshlab(mesh: Mesh, faces: int) -> Mesh:
    from .pymeshlab_filters import quadric_decimation

    return quadric_decimation(mesh, faces)


_METHODS = {"quadric": _quadric, "even": _even, "fast": _fast, "open3d": _open3d, "pymeshlab": _pymeshlab}
