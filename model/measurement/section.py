"""Plane sections of a surface, and the tape around them."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Carried:
    """A point carried by the body: a fixed combination of vertices (k,) with weights (k,)."""

    vertices: np.ndarray
    weights: np.ndarray

    def at(self, body: np.ndarray) -> np.ndarray:
        """Compute its position (3,), metres, on vertices (N, 3)."""
        return self.weights @ body[self.vertices]


def mean_of(*vertices: int) -> Carried:
    """Return the mean of some vertices as a carried point."""
    return Carried(np.array(vertices), np.full(len(vertices), 1 / len(vertices)))


def on_the_way(first: Carried, second: Carried, share: float) -> Carried:
    """Return the point at a share of the way between two carried points."""
    return Carried(np.r_[first.vertices, second.vertices], np.r_[(1 - share) * first.weights, share * second.weights])


def direction(axis: tuple[Carried, Carried], body: np.ndarray) -> np.ndarray:
    """Compute the unit vector (3,) from one carried point to another, on vertices (N, 3)."""
    way = axis[1].at(body) - axis[0].at(body)
    return way / np.linalg.norm(way)


@dataclass(frozen=True, eq=False)
class SectionCurve:
    """A curve of points on edges of a mesh: vertices `edges` (m, 2), and the `share` (m,) of the way between them."""

    edges: np.ndarray
    share: np.ndarray
    closed: bool

    def at(self, body: np.ndarray) -> np.ndarray:
        """Compute the points (m, 3), metres, on vertices (N, 3)."""
        first, second = body[self.edges[:, 0]], body[self.edges[:, 1]]
        return first + self.share[:, None] * (second - first)

    def centroid(self, body: np.ndarray) -> Carried:
        """Compute the centroid of a closed curve as a carried point, weighted by length on this body (N, 3)."""
        points = self.at(body)
        steps = np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1)
        weights = (steps + np.roll(steps, -1)) / (2 * steps.sum())
        return Carried(self.edges.T.ravel(), np.concatenate([weights * (1 - self.share), weights * self.share]))


def section(body: np.ndarray, faces: np.ndarray, origin: np.ndarray, normal: np.ndarray) -> list[SectionCurve]:
    """Find the curves in which a plane cuts triangles, longest first.

    Parameters
    ----------
    body : (N, 3) float, metres
        Vertices.
    faces : (F, 3) int
        Triangles.
    origin, normal : (3,) float
        A point of the plane, metres, and its unit normal.
    """
    height = (body - origin) @ normal
    height = np.where(height == 0, 1e-12, height)                     # no vertex lies in the plane
    above = (height > 0)[faces]
    a, b, c = above.T
    crossed = (a | b | c) & ~(a & b & c)
    cut, above = faces[crossed], above[crossed]
    if not len(cut):
        return []
    # a cut triangle has one corner on its own side: the plane cuts the two edges there, which link the curve
    odd = np.where(above.sum(axis=1) == 1, above.argmax(axis=1), (~above).argmax(axis=1))
    rows = np.arange(len(cut))
    lone, others = cut[rows, odd], [cut[rows, (odd + k) % 3] for k in (1, 2)]
    pairs = np.sort(np.stack([np.stack([lone, other], axis=1) for other in others], axis=1), axis=2)    # (c, 2, 2)
    keys, links = np.unique(pairs[..., 0] * len(body) + pairs[..., 1], return_inverse=True)      # one number an edge
    edges = np.stack(np.divmod(keys, len(body)), axis=1)
    first, second = height[edges].T
    share = first / (first - second)
    curves = [SectionCurve(edges[chain], share[chain], closed) for chain, closed in _chains(links.reshape(-1, 2))]
    return sorted(curves, key=lambda curve: -len(curve.share))


def _chains(links: np.ndarray) -> list[tuple[np.ndarray, bool]]:
    """Join nodes with links (c, 2) into chains, and find whether each is closed; a node has at most two links."""
    near: dict[int, list[int]] = {}
    for first, second in links.tolist():
        near.setdefault(first, []).append(second)
        near.setdefault(second, []).append(first)
    ends = [node for node, others in near.items() if len(others) == 1]
    left, chains = set(near), list[tuple[np.ndarray, bool]]()
    for start in (*ends, *near):
        if start not in left:
            continue
        chain, node = list[int](), start
        while node in left:
            left.discard(node)
            chain.append(node)
            node = next((other for other in near[node] if other in left), -1)
        chains.append((np.array(chain), len(chain) > 2 and start in near[chain[-1]]))
    return chains


def part_around(curves: Sequence[SectionCurve], body: np.ndarray, origin: np.ndarray, normal: np.ndarray
                ) -> SectionCurve | None:
    """Choose the curve that is the skin around a point (3,) of the plane, else the nearest; None of none.

    Of closed curves one inside the other the outermost is the skin: a body with a mouth has a throat.
    """
    if not curves:
        return None
    across = np.linalg.svd(np.atleast_2d(normal))[2][1:]
    points = [curve.at(body) for curve in curves]
    nearest = int(np.argmin([np.linalg.norm(each.mean(axis=0) - origin) for each in points]))
    # the skin goes around the point itself, or around the nearest curve
    for centre in (origin, points[nearest].mean(axis=0)):
        outer = [k for k, curve in enumerate(curves) if curve.closed and _winds((points[k] - centre) @ across.T)]
        if outer:
            return curves[max(outer, key=lambda k: float(np.ptp(points[k], axis=0).max()))]
    return curves[nearest]


def _winds(points: np.ndarray) -> bool:
    """Return whether a closed polygon (m, 2) goes around the origin."""
    x, y = points.T
    turns = np.arctan2(x * np.roll(y, -1) - y * np.roll(x, -1), x * np.roll(x, -1) + y * np.roll(y, -1))
    return abs(float(turns.sum())) > np.pi


def tape(points: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Find the points of a plane section (m, 3) that a tape touches, in order: the corners of its convex hull.

    A tape spans hollows, as in the standards.
    """
    from scipy.spatial import ConvexHull

    across = np.linalg.svd(np.atleast_2d(normal))[2][1:]
    return ConvexHull(points @ across.T).vertices


def tape_length(points: np.ndarray, near: np.ndarray | None = None) -> tuple[float, np.ndarray]:
    """Compute the length of a closed tape over points (m, 3), metres, and its gradient (m, 3) by them.

    Where `near` (m,) is True, the tape lies on the skin between a point and the one before, and bends like it.
    Elsewhere, and without `near`, the tape is straight.
    """
    steps = points - np.roll(points, 1, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    ways = steps / np.maximum(lengths, 1e-12)[:, None]
    turn = np.arccos(np.clip(np.einsum("md,md->m", ways, np.roll(ways, -1, axis=0)), -1, 1))
    # a larger bend than 0.5 rad is an edge and not a curve
    bend = np.minimum(0.5 * (turn + np.roll(turn, 1)), 0.5)
    arc = 1 + (0 if near is None else near) * bend**2 / 24                # of a circle over its chord
    pull = arc[:, None] * ways if near is not None else ways
    return float((arc * lengths).sum()), pull - np.roll(pull, -1, axis=0)


def chain_length(points: np.ndarray) -> tuple[float, np.ndarray]:
    """Compute the length of an open chain of points (m, 3), metres, and its gradient (m, 3) by them."""
    steps = np.diff(points, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    ways = np.pad(steps / np.maximum(lengths, 1e-12)[:, None], ((1, 1), (0, 0)))
    return float(lengths.sum()), ways[:-1] - ways[1:]


def bulge(body: np.ndarray, normals: np.ndarray, curve: SectionCurve) -> tuple[np.ndarray, np.ndarray]:
    """Compute the offset (m, 3), metres, of the smooth surface from a curve's points, as coarse triangles cut corners.

    Also its derivative (m, 3) by the share along the edge. Over an edge the smooth surface is the cubic whose ends are
    perpendicular to the vertex `normals` (N, 3).
    """
    a, b = curve.edges.T
    way, t = body[b] - body[a], curve.share
    first = np.einsum("md,md->m", way, normals[a])
    second = -np.einsum("md,md->m", way, normals[b])
    at_a, at_b, t = first[:, None] * normals[a], second[:, None] * normals[b], t[:, None]
    mixed = (1 - t) * at_a + t * at_b
    return -t * (1 - t) * mixed, (2 * t - 1) * mixed + t * (1 - t) * (at_a - at_b)
