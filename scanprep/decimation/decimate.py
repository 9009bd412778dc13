"""Fewer triangles for the same surface [QEM]."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from ..geometry.mesh import Mesh
from ..geometry.surface import Surface
from ..ranges import Settings
from .edge_collapse import FIXED, RoundsConfig
from .quadrics import sum_at
from .remeshing import improve_triangles
from .safe_collapses import fast_collapses
from .start import begin

METHODS = ("quadric", "even", "fast", "open3d", "pymeshlab")


@dataclass(frozen=True)
class DecimateConfig(Settings):
    """Settings of `decimate`.

    Attributes
    ----------
    method : str
        "quadric": least-error collapses, small triangles where the surface bends [QEM]. "even": shortest edges
        first, triangles of one size. "fast": the collapses of fast-simplification without those that break the
        surface, quicker and rougher than "quadric". All three keep a closed manifold mesh closed and manifold.
        "open3d" and "pymeshlab" need these libraries.
    improve : bool
        Turn edges and move vertices along the original surface for well-shaped triangles.
    crease : float, radians, optional
        Edges at which the surface bends by more stay edges; "quadric" only.
    rounds : RoundsConfig
        Further settings of "quadric".
    """

    method: Literal["quadric", "even", "fast", "open3d", "pymeshlab"] = "quadric"
    improve: bool = False
    crease: float | None = None
    rounds: RoundsConfig = field(default_factory=RoundsConfig)


@dataclass(frozen=True, eq=False)
class Decimation:
    """A mesh of fewer triangles, and what became of the original ones.

    Attributes
    ----------
    mesh : Mesh
    owner : (N,) int
        The new vertex that stands for each original one.
    vertex_map : (n,) int
        An original vertex of every new one: the one that collapses left over.
    face_map : (f,) int
        The original triangle of every new one.
    """

    mesh: Mesh
    owner: np.ndarray
    vertex_map: np.ndarray
    face_map: np.ndarray


def decimate(mesh: Mesh, faces: int, config: DecimateConfig | None = None, keep: np.ndarray | None = None,
             labels: np.ndarray | None = None, progress: Callable[[int, int], None] | None = None) -> Mesh:
    """Collapse edges until about `faces` triangles are left.

    Parameters
    ----------
    mesh : Mesh
        Manifold, closed or with borders.
    faces : int
        A mesh that has no more is returned as it is.
    config : DecimateConfig, optional
    keep : (n,) int, optional
        Vertices that stay where they are; "quadric" only.
    labels : (F,) int, optional
        Part of every triangle: borders between parts stay curves; "quadric" only.
    progress : callback(done, total), optional
        Triangles taken away, and how many have to be; "quadric" only.

    Returns
    -------
    Mesh
        A vertex has the mean colour of those that became it.

    Raises
    ------
    ValueError
        Fewer than 4 triangles wanted, an unknown method, a method that cannot keep what should stay, or a mesh that
        is not manifold.

    [QEM] pair contraction
    """
    config = config or DecimateConfig()
    if config.method not in METHODS:
        raise ValueError(f"config.method: expected one of {', '.join(METHODS)}, got {config.method!r}")
    _check(mesh, faces)
    if faces >= len(mesh.faces):
        return mesh
    if config.method == "quadric":
        return _improved(collapse(mesh, faces, config, keep, labels, progress).mesh, mesh, config.improve)
    for name, value in (("keep", keep), ("labels", labels), ("config.crease", config.crease)):
        if value is not None:
            raise ValueError(f"{name}: the method {config.method!r} cannot keep them; expected 'quadric'")
    return _improved(_OTHERS[config.method](mesh, faces), mesh, config.improve)


def collapse(mesh: Mesh, faces: int, config: DecimateConfig | None = None, keep: np.ndarray | None = None,
             labels: np.ndarray | None = None, progress: Callable[[int, int], None] | None = None) -> Decimation:
    """Like `decimate` with the method "quadric", and says what became of every vertex and triangle.

    [QEM] pair contraction
    """
    config = config or DecimateConfig()
    _check(mesh, faces)
    centre = mesh.vertices.mean(axis=0)                       # quadrics lose digits far from the origin
    rounds = begin(mesh, (mesh.vertices - centre)[:, None], config.rounds, keep, labels, config.crease)
    rounds.run(faces, progress)
    kept, owner = rounds.numbered()
    vertices = rounds.points[kept, 0] + centre
    same = rounds.kinds[kept] == FIXED
    vertices[same] = mesh.vertices[kept[same]]
    smaller = Mesh(vertices, owner[mesh.faces[rounds.face_rows]], _mean_colors(mesh, owner, len(kept)))
    return Decimation(smaller, owner, kept, rounds.face_rows)


def _check(mesh: Mesh, faces: int) -> None:
    if faces < 4:
        raise ValueError(f"faces: expected at least 4, got {faces}")
    if not (mesh.is_edge_manifold and mesh.is_vertex_manifold):
        raise ValueError("mesh: expected a manifold surface; repair it first")


def _mean_colors(mesh: Mesh, owner: np.ndarray, count: int) -> np.ndarray | None:
    """Colours of new vertices: means over what collapsed into them, by area."""
    if mesh.colors is None:
        return None
    weight = mesh.vertex_areas + 1e-300
    total = sum_at(owner[:, None], np.column_stack([mesh.colors * weight[:, None], weight]), count)
    return np.clip(total[:, :3] / total[:, 3:], 0, 1)


def _improved(smaller: Mesh, mesh: Mesh, improve: bool) -> Mesh:
    if smaller.colors is None and mesh.colors is not None:
        nearest = cKDTree(mesh.vertices).query(smaller.vertices)[1]
        smaller = Mesh(smaller.vertices, smaller.faces, mesh.colors[nearest])
    return improve_triangles(smaller, Surface(mesh)) if improve else smaller


def _even(mesh: Mesh, faces: int) -> Mesh:
    """Shortest edges collapse to their middles, which are then put back onto the surface."""
    import igl

    vertices, triangles = igl.decimate(np.asfortranarray(mesh.vertices), np.asfortranarray(mesh.faces), faces)[:2]
    smaller = Mesh(vertices, triangles)
    placed = np.array(vertices)
    inner = np.setdiff1d(np.arange(len(placed)), smaller.boundary_vertices)
    placed[inner] = Surface(mesh).closest(placed[inner]).points
    return smaller.with_vertices(placed)


def _fast(mesh: Mesh, faces: int) -> Mesh:
    mended = fast_collapses(mesh, faces)
    return mended if len(mended.faces) <= faces else collapse(mended, faces).mesh


def _open3d(mesh: Mesh, faces: int) -> Mesh:
    from ..adapters.open3d_filters import quadric_decimation

    return quadric_decimation(mesh, faces)


def _pymeshlab(mesh: Mesh, faces: int) -> Mesh:
    from ..adapters.pymeshlab_filters import quadric_decimation

    return quadric_decimation(mesh, faces)


_OTHERS = {"even": _even, "fast": _fast, "open3d": _open3d, "pymeshlab": _pymeshlab}
