"""Space around a control mesh: a triangle, a place on it and a height along its interpolated normal [Statues].

The normals of a triangle's corners are interpolated linearly and not made unit length again, as in Eq. 20: only so is a
point of the volume a linear function of its place for a given height, and heights are what the corners' normals say.

The paper finds the height from the plane that is parallel to the triangle and passes through the point and a
displaced corner. That is exact only where the three corners' normals rise equally fast above the triangle.
Eliminating the place from Eq. 19 instead says that the point lies in the plane of the three corners
displaced by d, det[v_r + d n_r - p, v_s + d n_s - p, v_t + d n_t - p] = 0: a cubic in d, solved here.
"""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import checked_points

EDGE = 1e-9                          # barycentric coordinates this far below zero still lie in a triangle
PAIRS = 250_000                      # points with triangles that are solved at once
STEPS = 60                           # of a search between two signs: each at least halves it, most stop after 8


@dataclass(frozen=True, eq=False)
class NormalCoordinates:
    """Points as places on a control mesh with heights above it. [Statues] Eq. 19"""

    faces: np.ndarray      # (n,), triangle of the control mesh, -1 where a point lies in the volume of none
    bary: np.ndarray       # (n, 3), barycentric coordinates; zero where there is no triangle
    heights: np.ndarray    # (n,) metres, along the interpolated normal, which is shorter than 1; NaN where there is no
                           # triangle
    solutions: np.ndarray  # (n,), how many places of the mesh reach the point: 0 outside the volume, 1 where it is one-
                           # to-one

    @property
    def inside(self) -> np.ndarray:
        """(n,) bool: some triangle's volume holds the point."""
        return self.faces >= 0


def interpolate(mesh: Mesh, faces: np.ndarray, bary: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) of a control mesh and its normals there (n, 3), of length up to 1. [Statues] Eq. 20"""
    corners = mesh.faces[faces]
    return (np.einsum("nc,ncd->nd", bary, mesh.vertices[corners]),
            np.einsum("nc,ncd->nd", bary, mesh.vertex_normals[corners]))


def from_normal_volume(mesh: Mesh, coordinates: NormalCoordinates) -> np.ndarray:
    """The points (n, 3) of normal coordinates; NaN where they are in no triangle's volume. [Statues] Eq. 19"""
    p, n = interpolate(mesh, coordinates.faces, coordinates.bary)
    return p + coordinates.heights[:, None] * n


def to_normal_volume(mesh: Mesh, points: np.ndarray, reach: float) -> NormalCoordinates:
    """Every point's (n, 3) triangle, place and least height, at most `reach` metres up or down, among all triangles of
    a control mesh. [Statues] Eq. 19, 20
    """
    points = checked_points(points)
    if not 0 < reach < np.inf:
        raise ValueError(f"reach: expected a length above 0, got {reach}")
    count = len(points)
    face, bary = np.full(count, -1), np.zeros((count, 3))
    height, solutions = np.full(count, np.nan), np.zeros(count, dtype=np.int64)
    best = np.full(count, np.inf)
    places: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for which, triangle in _near(mesh, points, reach):
        pair, d, b = solve_triangles(mesh, triangle, points[which], reach)
        who = which[pair]
        places.append((who, np.einsum("nc,ncd->nd", b, mesh.corners[triangle[pair]]), d))
        order = np.argsort(-np.abs(d), kind="stable")           # of several the least is written last
        who, d, b, of = who[order], d[order], b[order], triangle[pair][order]
        better = np.abs(d) < best[who]
        who, d, b, of = who[better], d[better], b[better], of[better]
        best[who] = np.inf
        face[who], bary[who], height[who], best[who] = of, b, d, np.abs(d)
    if places:
        solutions = _count_places(count, *(np.concatenate(part) for part in zip(*places, strict=True)))
    return NormalCoordinates(face, bary, height, solutions)


def solve_triangles(mesh: Mesh, faces: np.ndarray, points: np.ndarray, reach: float
                    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Heights at which points (n, 3) lie in given triangles (n,), displaced; only where these are not turned over.
    Which pair each solution is of (k,), its height (k,) in metres, its bary (k, 3).
    """
    v = mesh.corners[faces] - points[:, None]
    n = mesh.vertex_normals[mesh.faces[faces]]
    pair, d = _roots(_cubic(v, n * reach))
    w = v[pair] + (reach * d)[:, None, None] * n[pair]
    N = np.cross(w[:, 1] - w[:, 0], w[:, 2] - w[:, 0])
    b = np.stack([np.einsum("nd,nd->n", np.cross(w[:, i - 2], w[:, i - 1]), N) for i in range(3)], axis=1)
    b /= np.maximum(b.sum(axis=1), 1e-300)[:, None]
    upright = np.einsum("nd,nd->n", N, np.einsum("nc,ncd->nd", b, n[pair])) > 0
    good = upright & (b >= -EDGE).all(axis=1)
    b = np.clip(b[good], 0, None)
    return pair[good], reach * d[good], b / b.sum(axis=1, keepdims=True)


def _cubic(v: np.ndarray, n: np.ndarray) -> np.ndarray:
    """(k, 4) coefficients of det[v_r + x n_r, v_s + x n_s, v_t + x n_t], the constant first."""
    def det(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
        return np.einsum("nd,nd->n", a, np.cross(b, c))

    (a, b, c), (p, q, r) = v.transpose(1, 0, 2), n.transpose(1, 0, 2)
    return np.stack([det(a, b, c), det(p, b, c) + det(a, q, c) + det(a, b, r),
                     det(p, q, c) + det(p, b, r) + det(a, q, r), det(p, q, r)], axis=1)


def _roots(c: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Real roots in [-1, 1] of cubics (k, 4), whose leading coefficient may vanish.

    Between its turning points a cubic has one root or none: there Newton's steps, halving where they would leave.
    """
    a, b, k = 3 * c[:, 3], c[:, 2], c[:, 1]                  # its derivative is a x² + 2 b x + k
    root = np.sqrt(np.maximum(b * b - a * k, 0))
    q = -(b + np.copysign(root, b))
    with np.errstate(divide="ignore", invalid="ignore"):
        turns = np.sort(np.clip(np.nan_to_num(np.stack([q / a, k / q], axis=1), nan=1.0), -1, 1), axis=1)
    ends = np.column_stack([-np.ones(len(c)), turns, np.ones(len(c))])
    at = _value(c[:, None], ends)
    cubic, piece = np.nonzero((np.signbit(at[:, :-1]) != np.signbit(at[:, 1:])) & (ends[:, :-1] < ends[:, 1:]))
    low, high, c = ends[cubic, piece], ends[cubic, piece + 1], c[cubic]
    rising = at[cubic, piece] < 0
    x = 0.5 * (low + high)
    for _ in range(STEPS):
        value = _value(c, x)
        above = (value > 0) == rising
        low, high = np.where(above, low, x), np.where(above, x, high)
        with np.errstate(divide="ignore", invalid="ignore"):
            step = x - value / (c[:, 1] + x * (2 * c[:, 2] + 3 * x * c[:, 3]))
        inside = (step > low) & (step < high)
        following = np.where(inside, step, 0.5 * (low + high))
        done = np.abs(following - x).max(initial=0) < 1e-15
        x = following
        if done:
            break
    return cubic, x


def _value(c: np.ndarray, x: np.ndarray) -> np.ndarray:
    return c[..., 0] + x * (c[..., 1] + x * (c[..., 2] + x * c[..., 3]))


def _near(mesh: Mesh, points: np.ndarray, reach: float) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Pairs (points, triangles) in batches: all where a point may lie in a triangle's volume, and some more.

    The volume lies in the convex hull of the corners displaced up and down, so in its box and the ball around it.
    """
    if not len(points) or not len(mesh.faces):
        return
    shift = reach * mesh.vertex_normals[mesh.faces]
    hull = np.concatenate([mesh.corners + shift, mesh.corners - shift], axis=1)
    low, high = hull.min(axis=1) - 1e-9, hull.max(axis=1) + 1e-9
    center = hull.mean(axis=1)
    radius = np.linalg.norm(hull - center[:, None], axis=2).max(axis=1) + 1e-9
    tree = cKDTree(points)
    held: list[tuple[np.ndarray, np.ndarray]] = []
    total = 0
    for face in range(len(center)):
        which = np.array(tree.query_ball_point(center[face], radius[face]), dtype=np.int64)
        if len(which):
            at = points[which]
            which = which[((at > low[face]) & (at < high[face])).all(axis=1)]
        held.append((which, np.full(len(which), face)))
        total += len(which)
        if total and (total > PAIRS or face == len(center) - 1):
            yield np.concatenate([w for w, _ in held]), np.concatenate([f for _, f in held])
            held, total = [], 0


def _count_places(count: int, who: np.ndarray, at: np.ndarray, d: np.ndarray) -> np.ndarray:
    """(count,) different places on the mesh per point: one on an edge is found in both triangles."""
    found = np.bincount(who, minlength=count)
    several = found[who] > 1
    who, at, d = who[several], at[several], d[several]
    order = np.lexsort((d, who))
    who, at = who[order], at[order]
    same = (who[1:] == who[:-1]) & (np.linalg.norm(at[1:] - at[:-1], axis=1) < 1e-7)
    return found - np.bincount(who[1:][same], minlength=count)
