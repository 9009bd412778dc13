"""Edge collapses in rounds: all that do not touch each other at once, never one that changes the topology."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..ranges import Cosine, Settings, Share, SomeShare
from .quadrics import lowest, value

FREE, CURVE, FIXED = 0, 1, 2
PIECE = 20_000                       # edges priced at once: what stays in the processor's cache
STUCK = 1e-3, 5                      # where so many rounds take less of the triangles away, thin ones may be made


@dataclass(frozen=True)
class RoundsConfig(Settings):
    """Settings of `Rounds`.

    Attributes
    ----------
    share : float
        Cheapest part of the edges that may collapse in a round; small is slow and close to the exact order.
    min_cosine : float
        Triangles that would turn by more in one collapse forbid it.
    min_quality : float
        Triangles thinner than this may not be made of better ones (1: equilateral), until nothing else is left.
    hold : float
        Weight of the distance to vertices beside that to planes: keeps triangles of an even size where it is flat.
    wall : float
        Weight of the distance to borders beside that to planes.
    seam : float
        The same for curves inside the surface; large keeps every zigzag of theirs.
    onto_vertices : bool
        Collapse onto one of the two vertices instead of to the point of least error.
    """

    share: SomeShare = 0.3
    min_cosine: Cosine = 0.3
    min_quality: Share = 0.1
    hold: float = 3e-4
    wall: float = 30.0
    seam: float = 3.0
    onto_vertices: bool = False


class Rounds:
    """Triangles that get fewer by collapses.

    Parameters
    ----------
    points : (N, M, 3) float, metres
        Vertices of M bodies with the same triangles; costs are summed over them.
    faces : (F, 3) int
        Manifold.
    quadrics : (N, M, 10) float
    areas : (N, 3) float
        Area vectors around the vertices of the first body: what the surface of their neighbourhood faces.
    kinds : (N,) int
        FREE, on a CURVE that stays a curve, or FIXED where it is.
    curves : (E, 2) int
        Edges of curves and borders.
    config : RoundsConfig, optional

    Attributes
    ----------
    faces : (f, 3) int
        Of the remaining triangles, by original vertex numbers.
    face_rows : (f,) int
        Which original triangles they are.
    owner : (N,) int
        The vertex that each one collapsed into, itself where it is still there; see `numbered`.
    """

    def __init__(self, points: np.ndarray, faces: np.ndarray, quadrics: np.ndarray, areas: np.ndarray,
                 kinds: np.ndarray, curves: np.ndarray, config: RoundsConfig | None = None) -> None:
        self.config = config or RoundsConfig()
        self.thinnest = self.config.min_quality
        self.points, self.quadrics, self.areas, self.kinds = (np.array(x) for x in (points, quadrics, areas, kinds))
        self.faces, self.face_rows = np.array(faces), np.arange(len(faces))
        self.owner = np.arange(len(points))
        N = len(points)
        a, b = self.faces.ravel(), np.roll(self.faces, -1, axis=1).ravel()
        keys = np.sort(np.minimum(a, b) * N + np.maximum(a, b))
        keys = keys[np.r_[True, keys[1:] != keys[:-1]]]
        self.ends = np.stack(np.divmod(keys, N), axis=1)
        self.curve = np.zeros(len(keys), dtype=bool)
        self.curve[np.searchsorted(keys, curves.min(axis=1) * N + curves.max(axis=1))] = True
        self.refused = np.zeros(len(keys), dtype=bool)
        self.cost = np.empty(len(keys))
        self._price(np.arange(len(keys)))

    def run(self, count: int, progress: Callable[[int, int], None] | None = None) -> None:
        """Collapse until `count` triangles are left, or none can go."""
        total, idle = len(self.faces) - count, 0
        while len(self.faces) > count:
            before, chosen = len(self.faces), self._choose()
            if len(chosen):
                self._collapse(chosen, len(self.faces) - count)
            elif self.thinnest == 0:
                break
            idle = idle + 1 if before - len(self.faces) < STUCK[0] * before else 0
            if self.thinnest > 0 and (idle == STUCK[1] or not len(chosen)):
                self.thinnest = 0.0
                self.refused[:] = False
            if progress is not None:
                progress(min(total, total - (len(self.faces) - count)), total)

    def numbered(self) -> tuple[np.ndarray, np.ndarray]:
        """The remaining vertices (n,), and for every original one (N,) which of them it ended in."""
        owner = self.owner
        while True:
            further = owner[owner]
            if np.array_equal(further, owner):
                break
            owner = further
        kept = np.unique(owner)
        return kept, np.searchsorted(kept, owner)

    def _price(self, rows: np.ndarray) -> None:
        """Order the ends of edges (kept first), and set the cost of collapsing them."""
        for start in range(0, len(rows), PIECE):
            part = rows[start:start + PIECE]
            a, b = self.ends[part].T
            turn = self.kinds[b] > self.kinds[a]
            a, b = np.where(turn, b, a), np.where(turn, a, b)
            if self.config.onto_vertices:
                Q = self.quadrics[a] + self.quadrics[b]
                turn = self.kinds[a] == self.kinds[b]
                turn &= value(Q, self.points[b]).sum(axis=1) < value(Q, self.points[a]).sum(axis=1)
                a, b = np.where(turn, b, a), np.where(turn, a, b)
            cost = value(*self._goals(a, b)).sum(axis=1)
            cost[(self.kinds[b] == FIXED) | ((self.kinds[b] == CURVE) & ~self.curve[part])] = np.inf
            self.ends[part], self.cost[part] = np.stack([a, b], axis=1), cost

    def _goals(self, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Quadrics (n, M, 10) of vertices b collapsed into a, and where these then lie (n, M, 3)."""
        Q = self.quadrics[a] + self.quadrics[b]
        if self.config.onto_vertices:
            return Q, self.points[a]
        anchored = (self.kinds[a] != self.kinds[b]) | (self.kinds[a] == FIXED)
        goal = lowest(Q)
        goal[anchored] = self.points[a[anchored]]
        return Q, goal

    def _choose(self) -> np.ndarray:
        """Cheap edges no two of which have neighbouring ends, cheapest first."""
        cost = np.where(self.refused, np.inf, self.cost)
        open_edges = int(np.isfinite(cost).sum())
        if not open_edges:
            return np.zeros(0, dtype=np.int64)
        place = min(open_edges - 1, max(int(self.config.share * len(cost)), 50))
        limit = np.partition(cost, place)[place]
        rows = np.flatnonzero(cost <= limit)
        rows = rows[np.argsort(cost[rows])]
        best = np.full(len(self.points), len(rows))
        for side in (0, 1):
            first = np.full(len(self.points), len(rows))
            first[self.ends[rows[::-1], side]] = np.arange(len(rows))[::-1]     # the last one written stays
            best = np.minimum(best, first)
        number = np.arange(len(rows))
        least = (best[self.ends[rows, 0]] == number) & (best[self.ends[rows, 1]] == number)
        rows = rows[least]
        label = self._labels(rows)
        a, b = label[self.ends[:, 0]], label[self.ends[:, 1]]
        clash = (a >= 0) & (b >= 0) & (a != b)
        return rows[_first_of_each_clash(len(rows), a[clash], b[clash])]

    def _labels(self, rows: np.ndarray) -> np.ndarray:
        """(N,) the number in `rows` of the edge that a vertex is an end of, -1 for none."""
        label = np.full(len(self.points), -1)
        label[self.ends[rows].T] = np.arange(len(rows))
        return label

    def _collapse(self, rows: np.ndarray, surplus: int) -> None:
        """Collapse those edges that harm nothing, no more than take `surplus` triangles away."""
        label = self._labels(rows)
        first, second, third = (label[self.faces[:, corner]] for corner in range(3))
        of = np.maximum(np.maximum(first, second), third)
        star = np.flatnonzero(of >= 0)                       # at most two corners are ends, and of the same edge
        gone = (first[star] + second[star] + third[star]) == 2 * of[star] - 1
        of = of[star]
        removed = np.bincount(of[gone], minlength=len(rows))
        first, second = label[self.ends[:, 0]], label[self.ends[:, 1]]
        near = np.flatnonzero((first >= 0) != (second >= 0))
        first, second = first[near], second[near]
        of_near = np.maximum(first, second)
        outer = np.where(first >= 0, self.ends[near, 1], self.ends[near, 0])
        order = np.argsort(of_near * len(self.points) + outer)
        near, of_near, outer = near[order], of_near[order], outer[order]
        twin = np.flatnonzero((of_near[1:] == of_near[:-1]) & (outer[1:] == outer[:-1]))
        Q, goal = self._goals(*self.ends[rows].T)
        good = self._keeps_topology(len(rows), removed, near, of_near, outer, twin)
        good &= self._keeps_triangles(rows, goal[:, 0], star[~gone], of[~gone])
        self.refused[rows[~good]] = True
        good[good] = np.cumsum(removed[good]) - removed[good] < surplus
        self._apply(rows[good], Q[good], goal[good])
        self._rejoin(rows, good, star, gone, of, near, of_near, outer, twin)

    def _keeps_topology(self, count: int, removed: np.ndarray, near: np.ndarray, of_near: np.ndarray,
                        outer: np.ndarray, twin: np.ndarray) -> np.ndarray:
        """(count,) bool: the link condition, and curves that stay simple.

        The ends may have no common neighbours but the tips of the triangles between them, and a tip must keep
        at least three edges, or two at a border.
        """
        good = np.bincount(of_near[twin], minlength=count) == removed
        degree = np.bincount(self.ends.ravel(), minlength=len(self.points))
        least = 3 + (removed[of_near[twin]] == 2)
        good[of_near[twin][degree[outer[twin]] < least]] = False
        good[of_near[twin][self.curve[near[twin]] & self.curve[near[twin + 1]]]] = False
        valence = np.bincount(of_near, minlength=count) - removed
        good[valence < 3] = False
        return good

    def _keeps_triangles(self, rows: np.ndarray, goal: np.ndarray, star: np.ndarray, of: np.ndarray) -> np.ndarray:
        """(count,) bool: no triangle turns over, away from what its corners stood for, or into a sliver.

        Only on the first body: others may have folds of their own, which would forbid far too much.
        """
        faces = self.faces[star]
        moved = (faces == self.ends[rows[of], 0][:, None]) | (faces == self.ends[rows[of], 1][:, None])
        old = self.points[faces, 0]
        new = np.where(moved[:, :, None], goal[of][:, None], old)
        n_old, q_old = _normals_and_quality(old)
        n_new, q_new = _normals_and_quality(new)
        meant = self.areas[faces]
        meant = (meant / np.maximum(np.linalg.norm(meant, axis=-1, keepdims=True), 1e-300)).sum(axis=1)
        was, now = _dot(n_old, meant), _dot(n_new, meant)
        bad = _dot(n_old, n_new) < self.config.min_cosine
        bad |= (now < 0.3) & (now < was)
        bad |= (q_new < self.thinnest) & (q_new < q_old)
        good = np.ones(len(rows), dtype=bool)
        good[of[bad]] = False
        return good

    def _apply(self, rows: np.ndarray, quadrics: np.ndarray, goal: np.ndarray) -> None:
        """Merge the ends of edges."""
        keep, drop = self.ends[rows].T
        self.owner[drop] = keep
        self.points[keep], self.quadrics[keep] = goal, quadrics
        self.areas[keep] += self.areas[drop]

    def _rejoin(self, rows: np.ndarray, good: np.ndarray, star: np.ndarray, gone: np.ndarray, of: np.ndarray,
                near: np.ndarray, of_near: np.ndarray, outer: np.ndarray, twin: np.ndarray) -> None:
        """Triangles and edges without those that collapsed, the others with their new ends."""
        changed = star[good[of] & ~gone]
        self.faces[changed] = self.owner[self.faces[changed]]
        left = np.ones(len(self.faces), dtype=bool)
        left[star[good[of] & gone]] = False
        left = np.flatnonzero(left)
        self.faces, self.face_rows = self.faces[left], self.face_rows[left]
        twin = twin[good[of_near[twin]]]
        self.curve[near[twin]] |= self.curve[near[twin + 1]]
        left = np.ones(len(self.ends), dtype=bool)
        left[rows[good]] = left[near[twin + 1]] = False
        mine = good[of_near]
        self.ends[near[mine]] = self.owner[self.ends[near[mine]]]
        around = np.zeros(len(self.points), dtype=bool)
        around[outer[mine]] = True
        self.refused &= ~(around[self.ends[:, 0]] | around[self.ends[:, 1]])
        self._price(near[mine & left[near]])
        left = np.flatnonzero(left)
        self.ends, self.curve, self.refused = self.ends[left], self.curve[left], self.refused[left]
        self.cost = self.cost[left]


def _first_of_each_clash(count: int, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(count,) bool: of numbers that clash in pairs (a, b) the lower ones, as many as can be together."""
    taken, out = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
    low, high = np.minimum(a, b), np.maximum(a, b)
    while True:
        open_pairs = ~(taken[low] | out[low] | taken[high] | out[high])
        low, high = low[open_pairs], high[open_pairs]
        waits = np.zeros(count, dtype=bool)
        waits[high] = True
        fresh = ~(waits | taken | out)
        taken |= fresh
        if not len(low):
            return taken
        out[high[taken[low]]] = True


def _normals_and_quality(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit normals (n, 3) and 4√3 area over squared sides (n,) of triangles (n, 3, 3)."""
    u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    cross = np.stack([u[..., 1] * v[..., 2] - u[..., 2] * v[..., 1], u[..., 2] * v[..., 0] - u[..., 0] * v[..., 2],
                      u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]], axis=-1)
    twice = np.sqrt(_dot(cross, cross))
    sides = _dot(u, u) + _dot(v, v) + _dot(u - v, u - v)
    return cross / np.maximum(twice, 1e-300)[..., None], 2 * 3 ** 0.5 * twice / np.maximum(sides, 1e-300)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("...d,...d->...", a, b)
