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


@dataclass(frozen=True, eq=False)
class PosedPoints:
    """Points as a function of unknowns x = (pose (3J), trans (3), betas (K)); no betas for a known shape."""

    source: PointOperator | ShapedPoints

    @property
    def J3(self) -> int:
        """Three times the number of parts."""
        return 3 * len(self.source.terms.skeleton.parents)

    @property
    def n_unknowns(self) -> int:
        """P."""
        return self.J3 + 3 + (len(self.source.shape_basis) if isinstance(self.source, ShapedPoints) else 0)

    def positions(self, x: np.ndarray) -> np.ndarray:
        """(L, 3) metres."""
        return self._operator(x).evaluate(x[:self.J3].reshape(-1, 3), x[self.J3:self.J3 + 3])

    def columns(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions (L, 3) and their derivatives (P, L, 3)."""
        pose = x[:self.J3].reshape(-1, 3)
        y, by_pose = self._operator(x).columns(pose, x[self.J3:self.J3 + 3])
        blocks = [by_pose, np.broadcast_to(np.eye(3)[:, None], (3, *y.shape))]
        if isinstance(self.source, ShapedPoints):
            blocks.append(np.moveaxis(self.source.shape_jacobian(pose), -1, 0))
        return y, np.concatenate(blocks)

    def _operator(self, x: np.ndarray) -> PointOperator:
        return self.source if isinstance(self.source, PointOperator) else self.source.operator(x[self.J3 + 3:])
