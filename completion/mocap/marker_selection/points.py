"""Surface points of many bodies at once, every one of its own pose and shape."""
from __future__ import annotations

from dataclasses import replace

import numpy as np

from model.bilinear import ShapedPoints
from model.linear import PointOperator

from ...energy import MovingPoints, moving_points

AT_ONCE = 2**25                      # numbers of a batch of derivatives


class BodyPoints:
    """Surface points as a function of unknowns x = (pose (3J), trans (3), betas (K)) of a batch of bodies.

    Parameters
    ----------
    shaped : ShapedPoints
        Of a model, with as many betas as are wanted.
    """

    def __init__(self, shaped: ShapedPoints) -> None:
        self.shaped = shaped
        self.n_betas, _, self.count, _ = shaped.shape_basis.shape
        self.n_angles = 3 * len(shaped.terms.skeleton.parents)
        self.n_unknowns = self.n_angles + 3 + self.n_betas
        self._changes = shaped.shape_basis.reshape(self.n_betas, -1)

    def some(self, chosen: np.ndarray) -> BodyPoints:
        """Some of the points."""
        shaped = self.shaped
        return BodyPoints(replace(shaped, template_basis=shaped.template_basis[:, chosen],
                                  mean_basis=shaped.mean_basis[:, chosen],
                                  shape_basis=shaped.shape_basis[:, :, chosen]))

    @property
    def batch(self) -> int:
        """Bodies whose derivatives are held at once."""
        return max(1, AT_ONCE // max(1, 3 * self.count * (self.n_unknowns + self.shaped.terms.count)))

    def _operators(self, betas: np.ndarray) -> list[PointOperator]:
        change = (betas @ self._changes).reshape(len(betas), *self.shaped.mean_basis.shape)
        return [PointOperator(self.shaped.terms, self.shaped.mean_basis + own, self.shaped.origin) for own in change]

    def _split(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        n = self.n_angles
        return x[:, :n].reshape(len(x), -1, 3), x[:, n:n + 3], x[:, n + 3:]

    def positions(self, x: np.ndarray) -> np.ndarray:
        """(B, L, 3) metres, for unknowns (B, P)."""
        out = np.empty((len(x), self.count, 3))
        for start in range(0, len(x), self.batch):
            pose, trans, betas = self._split(x[start:start + self.batch])
            for i, operator in enumerate(self._operators(betas)):
                out[start + i] = operator.evaluate(pose[i], trans[i])
        return out

    def follow(self, x: np.ndarray) -> MovingPoints:
        """The points with their derivatives by the unknowns (B, P); keep B small."""
        pose, trans, betas = self._split(x)
        found = [operator.columns(p, t) for operator, p, t in zip(self._operators(betas), pose, trans, strict=True)]
        by_pose = np.moveaxis(np.stack([columns for _, columns in found]), 1, -1)
        return moving_points(np.stack([y for y, _ in found]), by_pose, self.shaped.shape_jacobian(pose))
