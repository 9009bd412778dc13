"""A body does not pass through itself."""
from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from scanprep.skeleton.tree import Skeleton

REACH = 0.12                         # metres: nothing on a body is further inside than half its thickness


class Contact:
    """Some vertices of a body, and which parts may not enter which.

    `part` (n,) int, part of each vertex; `tolerance`, metres, how deep skin may press into skin.
    """

    def __init__(self, skeleton: Skeleton, part: np.ndarray, tolerance: float = 0.015) -> None:
        J = len(skeleton.parents)
        near = np.eye(J, dtype=bool)
        child = np.arange(1, J)
        near[child, skeleton.parents[child]] = near[skeleton.parents[child], child] = True
        self.tolerance = tolerance
        self._mine = [np.flatnonzero(part == p) for p in range(J)]
        self._others = [np.flatnonzero(~near[p][part]) for p in range(J)]

    def intrusions(self, places: np.ndarray, normals: np.ndarray, parts: np.ndarray | None = None
                   ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """How deep vertices stand inside a part that is not next to theirs.

        `places, normals` (n, 3).
        Returns (n,), metres, depth beyond the tolerance; zero outside; (n, 3), normal of the plane to reach: the way
        out; (n, 3), metres, a point of that plane.
        """
        depth, way = np.zeros(len(places)), np.zeros_like(places)
        for p in range(len(self._mine)) if parts is None else parts:
            mine, others = self._mine[p], self._others[p]
            if not len(mine) or not len(others):
                continue
            far, hit = cKDTree(places[others]).query(places[mine], distance_upper_bound=REACH)
            found = np.isfinite(far)
            mine, hit = mine[found], others[hit[found]]
            inside = np.einsum("nd,nd->n", normals[hit], places[hit] - places[mine]) - self.tolerance
            depth[mine], way[mine] = np.maximum(inside, 0), normals[hit]
        return depth, way, places + depth[:, None] * way
