"""A scan of one or many sheets as one surface: points, normals, and paths that cross sheets but no gaps."""
from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, dijkstra
from scipy.spatial import cKDTree

from ..geometry.farthest_points import farthest_points, thin
from ..geometry.sparse import spanning_tree
from ..geometry.target import Target


class Sheet:
    """Points of a scan, thinned to a spacing (metres), and the graph of short ways between them.

    Points of overlapping sheets are neighbours of each other; two points that face each other across a gap, or
    lie on the two sides of a thin part, are not. `piece` (n,) is the connected piece of each point; `surface` and
    `graph` (n, n) hold the lengths of the ways, metres, without and with the bridges that join the larger pieces.
    """

    REACH = 2.6          # radius of the neighbourhood, in spacings: about twenty neighbours
    TURN = 0.1           # least cosine between the normals of neighbours
    SLANT = 0.6          # most sine between an edge and the tangent plane of the middle
    CREASE = 0.35        # normals that lean towards each other by more than this face each other

    def __init__(self, target: Target, spacing: float) -> None:
        keep = thin(target.points, spacing)
        self.spacing = spacing
        # points and normals, each the mean over those close by that face the same way: less noise
        near_distance, near = cKDTree(target.points).query(target.points[keep], min(24, len(target.points)))
        cosine = np.einsum("nkd,nd->nk", target.normals[near], target.normals[keep])
        sign = np.where(cosine < 0, -1.0, 1.0) if not target.oriented else np.ones_like(cosine)
        w = (near_distance < spacing) * (np.abs(cosine) if not target.oriented else cosine > 0.3)
        w[:, 0] = 1.0
        points = np.einsum("nk,nkd->nd", w, target.points[near]) / w.sum(axis=1, keepdims=True)
        normals = np.einsum("nk,nkd->nd", w * sign, target.normals[near])
        self.points, self.normals = points, normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        if not target.oriented:
            self.normals = _orient(self.points, self.normals, self.REACH * spacing)
        self.surface = self._edges()
        _, self.piece = connected_components(self.surface, directed=False)
        self.graph = _join(self.points, self.surface, self.piece)
        self.tree = cKDTree(self.points)
        self._spread: dict[tuple[int, float], tuple[np.ndarray, np.ndarray]] = {}

    def _edges(self) -> csr_array:
        reach = self.REACH * self.spacing
        i, j = cKDTree(self.points).query_pairs(reach, output_type="ndarray").T
        along = self.points[j] - self.points[i]
        length = np.maximum(np.linalg.norm(along, axis=1), 1e-9)
        along /= length[:, None]
        a, b = self.normals[i], self.normals[j]
        lean_i, lean_j = np.einsum("nd,nd->n", a, along), -np.einsum("nd,nd->n", b, along)
        middle = a + b
        slant = np.einsum("nd,nd->n", middle, along) / np.maximum(np.linalg.norm(middle, axis=1), 1e-9)
        good = ((np.einsum("nd,nd->n", a, b) > self.TURN) & (np.abs(slant) < self.SLANT)
                & (np.minimum(lean_i, lean_j) < self.CREASE))
        return _symmetric(i[good], j[good], length[good], len(self.points))

    def distances(self, sources: np.ndarray, limit: float = np.inf) -> np.ndarray:
        """(S, n) metres from points of the sheet (S,) to all; infinite where no way leads."""
        return dijkstra(self.graph, directed=False, indices=sources, limit=limit)

    def spread(self, count: int, limit: float) -> tuple[np.ndarray, np.ndarray]:
        """So many points (count,) far from each other, and pairs (E, 2) of them.

        Each is in pairs with the six nearest to it along the surface, none farther than `limit` metres.
        """
        if (count, limit) not in self._spread:
            chosen = farthest_points(self.points, count)
            self._spread[count, limit] = chosen, _neighbours(self.distances(chosen, limit=limit)[:, chosen])
        return self._spread[count, limit]

    def at(self, points: np.ndarray) -> np.ndarray:
        """The point of the sheet nearest to each of `points` (m, 3)."""
        return self.tree.query(points)[1]


def _neighbours(between: np.ndarray) -> np.ndarray:
    """Pairs (E, 2) of points with distances (n, n) between them, each with the six nearest to it."""
    near = np.argsort(between, axis=1)[:, 1:7]
    i, j = np.repeat(np.arange(len(between)), near.shape[1]), near.ravel()
    linked = np.isfinite(between[i, j])
    return np.unique(np.sort(np.stack([i[linked], j[linked]], axis=1), axis=1), axis=0)


def _symmetric(i: np.ndarray, j: np.ndarray, length: np.ndarray, count: int) -> csr_array:
    rows, columns = np.r_[i, j], np.r_[j, i]
    return csr_array(coo_array((np.maximum(np.r_[length, length], 1e-9), (rows, columns)), shape=(count, count)))


def _join(points: np.ndarray, graph: csr_array, label: np.ndarray) -> csr_array:
    """The graph with its larger pieces linked by the shortest straight bridges, as holes may part a body."""
    size = np.bincount(label)
    large = np.flatnonzero(size >= max(20, 0.002 * len(points)))
    if len(large) < 2:
        return graph
    found = []
    for k, a in enumerate(large):
        mine = np.flatnonzero(label == a)
        tree = cKDTree(points[mine])
        for b in large[k + 1:]:
            other = np.flatnonzero(label == b)
            distance, near = tree.query(points[other])
            best = int(distance.argmin())
            found.append((k, int(np.flatnonzero(large == b)[0]), mine[near[best]], other[best], distance[best]))
    ka, kb, i, j, length = (np.array(column) for column in zip(*found, strict=True))
    chosen = spanning_tree(ka, kb, length + 1e-9, len(large)).tocoo()
    used = np.isin(ka * len(large) + kb, chosen.row * len(large) + chosen.col)
    return graph + _symmetric(i[used].astype(np.int64), j[used].astype(np.int64), length[used], len(points))


def _orient(points: np.ndarray, normals: np.ndarray, reach: float) -> np.ndarray:
    """Normals (n, 3) with signs that agree between neighbours and point outward on the whole."""
    i, j = cKDTree(points).query_pairs(reach, output_type="ndarray").T
    along = points[j] - points[i]
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    # Through a thin part normals agree up to sign too, but the way there runs along them.
    through = np.maximum(np.abs(np.einsum("nd,nd->n", normals[i], along)),
                         np.abs(np.einsum("nd,nd->n", normals[j], along)))
    cost = 1.001 - np.abs(np.einsum("nd,nd->n", normals[i], normals[j])) + 2 * through**2
    n = len(points)
    tree = spanning_tree(i, j, cost, n)
    tree = csr_array(tree + tree.T)
    normals, todo = normals.copy(), np.ones(n, dtype=bool)
    while todo.any():
        root = int(np.flatnonzero(todo)[points[todo, 2].argmax()])
        order, before = breadth_first_order(tree, root, directed=False)
        for v in order[1:]:
            if normals[v] @ normals[before[v]] < 0:
                normals[v] = -normals[v]
        if np.einsum("nd,nd->n", normals[order], points[order] - points[order].mean(axis=0)).sum() < 0:
            normals[order] = -normals[order]
        todo[order] = False
    return normals
