"""Annealed soft assignment of the vertices of a model to several points of a scan each, nearer ones with more weight.

The published slack of a point begins as its smallest match and is balanced. That removes distance from the assignment:
m_ij becomes proportional to exp((d_max² - d_ij²) / T). Else the slack is the remainder and costs nothing. Then m is the
minimum of Eq. 15 under Σ_i m_ij <= 1, and tends to the closest points as T goes to 0. Where vertices outnumber their
points, Eq. 14 has no solution. Rows are balanced last and sum to 1.

[Statues] Eq. 13-17
"""
from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from scanprep.threads import search_threads


class DirectedPoints:
    """Points of a scan with normals, searched for the nearest ones that face the same way."""

    def __init__(self, points: np.ndarray, normals: np.ndarray, border: np.ndarray) -> None:
        self.points, self.normals, self.border = points, normals, border
        self.tree = cKDTree(points)
        some = points[::-(-len(points) // 1000)]
        self.spacing = float(np.median(self.tree.query(some, min(5, len(points)))[0][:, -1]))

    def nearest(self, x: np.ndarray, normals: np.ndarray, neighbours: int) -> tuple[np.ndarray, np.ndarray]:
        """Find the nearest points (I, K) that face the same way as each vertex, nearest first, and squared distances.

        Where there are no more, the point is -1 and the distance infinite.
        """
        index, squared = self._facing(x, normals, 2 * neighbours)
        alone = np.flatnonzero(index[:, 0] < 0)          # deep inside a limb the other side may be nearer
        if len(alone):
            wide = self._facing(x[alone], normals[alone], 32 * neighbours)
            index[alone], squared[alone] = (a[:, :index.shape[1]] for a in wide)
        return index[:, :neighbours], squared[:, :neighbours]

    def beside(self, x: np.ndarray, nearest: np.ndarray) -> np.ndarray:
        """Find vertices (I, 3) that are not beyond the edge of a hole, by their nearest points (I,): (I,) bool."""
        beside = nearest >= 0
        for at in (nearest, self.tree.query(x)[1]):                  # of those that face the same way; of all
            offset = np.cross(self.normals[at], x - self.points[at])
            beside &= ~self.border[at] | (np.linalg.norm(offset, axis=1) <= self.spacing)
        return beside

    def _facing(self, x: np.ndarray, normals: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
        near = np.arange(1, min(count, len(self.points)) + 1)
        apart, index = self.tree.query(x, near, workers=search_threads(len(x)))
        facing = np.einsum("ikd,id->ik", self.normals[index], normals) > 0
        order = np.argsort(~facing, axis=1, kind="stable")
        facing = np.take_along_axis(facing, order, axis=1)
        return (np.where(facing, np.take_along_axis(index, order, axis=1), -1),
                np.where(facing, np.take_along_axis(apart, order, axis=1) ** 2, np.inf))


def assign_softly(near: np.ndarray, squared: np.ndarray, count: int, temperature: float, published: bool = False,
                  tolerance: float = 0.01, most: int = 5) -> csr_array:
    """Balance a soft assignment of vertices to their nearest points (I, K), -1 for none, at one temperature (m²).

    It ends when no share of a point changes by more than `tolerance` of itself, or after `most` rounds. Returns the
    matches (I, `count`), whose rows sum to 1; the row of a vertex that knows no point is empty. `published` takes the
    paper's slack.

    [Statues] Eq. 14, 17
    """
    known = near >= 0
    row, point = np.nonzero(known)[0], near[known]
    used, column = np.unique(point, return_inverse=True)
    log_k = -squared[known] / temperature                # Eq. 17
    log_s = np.zeros(len(used))
    np.minimum.at(log_s, column, log_k)                  # the smallest match of each point
    u, v = np.zeros(len(near)), np.zeros(len(used))
    for _ in range(most):
        # rows first, by logarithms; then plain factors, which are faster, until they become extreme
        top = np.full(len(near), -np.inf)
        np.maximum.at(top, row, log_k + v[column])
        u = -np.where(np.isfinite(top), top, 0.0)
        M = csr_array((np.exp(log_k + u[row] + v[column]), (row, column)), shape=(len(near), len(used)))
        a, b, changed = _balance(M, None if published else np.exp(np.minimum(-v, 50.0)), log_s + v, tolerance)
        u, v = u + np.log(a), v + np.log(b)
        if changed <= tolerance:
            break
    m = np.exp(log_k + u[row] + v[column])
    return csr_array((m, (row, point)), shape=(len(near), count))


def _balance(M: csr_array, most: np.ndarray | None, log_s: np.ndarray, tolerance: float
             ) -> tuple[np.ndarray, np.ndarray, float]:
    """Balance rows and columns: factors (I,) and (J,), rows last, and the largest relative change in the last round.

    Columns sum to 1 together with a slack of exp(log_s), or to at most 1 by factors of at most `most`.
    """
    T = csr_array(M.T)
    empty = np.diff(M.indptr) == 0
    b, changed = np.ones(M.shape[1]), np.inf
    a = 1 / np.where(empty, 1.0, M @ b)
    for _ in range(20):      # the caller goes on from there
        total, before = np.maximum(T @ a, 1e-250), b
        b = np.minimum(most, 1 / total) if most is not None else 1 / (np.exp(np.minimum(log_s, 300.0)) + total)
        a = 1 / np.where(empty, 1.0, M @ b)
        changed = float(np.max(np.abs(b / before - 1), initial=0.0))
        if changed <= tolerance or max(a.max(), 1 / b.min()) > 1e100:
            break
    return a, b, changed
