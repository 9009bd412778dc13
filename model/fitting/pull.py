"""Points of a body drawn to places and to planes, and the normal equations of that: assembled when a step is wanted."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csr_array

from scanprep.geometry.least_squares import Deferred, Dense

from .bodies import NearPoints


@dataclass(frozen=True, eq=False)
class MatchTargets:
    """`Σ a |y - t|² + b (n·(y - t))²` over matches, each of one of some points y of a body.

    Attributes
    ----------
    points : NearPoints
    at : (L,) int
        Which of the points each match is of; the matrix is summed over matches of the same one first.
    targets, normals : (L, 3) float, metres, and unit
    to_point, to_plane : (L,) float
        The weights a and b.
    """

    points: NearPoints
    at: np.ndarray
    targets: np.ndarray
    normals: np.ndarray
    to_point: np.ndarray
    to_plane: np.ndarray

    def energies(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What each match (L,) costs for its distance to the place, and to the plane, at unknowns (P,)."""
        off, along = self._off(self.points.positions(x))
        return self.to_point * (off**2).sum(axis=1), self.to_plane * along**2

    def equations(self, x: np.ndarray, known: Dense) -> Deferred:
        """At unknowns (1, P), with those of all else that is known of them."""
        places = self.points.positions(x[0])
        off, along = self._off(places)
        cost = known.energy + self.to_point @ (off**2).sum(axis=1) + self.to_plane @ along**2

        def assemble() -> Dense:
            columns, gather = self.points.columns(x[0])[1], self._gather(len(places))
            force = gather @ (self.to_point[:, None] * off + (self.to_plane * along)[:, None] * self.normals)
            rows = columns.reshape(x.shape[1], -1)
            drawn = np.einsum("pjv,ijv->piv", columns, self._stiffness(gather)).reshape(rows.shape)
            return Dense(cost, known.gradient + rows @ force.T.ravel(), known.hessian + rows @ drawn.T)

        return Deferred(cost, assemble)

    def _off(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How far (L, 3) points at places (V, 3) are from their targets, and from the planes (L,), metres."""
        off = places[self.at] - self.targets
        return off, np.einsum("ld,ld->l", self.normals, off)

    def _gather(self, count: int) -> csr_array:
        """(V, L) sums over the matches of each point."""
        each = np.arange(len(self.at))
        return csr_array(coo_array((np.ones(len(each)), (self.at, each)), shape=(count, len(each))))

    def _stiffness(self, gather: csr_array) -> np.ndarray:
        """(3, 3, V) the sum of a I + b n nᵀ over the matches of each point."""
        n = self.normals
        each = self.to_point[:, None, None] * np.eye(3) + self.to_plane[:, None, None] * n[:, :, None] * n[:, None, :]
        return np.ascontiguousarray((gather @ each.reshape(-1, 9)).T).reshape(3, 3, -1)
