"""Points of a body drawn to places and to planes, and the normal equations of that: assembled when a step is wanted."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanprep.geometry.least_squares import Deferred, Dense

from ..bodies import NearPoints


@dataclass(frozen=True, eq=False)
class Pull:
    """`Σ a |y - t|² + b (n·(y - t))²` over some points y of a body, as one residual `A (y - t)` of three rows a point.

    With `A = √a I + (√(a + b) - √a) n nᵀ`, whose square is `a I + b n nᵀ`.

    Attributes
    ----------
    points : NearPoints
    targets, normals : (L, 3) float, metres, and unit
    to_point, to_plane : (L,) float
        The weights a and b.
    """

    points: NearPoints
    targets: np.ndarray
    normals: np.ndarray
    to_point: np.ndarray
    to_plane: np.ndarray

    def energies(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What each point (L,) costs for its distance to the place, and to the plane, at unknowns (P,)."""
        off = self.points.positions(x) - self.targets
        return self.to_point * (off**2).sum(axis=1), self.to_plane * np.einsum("ld,ld->l", self.normals, off)**2

    def equations(self, x: np.ndarray, known: Dense) -> Deferred:
        """At unknowns (1, P), with those of all else that is known of them."""
        residual = self._weighed(self.points.positions(x[0]) - self.targets).ravel()

        def assemble() -> Dense:
            columns = self._weighed(self.points.columns(x[0])[1]).reshape(x.shape[1], -1)
            return Dense(known.energy + residual @ residual, known.gradient + columns @ residual,
                         known.hessian + columns @ columns.T)

        return Deferred(known.energy + residual @ residual, assemble)

    def _weighed(self, off: np.ndarray) -> np.ndarray:
        """A times (..., L, 3)."""
        near = np.sqrt(self.to_point)
        along = (np.sqrt(self.to_point + self.to_plane) - near) * np.einsum("ld,...ld->...l", self.normals, off)
        return near[:, None] * off + along[..., None] * self.normals
