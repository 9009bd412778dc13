"""Chosen surface points of a body whose shape coefficients (betas) are unknown."""
from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

import numpy as np
from scipy.sparse import sparray

from .linear import PointOperator, SurfaceCombination


class ShapedPoints(SurfaceCombination):
    """Surface points as a function of pose, betas and place, with derivatives; affine in betas.

    Made by `BodyModel.points`.
    """

    @property
    @abstractmethod
    def n_betas(self) -> int:
        """K, the number of betas."""

    @abstractmethod
    def operator(self, betas: np.ndarray | None = None) -> PointOperator:
        """Return the points of the body with betas (k,), k ≤ K; None is the template's own body."""

    @abstractmethod
    def shape_jacobian(self, pose: np.ndarray) -> np.ndarray:
        """Compute the derivative (..., L, 3, K) of the points by the betas at poses (..., J, 3), metres."""

    @abstractmethod
    def combine(self, weights: np.ndarray | sparray) -> ShapedPoints:
        """Form n linear combinations of the points, with weights (n, L) whose rows sum to 1."""

    @abstractmethod
    def concatenate(self, other: ShapedPoints) -> ShapedPoints:
        """Append other points of the same model to these."""

    @abstractmethod
    def along(self, directions: np.ndarray) -> ShapedPoints:
        """Replace the betas by other unknowns z (k,), where betas = z @ directions and directions is (k, K)."""

    @abstractmethod
    def first(self, n_betas: int) -> ShapedPoints:
        """Keep only the first betas."""

    def _check_betas(self, betas: np.ndarray) -> np.ndarray:
        betas = np.asarray(betas, dtype=np.float64)
        if betas.ndim != 1 or len(betas) > self.n_betas:
            raise ValueError(f"betas: expected at most {self.n_betas} numbers, got shape {betas.shape}")
        if not np.isfinite(betas).all():
            raise ValueError("betas: expected finite numbers")
        return betas


@dataclass(frozen=True, eq=False)
class PosedPoints:
    """Points as a function of unknowns x = (pose (3J), trans (3), betas (K)); no betas for a known shape."""

    source: PointOperator | ShapedPoints

    @property
    def n_angles(self) -> int:
        """Three times the number of parts."""
        return 3 * len(self.source.skeleton.parents)

    @property
    def n_unknowns(self) -> int:
        """P, the number of unknowns: 3J for the pose, 3 for the place, K for the betas."""
        return self.n_angles + 3 + (self.source.n_betas if isinstance(self.source, ShapedPoints) else 0)

    def positions(self, x: np.ndarray) -> np.ndarray:
        """Compute the positions (L, 3), metres, at unknowns x (P,)."""
        return self._operator(x).evaluate(x[:self.n_angles].reshape(-1, 3), x[self.n_angles:self.n_angles + 3])

    def columns(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute the positions (L, 3), metres, and their derivatives (P, 3, L) at unknowns x (P,)."""
        pose = x[:self.n_angles].reshape(-1, 3)
        y, by_pose = self._operator(x).columns(pose, x[self.n_angles:self.n_angles + 3])
        # derivatives by the pose, by the place (the identity), and by the betas where the shape is unknown
        blocks = [by_pose, np.broadcast_to(np.eye(3)[..., None], (3, 3, len(y)))]
        if isinstance(self.source, ShapedPoints):
            blocks.append(np.swapaxes(self.source.shape_jacobian(pose), 0, 2))
        return y, np.concatenate(blocks)

    def _operator(self, x: np.ndarray) -> PointOperator:
        return self.source if isinstance(self.source, PointOperator) else self.source.operator(x[self.n_angles + 3:])
