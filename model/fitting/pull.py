"""The data term of a fit: distances of body points to target points and planes, with normal equations on demand."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csr_array

from scanprep.geometry.least_squares import Deferred, Dense

from .bodies import NearPoints


@dataclass(frozen=True, eq=False)
class MatchTargets:
    """The energy `Σ a |y - t|² + b (n·(y - t))²` over L matches of body points y with targets t and normals n.

    Attributes
    ----------
    points : NearPoints
    at : (L,) int
        The point of each match; matches of the same point are summed first.
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
        """Compute the energies (L,) of the distances to target points, and to target planes, at unknowns (P,)."""
        off, along = self._off(self.points.positions(x))
        return self.to_point * (off**2).sum(axis=1), self.to_plane * along**2

    def equations(self, x: np.ndarray, known: Dense) -> Deferred:
        """Build the normal equations at unknowns (1, P), added to the `known` ones of priors.

        The energy is computed at once; gradient and matrix only if a step is taken.
        """
        places = self.points.positions(x[0])
        off, along = self._off(places)
        cost = known.energy + self.to_point @ (off**2).sum(axis=1) + self.to_plane @ along**2

        def assemble() -> Dense:
            columns, gather = self.points.columns(x[0])[1], self._gather(len(places))
            # gradient 2 Jᵀ f and Gauss-Newton matrix 2 Jᵀ K J, both halved, with force f and stiffness K a point
            force = gather @ (self.to_point[:, None] * off + (self.to_plane * along)[:, None] * self.normals)
            rows = columns.reshape(x.shape[1], -1)
            drawn = np.einsum("pjv,ijv->piv", columns, self._stiffness(gather)).reshape(rows.shape)
            return Dense(cost, known.gradient + rows @ force.T.ravel(), known.hessian + rows @ drawn.T)

        return Deferred(cost, assemble)

    def _off(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute the offsets (L, 3) of points (V, 3) from their targets, and their parts along the normals (L,)."""
        off = places[self.at] - self.targets
        return off, np.einsum("ld,ld->l", self.normals, off)

    def _gather(self, count: int) -> csr_array:
        """Build the matrix (V, L) that sums over the matches of each point."""
        each = np.arange(len(self.at))
        return csr_array(coo_array((np.ones(len(each)), (self.at, each)), shape=(count, len(each))))

    def _stiffness(self, gather: csr_array) -> np.ndarray:
        """Sum a I + b n nᵀ over the matches of each point: (3, 3, V)."""
        n = self.normals
        each = self.to_point[:, None, None] * np.eye(3) + self.to_plane[:, None, None] * n[:, :, None] * n[:, None, :]
        return np.ascontiguousarray((gather @ each.reshape(-1, 9)).T).reshape(3, 3, -1)
