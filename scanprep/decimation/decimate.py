"""Reduce the triangles of a mesh, keeping its surface [QEM]."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal, get_args

import numpy as np
from scipy.spatial import cKDTree

from ..geometry.mesh import Mesh, take_any_mesh
from ..geometry.remeshing import improve_triangles
from ..geometry.surface import Surface
from ..ranges import FLAG, Settings
from .edge_collapse import FIXED, Rounds
from .quadrics import sum_at

Method = Literal["quadric", "even", "pymeshlab"]


@dataclass(frozen=True)
class DecimateConfig(Settings):
    """Settings of `decimate`.

    Attributes
    ----------
    method : str
        "quadric": least-error collapses, small triangles where the surface bends [QEM]. "even": shortest edges
        first, triangles of equal size. Both keep a closed manifold mesh closed and manifold. "pymeshlab": least-error
        collapses of MeshLab, which is under the GPL.
    improve : bool
        Flip edges and move vertices along the original surface, for well-shaped triangles.

    Examples
    --------
    >>> DecimateConfig(improve=True).method
    'quadric'
    """

    method: Annotated[Method, FLAG] = "quadric"
    improve: bool = False


@take_any_mesh
def decimate(mesh: Mesh, faces: int, config: DecimateConfig | None = None, keep: np.ndarray | None = None,
             progress: Callable[[int, int], None] | None = None) -> Mesh:
    """Collapse edges until about `faces` triangles are left.

    Parameters
    ----------
    mesh : Mesh
        Manifold, closed or with borders; vertices in metres.
    faces : int
        Number of triangles to reach. A mesh that has no more is returned unchanged.
    config : DecimateConfig, optional
        Settings.
    keep : (n,) int, optional
        Vertices that stay in place; "quadric" only.
    progress : callable, optional
        Called as progress(removed, total) with numbers of triangles; "quadric" only.

    Returns
    -------
    Mesh
        Vertices in metres. A vertex has the mean colour of those that collapsed into it.

    Raises
    ------
    ValueError
        Fewer than 4 triangles asked for, an unknown method, a method that cannot keep what should stay, or a mesh that
        is not manifold.

    Examples
    --------
    >>> from scanprep.synthetic.people import SyntheticPerson
    >>> decimate(SyntheticPerson().mesh, 500).faces.shape
    (500, 3)

    [QEM] pair contraction
    """
    config = config or DecimateConfig()
    if config.method not in get_args(Method):
        raise ValueError(f"config.method: expected one of {', '.join(get_args(Method))}, got {config.method!r}")
    if faces < 4:
        raise ValueError(f"faces: expected at least 4, got {faces}")
    if not (mesh.is_edge_manifold and mesh.is_vertex_manifold):
        raise ValueError("mesh: expected a manifold surface; repair it first")
    if faces >= len(mesh.faces):
        return mesh
    if config.method == "quadric":
        smaller = _collapse(mesh, faces, keep, progress)
    else:
        if keep is not None:
            raise ValueError(f"keep: the method {config.method!r} cannot keep them; expected 'quadric'")
        smaller = _evenly(mesh, faces) if config.method == "even" else _by_meshlab(mesh, faces)
    # methods that drop colours take those of the nearest vertex
    if smaller.colors is None and mesh.colors is not None:
        nearest = cKDTree(mesh.vertices).query(smaller.vertices)[1]
        smaller = Mesh(smaller.vertices, smaller.faces, mesh.colors[nearest])
    if not config.improve:
        return smaller
    fixed = None if keep is None else np.unique(cKDTree(smaller.vertices).query(mesh.vertices[keep])[1])
    return improve_triangles(smaller, Surface(mesh), fixed)


def _collapse(mesh: Mesh, faces: int, keep: np.ndarray | None, progress: Callable[[int, int], None] | None) -> Mesh:
    """Decimate with the method "quadric".

    [QEM] pair contraction
    """
    centre = mesh.vertices.mean(axis=0)                       # far from the origin quadrics lose digits
    rounds = Rounds(mesh, (mesh.vertices - centre)[:, None], keep)
    rounds.run(faces, progress)
    kept, owner = rounds.renumber()
    vertices = rounds.points[kept, 0] + centre
    # vertices that stay get their exact coordinates back
    same = rounds.kinds[kept] == FIXED
    vertices[same] = mesh.vertices[kept[same]]
    return Mesh(vertices, owner[mesh.faces[rounds.face_rows]], _mean_colors(mesh, owner, len(kept)))


def _mean_colors(mesh: Mesh, owner: np.ndarray, count: int) -> np.ndarray | None:
    """Average colours (n, 3) over the vertices that collapsed into each new one, weighted by area."""
    if mesh.colors is None:
        return None
    weight = mesh.vertex_areas + 1e-300
    total = sum_at(owner[:, None], np.column_stack([mesh.colors * weight[:, None], weight]), count)
    return np.clip(total[:, :3] / total[:, 3:], 0, 1)


def _evenly(mesh: Mesh, faces: int) -> Mesh:
    """Decimate with the method "even": shortest edges collapse to their midpoints, which are moved to the surface."""
    import igl

    vertices, triangles = igl.decimate(np.asfortranarray(mesh.vertices), np.asfortranarray(mesh.faces), faces)[:2]
    smaller = Mesh(vertices, triangles)
    placed = np.array(vertices)
    inner = np.setdiff1d(np.arange(len(placed)), smaller.boundary_vertices)
    placed[inner] = Surface(mesh).closest(placed[inner]).points
    return smaller.with_vertices(placed)


def _by_meshlab(mesh: Mesh, faces: int) -> Mesh:
    """Decimate with the method "pymeshlab"; its adapter is loaded only here."""
    from ..adapters.pymeshlab_filters import meshlab_decimation

    return meshlab_decimation(mesh, faces)
