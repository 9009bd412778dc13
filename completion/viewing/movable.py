"""A body whose shape and pose follow sliders: every move is a product of matrices.

Vertices are affine in betas, `Y = Y_0(pose) + Σ_k Δβ_k D_k(pose)`. `D_k` is the change of the body per standard
deviation of component k, computed when that slider is first moved. While the pose stays, `Y_0` and `D_k` are kept, and
a move of a shape slider is one multiplication.
"""
from __future__ import annotations

from collections import OrderedDict

import numpy as np

from model.body import BodyModel
from model.linear import PointOperator
from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.roles import in_words

FEW = 3                              # differences to add at a new pose: for more, a new operator is faster


class MovableBody:
    """A model with betas and pose.

    Parameters
    ----------
    model : BodyModel
        The model.
    """

    KEPT = 24                            # differences kept in memory, the most recently used

    def __init__(self, model: BodyModel) -> None:
        self.model, self.skeleton = model, model.skeleton
        self.parts = tuple(map(in_words, model.skeleton.names))
        self.regressor = model.joint_regressor
        self.betas: np.ndarray | None = np.zeros(model.n_betas) if model.n_betas else None
        self.operator = model.operator(self.betas).astype(np.float32)
        self._differences: OrderedDict[int, PointOperator] = OrderedDict()
        self._pose = np.zeros((0, 3))
        self._products: dict[int, np.ndarray] = {}                # results at `_pose` by difference; -1 is the body

    def vertices(self, betas: np.ndarray | None, pose: np.ndarray) -> np.ndarray:
        """Compute the vertices (N, 3) float32, metres, relative to the root's joint.

        Shape betas (K,) or None, and pose (J, 3) radians. Positions are relative to `origin`, so that single precision
        keeps a few micrometres wherever the body is.
        """
        moved = not np.array_equal(pose, self._pose)
        changed = self._find_changed(betas)
        if changed is None or len(changed) > (FEW if moved else self.KEPT):
            self._settle(betas)
            changed, moved = np.zeros(0, dtype=np.int64), True
        if moved:
            self._pose, self._products = np.array(pose), {}
        # the body, plus a difference for every changed beta
        y = self._product(-1).copy()
        for k in changed.tolist():
            assert betas is not None and self.betas is not None
            y += np.float32(betas[k] - self.betas[k]) * self._product(k)
        return y.T

    @property
    def origin(self) -> np.ndarray:
        """(3,) float, metres: where the root's joint is."""
        return self.skeleton.joints[0]

    @property
    def layers(self) -> tuple[MovableBody, ...]:
        """Return the bodies that move with the sliders: this one."""
        return (self,)

    def joint(self, part: str, y: np.ndarray) -> np.ndarray:
        """Compute the joint of a part, (1, 3), from the latest vertices `y`."""
        return np.asarray(self.regressor[[self.parts.index(part)]] @ y)

    def mesh(self, betas: np.ndarray | None, pose: np.ndarray) -> Mesh:
        """Compute the body with the exact model."""
        return self.model.template.with_vertices(self.model.vertices(pose, betas))

    def _find_changed(self, betas: np.ndarray | None) -> np.ndarray | None:
        """Return which betas differ from the operator's; None where it is faster to compute it again."""
        if betas is None or self.betas is None:
            return np.zeros(0, dtype=np.int64) if betas is None and self.betas is None else None
        changed = np.flatnonzero(betas != self.betas)
        missing = [k for k in changed.tolist() if k not in self._differences]
        return changed if len(missing) < 2 else None               # computing all at once is faster

    def _settle(self, betas: np.ndarray | None) -> None:
        """Give the operator new betas."""
        changed = self._find_changed(betas)
        if changed is None or any(k not in self._differences for k in changed.tolist()):
            self.operator = self.model.operator(betas).astype(np.float32)
        elif len(changed):
            assert betas is not None and self.betas is not None
            for k in changed.tolist():
                self.operator = self.operator.plus(betas[k] - self.betas[k], self._differences[k])
        self.betas = None if betas is None else np.array(betas)
        self._pose, self._products = np.zeros((0, 3)), {}

    def _product(self, k: int) -> np.ndarray:
        """Compute the body, or difference k, at the present pose, (3, N)."""
        if k not in self._products:
            one, shift = (self.operator, self.origin) if k < 0 else (self._difference(k), np.zeros(3))
            self._products[k] = one.relative_positions(self._pose) + (one.origin - shift).astype(np.float32)[:, None]
        return self._products[k]

    def _difference(self, k: int) -> PointOperator:
        """Compute the change of the body per standard deviation of component k."""
        if k not in self._differences:
            unit = np.zeros(self.model.n_betas)
            unit[k] = 1
            gained = self.model.operator(unit).plus(-1, self.model.operator(np.zeros_like(unit)))
            self._differences[k] = gained.astype(np.float32)
            while len(self._differences) > self.KEPT:
                self._differences.popitem(last=False)
        self._differences.move_to_end(k)
        return self._differences[k]
