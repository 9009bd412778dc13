"""Subdivision of control meshes: uniform, or adaptive where the surface is curved; always without cracks [Statues].

A new vertex lies in the middle of an edge. It is a place on a control triangle, shared by all triangles around it, also
across seams of the chart.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from scanprep.geometry.mesh import Mesh

from ..control.chart import Chart

# Points of a triangle by number: corners 0, 1, 2 and midpoints 3 of 01, 4 of 12, 5 of 20. For each set of split sides
# (bits 1, 2, 4) the new triangles; with two split sides the other diagonal has 8 added.
_PATTERNS = {
    0: [(0, 1, 2)], 1: [(0, 3, 2), (3, 1, 2)], 2: [(0, 1, 4), (0, 4, 2)], 4: [(0, 1, 5), (5, 1, 2)],
    3: [(3, 1, 4), (0, 3, 4), (0, 4, 2)], 6: [(4, 2, 5), (1, 4, 5), (1, 5, 0)], 5: [(5, 0, 3), (2, 5, 3), (2, 3, 1)],
    7: [(0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)],
    8 + 3: [(3, 1, 4), (0, 3, 2), (3, 4, 2)], 8 + 6: [(4, 2, 5), (1, 4, 0), (4, 5, 0)],
    8 + 5: [(5, 0, 3), (2, 5, 1), (5, 3, 1)]}
PROBES = np.arange(1, 8) / 8         # points along an edge where the surface is compared with it
INNER = np.array([(2, 2, 2), (4, 1, 1), (1, 4, 1), (1, 1, 4)]) / 6      # the same inside a triangle

# places: triangles (n,) of the control mesh and barycentric coordinates (n, 3) -> points (n, 3), metres
Displaced = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class Subdivision:
    """A finer triangulation of a control mesh."""

    faces: np.ndarray        # (f, 3)
    parent: np.ndarray       # (n,), a triangle of the control mesh on which each vertex lies
    bary: np.ndarray         # (n, 3), its place there
    face_parent: np.ndarray  # (f,), the control triangle of every triangle
    chart: Chart             # the finer triangles in the image; vertices on a seam have several places in it

    def points(self, mesh: Mesh) -> np.ndarray:
        """Compute the vertices (n, 3) on a control mesh, not displaced."""
        return np.einsum("nc,ncd->nd", self.bary, mesh.vertices[mesh.faces[self.parent]])

    def mesh(self, mesh: Mesh) -> Mesh:
        """Build the surface of a control mesh in the finer triangles."""
        return Mesh(self.points(mesh), self.faces)


@dataclass(frozen=True, eq=False)
class _Corners:
    """Triangles by their corners: vertex (f, k), row of the chart (f, k) and place on the parent (f, k, 3)."""

    vertex: np.ndarray
    row: np.ndarray
    bary: np.ndarray
    parent: np.ndarray
    uv: np.ndarray


def chart_places(chart: Chart, faces: np.ndarray, bary: np.ndarray) -> np.ndarray:
    """Compute texture coordinates (n, 2) of places on triangles. [Statues] Eq. 21"""
    return np.einsum("nc,ncd->nd", bary, chart.uv[chart.faces[faces]])


def subdivide_uniform(mesh: Mesh, chart: Chart, level: int) -> Subdivision:
    """Divide every triangle into four, `level` times."""
    return _subdivide(mesh, chart, level, lambda now: np.ones(now.vertex.shape, dtype=bool))


def subdivide_adaptive(mesh: Mesh, chart: Chart, displaced: Displaced, tolerance: float, level: int) -> Subdivision:
    """Split edges, at most `level` times, where the displaced surface is farther from them than a tolerance, metres.

    The distance is tested along the edge and inside the triangles beside it. The decision is the same for both sides of
    an edge, so no vertex lies on a neighbour's edge. Fig. 16 of [Statues] splits where the displacement is larger; but
    a flat part needs no triangles, however far it is displaced.
    """
    return _subdivide(mesh, chart, level, lambda now: _find_curved_sides(now, displaced, tolerance))


def split_long_sides(mesh: Mesh, longest: float) -> Mesh:
    """Divide triangles until no side is longer than `longest`, metres; the surface stays as it is, without a crack."""
    if mesh.edge_lengths.max(initial=0) <= longest:
        return mesh
    mesh = mesh.submesh(np.arange(len(mesh.faces)))[0]                  # without unused vertices

    def find_long(now: _Corners) -> np.ndarray:
        corners = np.einsum("fkc,fcd->fkd", now.bary, mesh.corners[now.parent])
        return np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2) > longest

    levels = int(np.ceil(np.log2(mesh.edge_lengths.max() / longest))) + 1
    fine = _subdivide(mesh, Chart(np.zeros((len(mesh.vertices), 2)), mesh.faces), levels, find_long)
    colors = None if mesh.colors is None else np.einsum("nc,ncd->nd", fine.bary, mesh.colors[mesh.faces[fine.parent]])
    return Mesh(np.einsum("nc,ncd->nd", fine.bary, mesh.corners[fine.parent]), fine.faces, colors)


def _subdivide(mesh: Mesh, chart: Chart, level: int, choose: Callable[[_Corners], np.ndarray]) -> Subdivision:
    """Split the sides (f, 3) that `choose` marks, `level` times or until it marks none."""
    now = _Corners(mesh.faces, chart.faces, np.tile(np.eye(3), (len(mesh.faces), 1, 1)), np.arange(len(mesh.faces)),
                   chart.uv)
    for _ in range(level):
        marked = choose(now)
        if not marked.any():
            break
        now = _split(now, marked, mesh)
    _, first = np.unique(now.vertex, return_index=True)     # the first triangle around a vertex places it
    return Subdivision(now.vertex, now.parent[first // 3], now.bary.reshape(-1, 3)[first], now.parent,
                       Chart(now.uv, now.row))


def _sides(vertex: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find where every edge first occurs among the 3 f sides, and the edge of each side (f, 3)."""
    a, b = vertex, np.roll(vertex, -1, axis=1)
    key = np.minimum(a, b) * (vertex.max() + 1) + np.maximum(a, b)
    _, first, edge = np.unique(key, return_index=True, return_inverse=True)
    return first, edge.reshape(-1, 3)


def _split(now: _Corners, marked: np.ndarray, mesh: Mesh) -> _Corners:
    """Split the marked sides (f, 3) of the triangles."""
    middle = 0.5 * (now.bary + np.roll(now.bary, -1, axis=1))
    vertex, _ = _with_middles(now.vertex, marked)
    row, halved = _with_middles(now.row, marked)
    uv = np.concatenate([now.uv, 0.5 * now.uv[halved].sum(axis=1)])
    bary = np.concatenate([now.bary, middle], axis=1)
    pattern = marked @ np.array([1, 2, 4])
    diagonals = {3: ((0, 4), (3, 2)), 6: ((1, 5), (4, 0)), 5: ((2, 3), (5, 1))}  # of the two ways
    for number, ways in diagonals.items():                 # with two split sides, choose the shorter diagonal
        which = np.flatnonzero(pattern == number)
        points = np.einsum("fkc,fcd->fkd", bary[which], mesh.corners[now.parent[which]])
        one, other = (np.linalg.norm(points[:, a] - points[:, b], axis=1) for a, b in ways)
        pattern[which] += 8 * (other < one)
    parts = []
    for number, triangles in _PATTERNS.items():
        which = np.flatnonzero(pattern == number)
        for triangle in triangles if len(which) else ():
            pick = np.array(triangle)
            parts.append((which, vertex[which][:, pick], row[which][:, pick], bary[which][:, pick]))
    face = np.concatenate([which for which, *_ in parts])
    order = np.argsort(face, kind="stable")                 # the parts of a triangle side by side
    v, r, b = (np.concatenate([part[i] for part in parts])[order] for i in (1, 2, 3))
    return _Corners(v, r, b, now.parent[face[order]], uv)


def _with_middles(faces: np.ndarray, marked: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Add midpoints: triangles (f, 6) by corners and midpoints, -1 for whole sides, and ends (m, 2) of split edges."""
    first, edge = _sides(faces)
    count = faces.max() + 1
    split = marked.ravel()[first]
    number = np.where(split, count + np.cumsum(split) - 1, -1)
    ends = np.stack([faces.ravel(), np.roll(faces, -1, axis=1).ravel()], axis=1)[first[split]]
    return np.concatenate([faces, number[edge]], axis=1), ends


def _find_curved_sides(now: _Corners, displaced: Displaced, tolerance: float) -> np.ndarray:
    """Find sides (f, 3) along or beside which the displaced surface is farther than the tolerance."""
    first, edge = _sides(now.vertex)
    face, side = np.divmod(first, 3)
    ends = np.stack([now.bary[face, side], now.bary[face, (side + 1) % 3]], axis=1)
    along = np.stack([1 - PROBES, PROBES], axis=1)
    bent = _deviation(ends, now.parent[face], along, displaced) > tolerance
    inside = _deviation(now.bary, now.parent, INNER, displaced) > tolerance
    bent[edge[inside]] = True
    return bent[edge]


def _deviation(corners: np.ndarray, parent: np.ndarray, probes: np.ndarray, displaced: Displaced) -> np.ndarray:
    """Compute the largest distance (m,) of the surface from edges or triangles with corners (m, k, 3) on it."""
    count, k, p = len(corners), corners.shape[1], len(probes)
    at = displaced(np.repeat(parent, k), corners.reshape(-1, 3)).reshape(count, k, 3)
    between = np.einsum("pk,mkc->mpc", probes, corners).reshape(-1, 3)
    true = displaced(np.repeat(parent, p), between).reshape(count, p, 3)
    return np.linalg.norm(true - np.einsum("pk,mkd->mpd", probes, at), axis=2).max(axis=1)
