"""The normal volume of a control mesh: points as a triangle, a place on it and a height along its normal [Statues].

Normals are interpolated linearly and not normalised again, as in Eq. 20. By Eq. 19 a point p at height d lies in the
plane of the three displaced corners, det[v_r + d n_r - p, v_s + d n_s - p, v_t + d n_t - p] = 0. That is a cubic in d,
solved here. The paper's plane parallel to the triangle is exact only where the three normals are parallel.
"""
from __future__ import annotations

from dataclasses import dataclass
from itertools import chain

import numpy as np
from scipy.spatial import cKDTree

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Rays


@dataclass(frozen=True, eq=False)
class NormalCoordinates:
    """Points as places on a control mesh with heights above it. [Statues] Eq. 19"""

    faces: np.ndarray      # (n,), triangle of the control mesh, -1 where a point lies in the volume of none
    bary: np.ndarray       # (n, 3), barycentric coordinates; zero where there is no triangle
    heights: np.ndarray    # (n,) metres, along the interpolated normal; NaN where there is no triangle
    solutions: np.ndarray  # (n,), how many places of the mesh reach the point: 1 where it is one-to-one

    @property
    def inside(self) -> np.ndarray:
        """(n,) bool: some triangle's volume holds the point."""
        return self.faces >= 0


def interpolate(mesh: Mesh, faces: np.ndarray, bary: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Interpolate points (n, 3) of a control mesh and its normals there (n, 3), of length up to 1. [Statues] Eq. 20"""
    corners = mesh.faces[faces]
    return (np.einsum("nc,ncd->nd", bary, mesh.vertices[corners]),
            np.einsum("nc,ncd->nd", bary, mesh.vertex_normals[corners]))


def from_normal_volume(mesh: Mesh, faces: np.ndarray, bary: np.ndarray, heights: np.ndarray) -> np.ndarray:
    """Compute the points (n, 3) at heights (n,), metres, above places of a control mesh. [Statues] Eq. 19"""
    p, n = interpolate(mesh, faces, bary)
    return p + heights[:, None] * n


def to_normal_volume(mesh: Mesh, points: np.ndarray, reach: float) -> NormalCoordinates:
    """Find each point's (n, 3) triangle, place and smallest height, at most `reach` up or down. [Statues] Eq. 19, 20"""
    count = len(points)
    face, bary, height = np.full(count, -1), np.zeros((count, 3)), np.full(count, np.nan)
    which, triangle = _near(mesh, points, reach)
    pair, d, b = solve_triangles(mesh, triangle, points[which], reach)
    who, of = which[pair], triangle[pair]
    # different places on the mesh per point: one on an edge is found in both triangles
    places, order = np.einsum("nc,ncd->nd", b, mesh.corners[of]), np.lexsort((d, who))
    again = (np.diff(who[order]) == 0) & (np.linalg.norm(np.diff(places[order], axis=0), axis=1) < 1e-7)
    solutions = np.bincount(who, minlength=count) - np.bincount(who[order][1:][again], minlength=count)
    order = np.argsort(np.abs(d), kind="stable")
    _, first = np.unique(who[order], return_index=True)
    best = order[first]                                                 # among several the smallest height
    face[who[best]], bary[who[best]], height[who[best]] = of[best], b[best], d[best]
    return NormalCoordinates(face, bary, height, solutions)


def solve_triangles(mesh: Mesh, faces: np.ndarray, points: np.ndarray, reach: float
                    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Solve for heights at which points (n, 3) lie in displaced triangles (n,) that are not inverted.

    Returns the pair of each solution (k,), its height (k,), metres, and its barycentric coordinates (k, 3).

    [Statues] Eq. 19
    """
    def det(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
        return np.einsum("nd,nd->n", a, np.cross(b, c))

    v = mesh.corners[faces] - points[:, None]
    n = mesh.vertex_normals[mesh.faces[faces]]
    # coefficients (n, 4) of det[v_r + x n_r, v_s + x n_s, v_t + x n_t], the constant first; x is the height by reach
    (a, b, c), (p, q, r) = v.transpose(1, 0, 2), (n * reach).transpose(1, 0, 2)
    pair, d = _roots(np.stack([det(a, b, c), det(p, b, c) + det(a, q, c) + det(a, b, r),
                               det(p, q, c) + det(p, b, r) + det(a, q, r), det(p, q, r)], axis=1))
    w = v[pair] + (reach * d)[:, None, None] * n[pair]
    N = np.cross(w[:, 1] - w[:, 0], w[:, 2] - w[:, 0])
    bary = np.stack([np.einsum("nd,nd->n", np.cross(w[:, i - 2], w[:, i - 1]), N) for i in range(3)], axis=1)
    bary /= np.maximum(bary.sum(axis=1), 1e-300)[:, None]
    upright = np.einsum("nd,nd->n", N, np.einsum("nc,ncd->nd", bary, n[pair])) > 0
    good = upright & (bary >= -1e-9).all(axis=1)    # a little below zero is still in the triangle
    bary = np.clip(bary[good], 0, None)
    return pair[good], reach * d[good], bary / bary.sum(axis=1, keepdims=True)


def _roots(c: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the real roots in [-1, 1] of cubics (k, 4), whose leading coefficient may vanish; also the cubic of each.

    Between its turning points a cubic has one root or none, which is found by bisection.
    """
    a, b, k = 3 * c[:, 3], c[:, 2], c[:, 1]                  # its derivative is a x² + 2 b x + k
    q = -(b + np.copysign(np.sqrt(np.maximum(b * b - a * k, 0)), b))
    with np.errstate(divide="ignore", invalid="ignore"):
        turns = np.sort(np.clip(np.nan_to_num(np.stack([q / a, k / q], axis=1), nan=1.0), -1, 1), axis=1)
    ends = np.column_stack([-np.ones(len(c)), turns, np.ones(len(c))])
    at = _value(c[:, None], ends)
    cubic, piece = np.nonzero((np.signbit(at[:, :-1]) != np.signbit(at[:, 1:])) & (ends[:, :-1] < ends[:, 1:]))
    low, high, c, rising = ends[cubic, piece], ends[cubic, piece + 1], c[cubic], at[cubic, piece] < 0
    for _ in range(54):                                      # to the last digit of a number near 1
        x = 0.5 * (low + high)
        above = (_value(c, x) > 0) == rising
        low, high = np.where(above, low, x), np.where(above, x, high)
    return cubic, 0.5 * (low + high)


def _value(c: np.ndarray, x: np.ndarray) -> np.ndarray:
    return c[..., 0] + x * (c[..., 1] + x * (c[..., 2] + x * c[..., 3]))


def _near(mesh: Mesh, points: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Find pairs (points, triangles) where a point may lie in a triangle's volume, and some more.

    The volume lies in the convex hull of the corners displaced up and down, so in its box and the ball around it.
    """
    shift = reach * mesh.vertex_normals[mesh.faces]
    hull = np.concatenate([mesh.corners + shift, mesh.corners - shift], axis=1)
    low, high, center = hull.min(axis=1) - 1e-9, hull.max(axis=1) + 1e-9, hull.mean(axis=1)
    radius = np.linalg.norm(hull - center[:, None], axis=2).max(axis=1) + 1e-9
    near = cKDTree(points).query_ball_point(center, radius)
    face = np.repeat(np.arange(len(near)), [len(found) for found in near])
    which = np.fromiter(chain.from_iterable(near), np.int64, len(face))
    inside = ((points[which] > low[face]) & (points[which] < high[face])).all(axis=1)
    return which[inside], face[inside]


@dataclass(frozen=True, eq=False)
class Crossings:
    """Crossings of normals with a surface, ordered by normal and height."""

    normal: np.ndarray   # (k,), which normal
    heights: np.ndarray  # (k,) metres
    cosines: np.ndarray  # (k,), between the normals of both; negative where the surface is met from inside

    def pick(self, keep: np.ndarray) -> Crossings:
        """Only some of them."""
        return Crossings(self.normal[keep], self.heights[keep], self.cosines[keep])


def outer_layers(found: Crossings) -> Crossings:
    """Select crossings that meet the scan from outside; overlapping views count once, at their mean height.

    Two layers of a fold have a crossing from inside between them; two views of one surface have not.
    """
    outside = found.cosines > 0
    layer = np.cumsum(~outside)[outside]
    front = found.pick(outside)
    begins = np.ones(len(front.normal), dtype=bool)
    begins[1:] = ((front.normal[1:] != front.normal[:-1]) | (layer[1:] != layer[:-1])
                  # metres: farther apart, two views have not met the same surface
                  | (front.heights[1:] - front.heights[:-1] > 0.01))
    group = np.cumsum(begins) - 1
    count = np.maximum(np.bincount(group), 1)
    return Crossings(front.normal[begins], np.bincount(group, front.heights) / count,
                     np.bincount(group, front.cosines) / count)


def find_crossings(scan: Mesh, rays: Rays, points: np.ndarray, normals: np.ndarray, reach: float) -> Crossings:
    """Find all crossings of normals (n, 3), of any length, at points (n, 3) with a scan, at most `reach` metres away.

    Embree finds the triangles in single precision; their planes give the heights in double precision.
    """
    length = np.maximum(np.linalg.norm(normals, axis=1), 1e-12)
    along = normals / length[:, None]
    active, at = np.arange(len(points)), np.full(len(points), -reach)
    none = np.zeros(0, dtype=int)
    found = [(none, none)]
    for _ in range(30):
        face, far = rays.cast(points[active] + at[active, None] * along[active], along[active], 2 * reach)
        met = face >= 0
        active, face, far = active[met], face[met], far[met]
        at[active] += far + 2e-5    # metres behind what was met
        inside = at[active] < reach
        active, face = active[inside], face[inside]
        if not len(active):
            break
        found.append((active, face))
    normal, face = map(np.concatenate, zip(*found, strict=True))
    N = scan.face_normals[face]
    cosine = np.einsum("nd,nd->n", N, along[normal])
    away = np.einsum("nd,nd->n", scan.corners[face, 0] - points[normal], N)
    steep = np.abs(cosine) < 1e-3                           # seen from the edge: where, is not to be said
    height = away / np.where(steep, 1, cosine)
    order = np.lexsort((height, normal))
    normal, height, cosine, steep = (v[order] for v in (normal, height, cosine, steep))
    again = np.zeros(len(normal), dtype=bool)
    # metres: met twice on a shared edge
    again[1:] = (normal[1:] == normal[:-1]) & (height[1:] - height[:-1] < 1e-6) & (cosine[1:] * cosine[:-1] > 0)
    keep = ~again & ~steep & (np.abs(height) <= reach)
    return Crossings(normal[keep], (height / length[normal])[keep], cosine[keep])


def limits(control: Mesh, points: np.ndarray, normals: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Compute the least and greatest distance (n,) along normals, metres, before another body part is met.

    That is three quarters of the way to the other side of a limb, or across a gap, and at least 3 mm.
    """
    along = normals / np.maximum(np.linalg.norm(normals, axis=1), 1e-12)[:, None]
    rays, most, ends = Rays(control), reach / 0.75, []
    for side in (-along, along):
        far = rays.cast(points + 1e-4 * side, side, most)[1]
        ends.append(np.maximum(0.75 * np.nan_to_num(far, nan=most), 0.003))
    return -ends[0], ends[1]


def not_inverted(control: Mesh, faces: np.ndarray, bary: np.ndarray, heights: np.ndarray) -> np.ndarray:
    """Find where displaced triangles are nowhere inverted up to these heights, (n,) bool.

    The area of the displaced triangle, as seen along the normal, is a quadratic in the height, and 1 at height 0.
    """
    corners, normals = control.corners[faces], control.vertex_normals[control.faces[faces]]
    _, n = interpolate(control, faces, bary)
    e, f = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p, q = normals[:, 1] - normals[:, 0], normals[:, 2] - normals[:, 0]

    def seen(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.einsum("nd,nd->n", np.cross(a, b), n)

    c0, c1, c2 = seen(e, f), seen(e, q) + seen(p, f), seen(p, q)
    good = c0 > 0
    for part in (0.25, 0.5, 0.75, 1.0):
        d = part * heights
        good &= c0 + d * (c1 + d * c2) > 0.05 * c0
    return good
