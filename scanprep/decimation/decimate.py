"""Reduce the triangles of a mesh, keeping its surface [QEM]."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple, get_args

import numpy as np
from scipy.spatial import cKDTree

from ..geometry.mesh import Mesh, take_any_mesh
from ..geometry.remeshing import improve_triangles
from ..geometry.surface import Surface
from ..ranges import FLAG, Settings
from .edge_collapse import FIXED, HOLD, Rounds, final_owner
from .quadrics import minimise_quadrics, sum_at, surface_quadrics

Method = Literal["quadric", "even", "fast", "open3d", "pymeshlab"]


@dataclass(frozen=True)
class DecimateConfig(Settings):
    """Settings of `decimate`.

    Attributes
    ----------
    method : str
        "quadric": least-error collapses, small triangles where the surface bends [QEM]. "even": shortest edges
        first, triangles of equal size. "fast": the collapses of fast-simplification, without those that break the
        surface; faster and rougher than "quadric". All three keep a closed manifold mesh closed and manifold.
        "open3d" and "pymeshlab" need these libraries.
    improve : bool
        Flip edges and move vertices along the original surface, for well-shaped triangles.
    crease : float, radians, optional
        Edges where the surface bends by more are kept; "quadric" only.

    Examples
    --------
    >>> DecimateConfig(improve=True).method
    'quadric'
    """

    method: Annotated[Method, FLAG] = "quadric"
    improve: bool = False
    crease: float | None = None


class Decimation(NamedTuple):
    """A decimated mesh, and its map to the original one."""

    mesh: Mesh
    owner: np.ndarray           # (N,) the new vertex of each original one
    vertex_map: np.ndarray      # (n,) the original vertex of every new one: the survivor of its collapses
    face_map: np.ndarray        # (f,) the original triangle of every new one


@take_any_mesh
def decimate(mesh: Mesh, faces: int, config: DecimateConfig | None = None, keep: np.ndarray | None = None,
             labels: np.ndarray | None = None, progress: Callable[[int, int], None] | None = None) -> Mesh:
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
    labels : (F,) int, optional
        Part of every triangle: borders between parts are preserved; "quadric" only.
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
    _check(mesh, faces)
    if faces >= len(mesh.faces):
        return mesh
    if config.method == "quadric":
        smaller = collapse(mesh, faces, config.crease, keep, labels, progress).mesh
    else:
        for name, value in (("keep", keep), ("labels", labels), ("config.crease", config.crease)):
            if value is not None:
                raise ValueError(f"{name}: the method {config.method!r} cannot keep them; expected 'quadric'")
        smaller = _by_library(mesh, faces, config.method)
    # methods that drop colours take those of the nearest vertex
    if smaller.colors is None and mesh.colors is not None:
        nearest = cKDTree(mesh.vertices).query(smaller.vertices)[1]
        smaller = Mesh(smaller.vertices, smaller.faces, mesh.colors[nearest])
    if not config.improve:
        return smaller
    fixed = None if keep is None else np.unique(cKDTree(smaller.vertices).query(mesh.vertices[keep])[1])
    return improve_triangles(smaller, Surface(mesh), fixed)


def collapse(mesh: Mesh, faces: int, crease: float | None = None, keep: np.ndarray | None = None,
             labels: np.ndarray | None = None, progress: Callable[[int, int], None] | None = None) -> Decimation:
    """Decimate with the method "quadric", and return the map of every vertex and triangle.

    [QEM] pair contraction
    """
    _check(mesh, faces)
    centre = mesh.vertices.mean(axis=0)                       # far from the origin quadrics lose digits
    rounds = Rounds(mesh, (mesh.vertices - centre)[:, None], keep, labels, crease)
    rounds.run(faces, progress)
    kept, owner = rounds.renumber()
    vertices = rounds.points[kept, 0] + centre
    # vertices that stay get their exact coordinates back
    same = rounds.kinds[kept] == FIXED
    vertices[same] = mesh.vertices[kept[same]]
    smaller = Mesh(vertices, owner[mesh.faces[rounds.face_rows]], _mean_colors(mesh, owner, len(kept)))
    return Decimation(smaller, owner, kept, rounds.face_rows)


def _check(mesh: Mesh, faces: int) -> None:
    """Raise ValueError for fewer than 4 triangles or a mesh that is not manifold."""
    if faces < 4:
        raise ValueError(f"faces: expected at least 4, got {faces}")
    if not (mesh.is_edge_manifold and mesh.is_vertex_manifold):
        raise ValueError("mesh: expected a manifold surface; repair it first")


def _mean_colors(mesh: Mesh, owner: np.ndarray, count: int) -> np.ndarray | None:
    """Average colours (n, 3) over the vertices that collapsed into each new one, weighted by area."""
    if mesh.colors is None:
        return None
    weight = mesh.vertex_areas + 1e-300
    total = sum_at(owner[:, None], np.column_stack([mesh.colors * weight[:, None], weight]), count)
    return np.clip(total[:, :3] / total[:, 3:], 0, 1)


def _by_library(mesh: Mesh, faces: int, method: Method) -> Mesh:
    """Decimate with one of the library methods."""
    if method == "even":
        # shortest edges collapse to their midpoints, which are then projected onto the surface
        import igl

        vertices, triangles = igl.decimate(np.asfortranarray(mesh.vertices), np.asfortranarray(mesh.faces), faces)[:2]
        smaller = Mesh(vertices, triangles)
        placed = np.array(vertices)
        inner = np.setdiff1d(np.arange(len(placed)), smaller.boundary_vertices)
        placed[inner] = Surface(mesh).closest(placed[inner]).points
        return smaller.with_vertices(placed)
    if method == "fast":
        mended = fast_collapses(mesh, faces)
        return mended if len(mended.faces) <= faces else collapse(mended, faces).mesh
    if method == "open3d":
        from ..adapters.open3d_filters import open3d_decimation as library_decimation
    else:
        from ..adapters.pymeshlab_filters import meshlab_decimation as library_decimation
    return library_decimation(mesh, faces)


def fast_collapses(mesh: Mesh, faces: int) -> Mesh:
    """Decimate by the collapses of fast-simplification, in their order.

    The library does not check topology. Collapses that make the surface non-manifold are undone, last ones first. So
    some triangles more than wanted may remain.

    [QEM] pair contraction
    """
    import fast_simplification

    vertices, triangles = np.array(mesh.vertices), np.array(mesh.faces)         # the library needs writable arrays
    collapses = fast_simplification.simplify(vertices, triangles, target_count=faces, return_collapses=True)[2]
    centre = mesh.vertices.mean(axis=0)
    quadrics, areas = (x[:, 0] for x in surface_quadrics((mesh.vertices - centre)[:, None], mesh.faces, HOLD))
    undone = np.zeros(len(collapses), dtype=bool)
    while True:
        # apply the collapses that are not undone, then place every vertex by its quadric
        owner = np.arange(len(mesh.vertices))
        owner[collapses[~undone, 1]] = collapses[~undone, 0]      # the second goes into the first
        kept, number = np.unique(final_owner(owner), return_inverse=True)
        corners = number[mesh.faces]
        whole = (corners != np.roll(corners, 1, axis=1)).all(axis=1)
        smaller = Mesh(minimise_quadrics(sum_at(number[:, None], quadrics, len(kept))) + centre, corners[whole])
        # undo the latest collapse into every bad vertex, and try again
        bad = _broken(smaller, sum_at(number[:, None], areas, len(kept)))
        last = np.full(len(kept), -1)
        rows = np.flatnonzero(~undone)
        last[number[collapses[rows, 0]]] = rows                   # in order: the last one written stays
        latest = last[bad]
        if not (latest >= 0).any():
            return smaller
        undone[latest[latest >= 0]] = True


def _broken(smaller: Mesh, areas: np.ndarray) -> np.ndarray:
    """Find vertices (n,) bool where the surface is not manifold, missing, or inverted.

    `areas` (n, 3) are the summed area vectors of the original vertices of each.
    """
    bad = np.ones(len(smaller.vertices), dtype=bool)
    bad[smaller.faces] = False
    # directed edges that occur twice, vertices with several fans, duplicate triangles
    half = np.sort(smaller.faces * len(bad) + np.roll(smaller.faces, -1, axis=1), axis=None)
    twice = half[1:][half[1:] == half[:-1]]
    bad[twice // len(bad)] = bad[twice % len(bad)] = True
    bad[smaller.non_manifold_vertices] = True
    corners = np.sort(smaller.faces, axis=1)
    order = np.lexsort(corners.T)
    bad[corners[order[1:]][(corners[order[1:]] == corners[order[:-1]]).all(axis=1)]] = True
    # triangles against the area vectors of their corners are inverted
    meant = areas / np.maximum(np.linalg.norm(areas, axis=1, keepdims=True), 1e-300)
    inverted = np.einsum("fd,fd->f", smaller.face_normals, meant[smaller.faces].sum(axis=1)) < 0
    bad[smaller.faces[inverted]] = True
    return bad
