"""Some surface points of a body whose shape is free: bilinear in (1, β) and products of features and rotations."""
from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .features import Terms
from .linear import PointOperator, posed_product


@dataclass(frozen=True, eq=False)
class ShapedPoints:
    """Surface points as a function of pose, betas and place, with derivatives.

    T of every term (M, L, 3), metres, for the template's own body and the mean person, and its change (K, M, L, 3) for
    one standard deviation of each beta.
    """

    terms: Terms
    template_basis: np.ndarray
    mean_basis: np.ndarray
    shape_basis: np.ndarray
    origin: np.ndarray

    def operator(self, betas: np.ndarray | None = None) -> PointOperator:
        """The points of the body with betas (k,), k ≤ K; None is the template's own body."""
        if betas is None:
            return PointOperator(self.terms, self.template_basis, self.origin)
        betas = np.asarray(betas, dtype=np.float64)
        if betas.ndim != 1 or len(betas) > len(self.shape_basis):
            raise ValueError(f"betas: expected at most {len(self.shape_basis)} numbers, got shape {betas.shape}")
        change = np.tensordot(betas, self.shape_basis[:len(betas)], axes=1)
        return PointOperator(self.terms, self.mean_basis + change, self.origin)

    def shape_jacobian(self, pose: np.ndarray) -> np.ndarray:
        """Derivative (..., L, 3, K) of the points with respect to betas at poses (..., J, 3), metres."""
        K, _, L, _ = self.shape_basis.shape
        pose = np.asarray(pose, dtype=np.float64)
        by_beta = posed_product(self.terms, self._flat, pose).reshape(*pose.shape[:-2], 3, K, L)
        return np.moveaxis(by_beta, -1, -3)

    @cached_property
    def _flat(self) -> np.ndarray:
        K, M, L, _ = self.shape_basis.shape
        return np.ascontiguousarray(self.shape_basis.transpose(1, 3, 0, 2)).reshape(3 * M, K * L)
