"""Edge collapses in rounds: independent edges collapse at once, and none may change the topology [QEM]."""
from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..geometry.mesh import Mesh
from .quadrics import curve_quadrics, minimise_quadrics, surface_quadrics, value

FREE, CURVE, FIXED = 0, 1, 2         # kinds of vertices
THINNEST = 0.1                       # least quality (1: equilateral) that collapses may make from better triangles
HOLD = 3e-4                          # weight of distances to vertices against planes: even triangles where flat


class Rounds:
    """Decimates M bodies (N, M, 3), metres, with shared triangles, near the origin.

    Borders, and edges between different `labels` (F,) of triangles, are preserved as curves. The vertices `keep` (n,)
    stay in place. Costs are summed over the bodies. Shape checks use the first body. `onto_vertices`
    collapses onto one of two vertices instead of the point of least error.

    The remaining `faces` (f, 3) use original vertex numbers; `face_rows` are their original rows. `owner` (N,) is the
    vertex that each one collapsed into, itself if it remains. `kinds` (N,) says whether a vertex is FREE, on a CURVE,
    or FIXED.
    """

    def __init__(self, mesh: Mesh, points: np.ndarray, keep: np.ndarray | None = None,
                 labels: np.ndarray | None = None, onto_vertices: bool = False) -> None:
        N = len(points)
        curves = curves_to_keep(mesh, labels)
        kinds = np.minimum(np.bincount(curves.ravel(), minlength=N), 3)
        self.kinds = np.array([FREE, FIXED, CURVE, FIXED])[kinds]    # ends and junctions of curves stay
        if keep is not None:
            self.kinds[check_vertices(mesh, keep)] = FIXED
        self.onto_vertices, self.thinnest = onto_vertices, THINNEST
        self.points, (self.quadrics, areas) = np.array(points), surface_quadrics(points, mesh.faces, HOLD)
        self.quadrics += wall_quadrics(mesh, points, areas, curves)
        self.areas = np.array(areas[:, 0])                           # area vectors of what each vertex stands for
        self.faces, self.face_rows = np.array(mesh.faces), np.arange(len(mesh.faces))
        self.owner = np.arange(N)
        keys = mesh.edges @ [N, 1]
        self.ends = np.array(mesh.edges)
        self.curve = np.isin(keys, curves @ [N, 1])
        self.refused = np.zeros(len(keys), dtype=bool)
        self.cost = np.empty(len(keys))
        self._price(np.arange(len(keys)))

    def run(self, count: int, progress: Callable[[int, int], None] | None = None) -> None:
        """Collapse until `count` triangles are left, or no edge can collapse."""
        total, idle = len(self.faces) - count, 0
        while len(self.faces) > count:
            before, chosen = len(self.faces), self._choose()
            if len(chosen):
                self._collapse(chosen, len(self.faces) - count)
            elif self.thinnest == 0:
                break
            # if rounds remove less than a thousandth five times, give up the limit on thin triangles
            idle = idle + 1 if before - len(self.faces) < 1e-3 * before else 0
            if self.thinnest > 0 and (idle == 5 or not len(chosen)):
                self.thinnest = 0.0
                self.refused[:] = False
            if progress is not None:
                progress(min(total, total - (len(self.faces) - count)), total)

    def renumber(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the remaining vertices (n,), and for every original one (N,) the index of its survivor."""
        return np.unique(final_owner(self.owner), return_inverse=True)

    def _price(self, rows: np.ndarray) -> None:
        """Order the ends of edges, the kept one first, and compute the cost of collapsing them."""
        piece = 20_000  # edges at a time, so that their data stay in the cache
        for start in range(0, len(rows), piece):
            part = rows[start:start + piece]
            a, b = self.ends[part].T
            # the end with more constraints is kept; with equal ones, the cheaper of the two
            swap = self.kinds[b] > self.kinds[a]
            a, b = np.where(swap, b, a), np.where(swap, a, b)
            if self.onto_vertices:
                Q = self.quadrics[a] + self.quadrics[b]
                swap = self.kinds[a] == self.kinds[b]
                swap &= value(Q, self.points[b]).sum(axis=1) < value(Q, self.points[a]).sum(axis=1)
                a, b = np.where(swap, b, a), np.where(swap, a, b)
            cost = value(*self._goals(a, b)).sum(axis=1)
            # a fixed vertex, or a curve vertex across the surface, cannot collapse
            cost[(self.kinds[b] == FIXED) | ((self.kinds[b] == CURVE) & ~self.curve[part])] = np.inf
            self.ends[part], self.cost[part] = np.stack([a, b], axis=1), cost

    def _goals(self, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return quadrics (n, M, 10) of vertices b collapsed into a, and the new positions (n, M, 3)."""
        Q = self.quadrics[a] + self.quadrics[b]
        if self.onto_vertices:
            return Q, self.points[a]
        anchored = (self.kinds[a] != self.kinds[b]) | (self.kinds[a] == FIXED)
        goal = minimise_quadrics(Q)
        goal[anchored] = self.points[a[anchored]]
        return Q, goal

    def _choose(self) -> np.ndarray:
        """Choose cheap edges of which no two have neighbouring ends, cheapest first."""
        cost = np.where(self.refused, np.inf, self.cost)
        open_edges = int(np.isfinite(cost).sum())
        if not open_edges:
            return np.zeros(0, dtype=np.int64)
        # the cheapest 30%: a smaller share is slower, but nearer to the exact order
        place = min(open_edges - 1, max(int(0.3 * len(cost)), 50))
        limit = np.partition(cost, place)[place]
        rows = np.flatnonzero(cost <= limit)
        rows = rows[np.argsort(cost[rows])]
        # an edge must be the cheapest at both of its ends; then drop the dearer of two edges joined by another edge
        best = np.full(len(self.points), len(rows))
        for side in (0, 1):
            first = np.full(len(self.points), len(rows))
            first[self.ends[rows[::-1], side]] = np.arange(len(rows))[::-1]     # the last write wins
            best = np.minimum(best, first)
        number = np.arange(len(rows))
        least = (best[self.ends[rows, 0]] == number) & (best[self.ends[rows, 1]] == number)
        rows = rows[least]
        label = self._labels(rows)
        a, b = label[self.ends[:, 0]], label[self.ends[:, 1]]
        clash = (a >= 0) & (b >= 0) & (a != b)
        return rows[_first_of_each_clash(len(rows), a[clash], b[clash])]

    def _labels(self, rows: np.ndarray) -> np.ndarray:
        """Return the index (N,) in `rows` of the edge that ends at each vertex, -1 for none."""
        label = np.full(len(self.points), -1)
        label[self.ends[rows].T] = np.arange(len(rows))
        return label

    def _collapse(self, rows: np.ndarray, surplus: int) -> None:
        """Collapse the edges that pass all checks, removing about `surplus` triangles at most."""
        label = self._labels(rows)
        first, second, third = (label[self.faces[:, corner]] for corner in range(3))
        of = np.maximum(np.maximum(first, second), third)
        star = np.flatnonzero(of >= 0)                       # at most two corners are ends, of the same edge
        gone = (first[star] + second[star] + third[star]) == 2 * of[star] - 1
        of = of[star]
        removed = np.bincount(of[gone], minlength=len(rows))
        # edges at one end of a collapsing edge; two with the same outer vertex become one
        first, second = label[self.ends[:, 0]], label[self.ends[:, 1]]
        near = np.flatnonzero((first >= 0) != (second >= 0))
        first, second = first[near], second[near]
        of_near = np.maximum(first, second)
        outer = np.where(first >= 0, self.ends[near, 1], self.ends[near, 0])
        order = np.argsort(of_near * len(self.points) + outer)
        near, of_near, outer = near[order], of_near[order], outer[order]
        twin = np.flatnonzero((of_near[1:] == of_near[:-1]) & (outer[1:] == outer[:-1]))
        # checks: link condition, then shape; refused edges wait until their surroundings change
        Q, goal = self._goals(*self.ends[rows].T)
        good = self._keeps_topology(len(rows), removed, near, of_near, outer, twin)
        good &= self._keeps_triangles(rows, goal[:, 0], star[~gone], of[~gone])
        self.refused[rows[~good]] = True
        good[good] = np.cumsum(removed[good]) - removed[good] < surplus
        # merge the ends of edges
        keep, drop = self.ends[rows[good]].T
        self.owner[drop] = keep
        self.points[keep], self.quadrics[keep] = goal[good], Q[good]
        self.areas[keep] += self.areas[drop]
        self._rejoin(rows, good, star, gone, of, near, of_near, outer, twin)

    def _keeps_topology(self, count: int, removed: np.ndarray, near: np.ndarray, of_near: np.ndarray,
                        outer: np.ndarray, twin: np.ndarray) -> np.ndarray:
        """Test the link condition (count,), and that curves stay simple.

        The ends may have no common neighbours except the tips of the triangles between them. A tip must keep at least
        three edges, or two at a border.
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
        """Test that no triangle (count,) inverts, turns away from what its corners stand for, or becomes a sliver.

        Only on the first body: others may have folds of their own, which would forbid too many collapses.
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
        # 0.3: a normal may turn by up to 73 degrees, from before and from the area vectors of its corners
        bad = _dot(n_old, n_new) < 0.3
        bad |= (now < 0.3) & (now < was)
        bad |= (q_new < self.thinnest) & (q_new < q_old)
        good = np.ones(len(rows), dtype=bool)
        good[of[bad]] = False
        return good

    def _rejoin(self, rows: np.ndarray, good: np.ndarray, star: np.ndarray, gone: np.ndarray, of: np.ndarray,
                near: np.ndarray, of_near: np.ndarray, outer: np.ndarray, twin: np.ndarray) -> None:
        """Remove collapsed triangles and edges, and give the others their new ends and costs."""
        changed = star[good[of] & ~gone]
        self.faces[changed] = self.owner[self.faces[changed]]
        remaining = np.ones(len(self.faces), dtype=bool)
        remaining[star[good[of] & gone]] = False
        remaining = np.flatnonzero(remaining)
        self.faces, self.face_rows = self.faces[remaining], self.face_rows[remaining]
        # of two edges that became one the first stays; it is a curve if either was
        twin = twin[good[of_near[twin]]]
        self.curve[near[twin]] |= self.curve[near[twin + 1]]
        remaining = np.ones(len(self.ends), dtype=bool)
        remaining[rows[good]] = remaining[near[twin + 1]] = False
        changed_edges = good[of_near]
        self.ends[near[changed_edges]] = self.owner[self.ends[near[changed_edges]]]
        # edges around a collapse may be tried again
        around = np.zeros(len(self.points), dtype=bool)
        around[outer[changed_edges]] = True
        self.refused &= ~(around[self.ends[:, 0]] | around[self.ends[:, 1]])
        self._price(near[changed_edges & remaining[near]])
        remaining = np.flatnonzero(remaining)
        self.ends, self.curve, self.refused = self.ends[remaining], self.curve[remaining], self.refused[remaining]
        self.cost = self.cost[remaining]


def _first_of_each_clash(count: int, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Choose from numbers that clash in pairs (a, b), lower ones first, as many as can be together: (count,) bool."""
    taken, out = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
    low, high = np.minimum(a, b), np.maximum(a, b)
    while True:
        open_pairs = ~(taken[low] | out[low] | taken[high] | out[high])
        low, high = low[open_pairs], high[open_pairs]
        # take all that wait for no lower number; drop what clashes with them; repeat
        waits = np.zeros(count, dtype=bool)
        waits[high] = True
        fresh = ~(waits | taken | out)
        taken |= fresh
        if not len(low):
            return taken
        out[high[taken[low]]] = True


def _normals_and_quality(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute unit normals (n, 3) and the quality 4√3 area / Σ side² (n,) of triangles (n, 3, 3)."""
    u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    cross = np.stack([u[..., 1] * v[..., 2] - u[..., 2] * v[..., 1], u[..., 2] * v[..., 0] - u[..., 0] * v[..., 2],
                      u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]], axis=-1)
    twice = np.sqrt(_dot(cross, cross))
    sides = _dot(u, u) + _dot(v, v) + _dot(u - v, u - v)
    return cross / np.maximum(twice, 1e-300)[..., None], 2 * 3 ** 0.5 * twice / np.maximum(sides, 1e-300)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return dot products along the last axis."""
    return np.einsum("...d,...d->...", a, b)


def final_owner(owner: np.ndarray) -> np.ndarray:
    """Follow owners (N,) to the end: the vertex that each one finally collapsed into."""
    while not np.array_equal(further := owner[owner], owner):
        owner = further
    return owner


def wall_quadrics(mesh: Mesh, points: np.ndarray, areas: np.ndarray, curves: np.ndarray) -> np.ndarray | float:
    """Compute quadrics (N, M, 10) of walls along curves (E, 2), or 0 without curves."""
    if not len(curves):
        return 0.0
    border = mesh.edges[mesh.edge_use == 1] @ [len(mesh.vertices), 1]
    # weights of walls against planes: borders stay exact, curves inside may lose zigzags
    weight = np.where(np.isin(curves @ [len(mesh.vertices), 1], border), 30.0, 3.0)
    return curve_quadrics(points, curves, areas[curves].sum(axis=1), weight)


def curves_to_keep(mesh: Mesh, labels: np.ndarray | None = None) -> np.ndarray:
    """Find edges (E, 2) to keep: borders, and edges between labels."""
    stays = mesh.edge_use == 1
    inner, (left, right) = np.flatnonzero(mesh.edge_use == 2), mesh.face_pairs.T
    if labels is not None:
        if np.shape(labels) != (len(mesh.faces),):
            raise ValueError(f"labels: expected one for each of {len(mesh.faces)} triangles, got "
                             f"shape {np.shape(labels)}")
        stays[inner[np.asarray(labels)[left] != np.asarray(labels)[right]]] = True
    return mesh.edges[stays]


def check_vertices(mesh: Mesh, keep: np.ndarray) -> np.ndarray:
    """Check vertex numbers (n,), and return them as integers; ValueError for vertices that do not exist."""
    keep = np.asarray(keep, dtype=np.int64).reshape(-1)
    wrong = keep[(keep < 0) | (keep >= len(mesh.vertices))]
    if len(wrong):
        raise ValueError(f"keep: expected vertices 0..{len(mesh.vertices) - 1}, got {wrong[0]}")
    return keep
