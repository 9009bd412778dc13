"""A scan of one or many sheets as one surface: points, normals, and paths across overlapping sheets but not gaps."""
from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, dijkstra
from scipy.spatial import cKDTree

from ..geometry.farthest_points import farthest_points, thin
from ..geometry.sparse import spanning_tree
from ..geometry.target import Target


class Sheet:
    """Points of a scan, thinned to a spacing (metres), and the graph of neighbours.

    Points of overlapping sheets are neighbours. Points that face each other across a gap, or lie on the two sides of a
    thin part, are not. `piece` (n,) is the connected component of each point. `surface` and `graph` (n, n) hold edge
    lengths, metres, without and with bridges between the larger components.
    """

    REACH = 2.6          # radius of the neighbourhood, in spacings: about twenty neighbours
    TURN = 0.1           # least cosine between the normals of neighbours
    SLANT = 0.6          # largest sine between an edge and the mean tangent plane
    CREASE = 0.35        # normals that lean towards each other by more than this face each other

    def __init__(self, target: Target, spacing: float) -> None:
        keep = thin(target.points, spacing)
        self.spacing = spacing
        # average points and normals over close neighbours that face the same way: less noise
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
        """Link neighbours on one surface: alike normals, an edge along the surface, and not facing each other."""
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
        """Compute path lengths (S, n), metres, from points (S,) to all; infinite where unreachable."""
        return dijkstra(self.graph, directed=False, indices=sources, limit=limit)

    def spread(self, count: int, limit: float) -> tuple[np.ndarray, np.ndarray]:
        """Choose points (count,) far from each other, and neighbouring pairs (E, 2) of them.

        Each point pairs with its six nearest along the surface, none farther than `limit` metres.
        """
        if (count, limit) not in self._spread:
            chosen = farthest_points(self.points, count)
            self._spread[count, limit] = chosen, _neighbours(self.distances(chosen, limit=limit)[:, chosen])
        return self._spread[count, limit]

    def at(self, points: np.ndarray) -> np.ndarray:
        """Find the point of the sheet nearest to each of `points` (m, 3)."""
        return self.tree.query(points)[1]


def _neighbours(between: np.ndarray) -> np.ndarray:
    """Return pairs (E, 2): each point with its six nearest, from distances (n, n)."""
    near = np.argsort(between, axis=1)[:, 1:7]
    i, j = np.repeat(np.arange(len(between)), near.shape[1]), near.ravel()
    linked = np.isfinite(between[i, j])
    return np.unique(np.sort(np.stack([i[linked], j[linked]], axis=1), axis=1), axis=0)


def _symmetric(i: np.ndarray, j: np.ndarray, length: np.ndarray, count: int) -> csr_array:
    """Build a symmetric matrix of edge lengths."""
    rows, columns = np.r_[i, j], np.r_[j, i]
    return csr_array(coo_array((np.maximum(np.r_[length, length], 1e-9), (rows, columns)), shape=(count, count)))


def _join(points: np.ndarray, graph: csr_array, label: np.ndarray) -> csr_array:
    """Link the larger components of a graph by straight bridges, as holes may separate parts of a body."""
    # components of at least 20 points and 0.2% are worth a bridge; smaller ones are specks
    size = np.bincount(label)
    large = np.flatnonzero(size >= max(20, 0.002 * len(points)))
    if len(large) < 2:
        return graph
    # the shortest bridge between each pair; a minimum spanning tree chooses which to use
    bridges = []
    for k, a in enumerate(large):
        own = np.flatnonzero(label == a)
        tree = cKDTree(points[own])
        for b in large[k + 1:]:
            other = np.flatnonzero(label == b)
            distance, near = tree.query(points[other])
            best = int(distance.argmin())
            bridges.append((k, int(np.flatnonzero(large == b)[0]), own[near[best]], other[best], distance[best]))
    ka, kb, i, j, length = (np.array(column) for column in zip(*bridges, strict=True))
    chosen = spanning_tree(ka, kb, length + 1e-9, len(large)).tocoo()
    used = np.isin(ka * len(large) + kb, chosen.row * len(large) + chosen.col)
    return graph + _symmetric(i[used].astype(np.int64), j[used].astype(np.int64), length[used], len(points))


def _orient(points: np.ndarray, normals: np.ndarray, reach: float) -> np.ndarray:
    """Orient normals (n, 3) consistently between neighbours, and outward on the whole, over a minimum spanning tree."""
    i, j = cKDTree(points).query_pairs(reach, output_type="ndarray").T
    along = points[j] - points[i]
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    # through a thin part normals agree up to sign too, but the edge runs along them: that costs more
    through = np.maximum(np.abs(np.einsum("nd,nd->n", normals[i], along)),
                         np.abs(np.einsum("nd,nd->n", normals[j], along)))
    cost = 1.001 - np.abs(np.einsum("nd,nd->n", normals[i], normals[j])) + 2 * through**2
    n = len(points)
    tree = spanning_tree(i, j, cost, n)
    tree = csr_array(tree + tree.T)
    normals, todo = normals.copy(), np.ones(n, dtype=bool)
    # spread signs from the highest point of each component, then flip it if its normals point inward
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
