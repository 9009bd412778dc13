"""Geodesic distances along a surface, by shortest paths."""
from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import dijkstra

from .farthest_points import farthest_points
from .mesh import Mesh


class SurfaceGraph:
    """Shortest paths along edges and across pairs of triangles, for any mesh, with holes or in pieces.

    A path runs along edges, and straight across two neighbouring triangles unfolded into a plane. It is never shorter
    than the geodesic, and on regular triangles at most 4 percent longer (15 percent along edges alone).
    """

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self._graph = _with_diagonals(mesh)

    def distances(self, sources: np.ndarray | int, limit: float = np.inf) -> np.ndarray:
        """Compute distances (S, N), metres, from each source, or (N,) from one; infinite beyond `limit` or any path."""
        return dijkstra(self._graph, directed=False, indices=_check(self.mesh, sources), limit=limit)

    def nearest(self, sources: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Find the nearest source of each vertex: distance (N,), metres, and index (N,) in `sources`; or infinite and
        -1.
        """
        sources = np.atleast_1d(_check(self.mesh, sources))
        distance, _, origin = dijkstra(self._graph, directed=False, indices=sources, min_only=True,
                                       return_predecessors=True)
        place = np.full(len(self.mesh.vertices), -1)
        place[sources] = np.arange(len(sources))
        reached = np.isfinite(distance)
        return distance, np.where(reached, place[np.where(reached, origin, 0)], -1)

    def farthest_points(self, count: int, first: int = 0) -> np.ndarray:
        """Choose `count` vertices by farthest point sampling; unreached pieces come first."""
        if not 1 <= count <= len(self.mesh.vertices):
            raise ValueError(f"count: expected 1..{len(self.mesh.vertices)}, got {count}")
        return farthest_points(self.mesh.vertices, count, int(_check(self.mesh, first)),
                               lambda i, limit: self.distances(i, limit=limit or np.inf), least=-0.5)


def _check(mesh: Mesh, sources: np.ndarray | int) -> np.ndarray:
    """Check vertex numbers; ValueError for others."""
    vertices = np.asarray(sources)
    whole = vertices.size and np.issubdtype(vertices.dtype, np.integer)
    if not whole or vertices.min() < 0 or vertices.max() >= len(mesh.vertices):
        raise ValueError(f"sources: expected vertices of 0..{len(mesh.vertices) - 1}, got {sources}")
    return vertices.astype(np.int64)


def _with_diagonals(mesh: Mesh) -> csr_array:
    """Build the graph of edges and of straight lines between the two corners opposite to an inner edge."""
    a, b = mesh.edges.T
    c, d, across = _diagonals(mesh)
    n = len(mesh.vertices)
    rows, columns = np.r_[a, c], np.r_[b, d]
    lengths = np.maximum(np.r_[mesh.edge_lengths, across], 1e-15)   # a stored zero would mean no edge
    keys = np.minimum(rows, columns) * n + np.maximum(rows, columns)
    order = np.lexsort((lengths, keys))                   # of two links between the same vertices the shorter
    first = order[np.diff(keys[order], prepend=-1) != 0]
    return csr_array(coo_array((lengths[first], (rows[first], columns[first])), shape=(n, n)))


def _diagonals(mesh: Mesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find corners (D,), (D,) opposite to the same inner edge, and their distance (D,) when unfolded.

    Only where the line between them crosses the edge, so that it runs inside the two triangles.
    """
    inner, sides = np.flatnonzero(mesh.edge_use == 2), mesh.side_pairs.T
    c, d = mesh.faces[sides // 3, (sides % 3 + 2) % 3]    # the corner that faces side 01, 12 or 20
    x = mesh.vertices
    a, b = mesh.edges[inner].T
    length = np.maximum(mesh.edge_lengths[inner], 1e-15)
    along = (x[b] - x[a]) / length[:, None]
    place, height = [], []                                # coordinates in the unfolded plane, the edge as axis
    for corner in (c, d):
        arm = x[corner] - x[a]
        place.append(np.einsum("nd,nd->n", arm, along))
        height.append(np.linalg.norm(arm - place[-1][:, None] * along, axis=1))
    total = np.maximum(height[0] + height[1], 1e-15)
    crossing = (place[0] * height[1] + place[1] * height[0]) / total
    good = (crossing > 0) & (crossing < length) & (c != d)
    return c[good], d[good], np.hypot(place[0] - place[1], total)[good]
