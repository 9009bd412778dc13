"""Plane sections of a surface, and the tape around them."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Carried:
    """A point that goes with the body: a fixed mean of vertices (k,) with weights (k,)."""

    vertices: np.ndarray
    weights: np.ndarray

    def at(self, body: np.ndarray) -> np.ndarray:
        """Its place (3,), metres, on vertices (N, 3)."""
        return self.weights @ body[self.vertices]


def mean_of(*vertices: int) -> Carried:
    """The mean of some vertices."""
    return Carried(np.array(vertices), np.full(len(vertices), 1 / len(vertices)))


def direction(axis: tuple[Carried, Carried], body: np.ndarray) -> np.ndarray:
    """The unit vector (3,) from one carried point to another, on vertices (N, 3)."""
    way = axis[1].at(body) - axis[0].at(body)
    return way / np.linalg.norm(way)


@dataclass(frozen=True, eq=False)
class SectionCurve:
    """Points on edges of a mesh, one after the other: `edges` (m, 2) vertices and the place `share` (m,) between them.

    `closed`: it ends where it begins.
    """

    edges: np.ndarray
    share: np.ndarray
    closed: bool

    def at(self, body: np.ndarray) -> np.ndarray:
        """The points (m, 3), metres, on vertices (N, 3)."""
        first, second = body[self.edges[:, 0]], body[self.edges[:, 1]]
        return first + self.share[:, None] * (second - first)

    def centroid(self, body: np.ndarray) -> Carried:
        """The centroid of a closed curve as a carried point, every stretch by its length on this body (N, 3)."""
        points = self.at(body)
        steps = np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1)
        weights = (steps + np.roll(steps, -1)) / (2 * steps.sum())
        return Carried(self.edges.T.ravel(), np.concatenate([weights * (1 - self.share), weights * self.share]))


def section(body: np.ndarray, faces: np.ndarray, origin: np.ndarray, normal: np.ndarray) -> list[SectionCurve]:
    """The curves in which a plane cuts triangles, longest first.

    Parameters
    ----------
    body : (N, 3) float, metres
    faces : (F, 3) int
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
    odd = np.where(above.sum(axis=1) == 1, above.argmax(axis=1), (~above).argmax(axis=1))    # the corner on its own
    rows = np.arange(len(cut))
    lone, others = cut[rows, odd], [cut[rows, (odd + k) % 3] for k in (1, 2)]
    pairs = np.sort(np.stack([np.stack([lone, other], axis=1) for other in others], axis=1), axis=2)    # (c, 2, 2)
    keys, links = np.unique(pairs[..., 0] * len(body) + pairs[..., 1], return_inverse=True)      # one number an edge
    edges = np.stack(np.divmod(keys, len(body)), axis=1)
    first, second = height[edges].T
    share = first / (first - second)
    found = [SectionCurve(edges[chain], share[chain], closed) for chain, closed in _chains(links.reshape(-1, 2))]
    return sorted(found, key=lambda curve: -len(curve.share))


def _chains(links: np.ndarray) -> list[tuple[np.ndarray, bool]]:
    """Chains of nodes joined by links (c, 2), and whether each is closed; every node has at most two links."""
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


def tape(points: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """The points of a plane section (m, 3) that a tape around it touches, in order: corners of its convex hull.

    A tape spans hollows, as that of the standards does.
    """
    from scipy.spatial import ConvexHull

    across = np.linalg.svd(np.atleast_2d(normal))[2][1:]
    return ConvexHull(points @ across.T).vertices


def tape_length(points: np.ndarray, near: np.ndarray | None = None) -> tuple[float, np.ndarray]:
    """Length of a closed tape over points (m, 3), metres, and its gradient (m, 3) by them.

    `near` (m,) bool: between a point and the one before the tape lies on the skin, which bends as the tape does at the
    two; elsewhere, and without it, the tape is straight.
    """
    steps = points - np.roll(points, 1, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    ways = steps / np.maximum(lengths, 1e-12)[:, None]
    turn = np.arccos(np.clip(np.einsum("md,md->m", ways, np.roll(ways, -1, axis=0)), -1, 1))
    # radians between two points of a tape: beyond, it lies on an edge
    bend = np.minimum(0.5 * (turn + np.roll(turn, 1)), 0.5)
    arc = 1 + (0 if near is None else near) * bend**2 / 24                # of a circle over its chord
    pull = arc[:, None] * ways if near is not None else ways
    return float((arc * lengths).sum()), pull - np.roll(pull, -1, axis=0)


def chain_length(points: np.ndarray) -> tuple[float, np.ndarray]:
    """Length of an open chain of points (m, 3), metres, and its gradient (m, 3) by them."""
    steps = np.diff(points, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    ways = np.pad(steps / np.maximum(lengths, 1e-12)[:, None], ((1, 1), (0, 0)))
    return float(lengths.sum()), ways[:-1] - ways[1:]


def bulge(body: np.ndarray, normals: np.ndarray, curve: SectionCurve) -> tuple[np.ndarray, np.ndarray]:
    """How far (m, 3), metres, the smooth surface lies from a curve's points on edges: coarse triangles cut corners.
    And how that changes (m, 3) along the edges, of which each is 1 long.

    On an edge it is the cubic whose ends are at right angles to the vertex `normals` (N, 3).
    """
    a, b = curve.edges.T
    way, t = body[b] - body[a], curve.share
    first = np.einsum("md,md->m", way, normals[a])
    second = -np.einsum("md,md->m", way, normals[b])
    at_a, at_b, t = first[:, None] * normals[a], second[:, None] * normals[b], t[:, None]
    mixed = (1 - t) * at_a + t * at_b
    return -t * (1 - t) * mixed, (2 * t - 1) * mixed + t * (1 - t) * (at_a - at_b)
