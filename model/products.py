"""Points of a SCAPE body: linear in products of a feature δ and a part's rotation, so a batch is one matrix product.

    Y = Σ_m δ_m T_m R_mᵀ + origin + trans

`T_m` is stitched once from the edges that product m contributes.
"""
from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import csr_array, sparray

from scanprep.geometry import rotations
from scanprep.skeleton.tree import Skeleton

from .bilinear import ShapedPoints
from .features import PoseFeatures
from .linear import PointOperator, find_single_rows


@dataclass(frozen=True, eq=False)
class Terms:
    """The products in which the vertices of a fixed body are linear: `feature` (M,) times the rotation of `part` (M,).
    """

    features: PoseFeatures
    part: np.ndarray
    feature: np.ndarray

    @property
    def skeleton(self) -> Skeleton:
        return self.features.skeleton

    @property
    def count(self) -> int:
        """M, the number of products."""
        return len(self.part)

    @cached_property
    def groups(self) -> list[tuple[slice, np.ndarray]]:
        """Runs of products with features of one part, and the joints that these features depend on."""
        ends = np.flatnonzero(np.diff(self.features.part[self.feature], append=-1)) + 1
        runs = [slice(start, end) for start, end in zip([0, *ends[:-1].tolist()], ends.tolist(), strict=True)]
        groups = [(run, np.flatnonzero(self.features.uses[self.feature[run]].any(axis=0))) for run in runs]
        return [(run, joints) for run, joints in groups if len(joints)]

    def weights(self, pose: np.ndarray) -> np.ndarray:
        """Compute the products δ R (..., M, 3, 3) at poses (..., J, 3), radians."""
        R = self.skeleton.part_rotations(pose)[..., self.part, :, :]
        return self.features.evaluate(pose)[..., self.feature, None, None] * R


@dataclass(frozen=True, eq=False)
class Products(PointOperator):
    """Points that are a sum of products with T, the `basis` (M, 3, L), metres; coordinates come before points."""

    terms: Terms
    basis: np.ndarray
    origin: np.ndarray

    @property
    def skeleton(self) -> Skeleton:
        return self.terms.skeleton

    @property
    def count(self) -> int:
        return self.basis.shape[2]

    @property
    def load(self) -> int:
        return self.terms.count + 4 * len(self.skeleton.parents)

    @cached_property
    def _flat(self) -> np.ndarray:
        return self.basis.reshape(3 * self.terms.count, self.count)

    def relative_positions(self, pose: np.ndarray) -> np.ndarray:
        W = np.moveaxis(self.terms.weights(pose), -3, -2)                     # (..., i, m, j)
        W = W.reshape(-1, self._flat.shape[0]).astype(self._flat.dtype, copy=False)
        return (W @ self._flat).reshape(*pose.shape[:-2], 3, self.count)

    def columns(self, pose: np.ndarray, trans: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        terms, skeleton = self.terms, self.skeleton
        J, M, L, leading = len(skeleton.parents), terms.count, self.count, pose.shape[:-2]
        # 1. a turn ω of a joint moves all that hangs below it by ω × C, with C_p = Σ_m δ_m T_m R_pᵀ
        R = skeleton.part_rotations(pose)
        turned = (R[..., terms.part, :, :] @ self.basis).reshape(*leading, M, 3 * L)
        gather = np.zeros((*leading, J, M))                                   # C_p = Σ_m δ_m T_m R_pᵀ
        gather[..., terms.part, np.arange(M)] = terms.features.evaluate(pose)[..., terms.feature]
        below = skeleton.descends.T.astype(float) @ gather                    # all that hangs below each joint
        carried = (below @ turned).reshape(*leading, J, 3, L)
        # 2. the features of a part change with the parameters of its own joints only
        slopes, columns = terms.features.derivative(pose), np.zeros((*leading, J, 3, 3 * L))
        for run, joints in terms.groups:
            slope = slopes[..., terms.feature[run][:, None], joints, :].reshape(*leading, -1, 3 * len(joints))
            change = np.swapaxes(slope, -1, -2) @ turned[..., run, :]
            for k, j in enumerate(joints):
                columns[..., j, :, :] += change[..., 3 * k:3 * k + 3, :]
        columns = columns.reshape(*leading, J, 9, L)
        turn = R @ rotations.right_jacobian(pose)                             # world turn per parameter, in columns
        # ω × x = hat(ω) @ x for every column ω of `turn`
        columns += rotations.hat(np.swapaxes(turn, -1, -2)).reshape(*leading, J, 9, 3) @ carried
        y = np.swapaxes(carried[..., 0, :, :], -1, -2) + (self.origin + trans)[..., None, :]
        return y, columns.reshape(*leading, 3 * J, 3, L)

    def combine(self, weights: np.ndarray | sparray) -> Products:
        return replace(self, basis=_combine(self.basis, weights))

    def plus(self, factor: float, other: PointOperator) -> Products:
        assert isinstance(other, Products), "of the same kind of model"
        return replace(self, basis=self.basis + self.basis.dtype.type(factor) * other.basis,
                       origin=self.origin + factor * other.origin)

    def scale_by(self, factor: float) -> Products:
        return replace(self, basis=(factor * self.basis).astype(self.basis.dtype))

    def astype(self, dtype: Any) -> Products:
        return replace(self, basis=self.basis.astype(dtype, copy=False))


def _combine(basis: np.ndarray, weights: np.ndarray | sparray) -> np.ndarray:
    """Combine the points of T (..., 3, L) with weights (K, L)."""
    rows = find_single_rows(weights)
    if rows is not None:
        return np.take(basis, rows, axis=-1)
    if isinstance(weights, np.ndarray):
        return basis @ weights.T.astype(basis.dtype)
    sparse = csr_array(weights)
    used, place = np.unique(sparse.indices, return_inverse=True)
    mixed = csr_array((sparse.data, place, sparse.indptr), shape=(sparse.shape[0], len(used)))
    used_points = np.take(basis, used, axis=-1).reshape(-1, len(used))
    return np.ascontiguousarray((mixed @ used_points.T).T).reshape(*basis.shape[:-1], len(mixed.indptr) - 1)


@dataclass(frozen=True, eq=False)
class ShapedProducts(ShapedPoints):
    """Points with unknown betas: bilinear in (1, β) and the products.

    `own` and `mean` are T (M, 3, L), metres, of the template's own body and the mean person. `change` (K, M, 3, L) is
    the change of T for one standard deviation of each beta.
    """

    terms: Terms
    own: np.ndarray
    mean: np.ndarray
    change: np.ndarray
    origin: np.ndarray

    @property
    def skeleton(self) -> Skeleton:
        return self.terms.skeleton

    @property
    def count(self) -> int:
        return self.own.shape[2]

    @property
    def n_betas(self) -> int:
        return len(self.change)

    @property
    def load(self) -> int:
        return self.terms.count

    def operator(self, betas: np.ndarray | None = None) -> Products:
        if betas is None:
            return Products(self.terms, self.own, self.origin)
        betas = self._check_betas(betas)
        return Products(self.terms, self.mean + np.tensordot(betas, self.change[:len(betas)], axes=1), self.origin)

    def shape_jacobian(self, pose: np.ndarray) -> np.ndarray:
        pose = np.asarray(pose, dtype=np.float64)
        by_beta = self._changes.relative_positions(pose).reshape(*pose.shape[:-2], 3, self.n_betas, self.count)
        return np.moveaxis(by_beta, -1, -3)

    @cached_property
    def _changes(self) -> Products:
        """The changes of all points by all betas, one after the other, in the place of points."""
        K, M, _, L = self.change.shape
        return Products(self.terms, np.moveaxis(self.change, 0, 2).reshape(M, 3, K * L), np.zeros(3))

    def combine(self, weights: np.ndarray | sparray) -> ShapedProducts:
        own, mean, change = (_combine(T, weights) for T in (self.own, self.mean, self.change))
        return replace(self, own=own, mean=mean, change=change)

    def concatenate(self, other: ShapedPoints) -> ShapedProducts:
        assert isinstance(other, ShapedProducts), "of the same model"
        own, mean, change = (np.concatenate([getattr(self, name), getattr(other, name)], axis=-1)
                             for name in ("own", "mean", "change"))
        return replace(self, own=own, mean=mean, change=change)

    def along(self, directions: np.ndarray) -> ShapedProducts:
        return replace(self, change=np.tensordot(directions, self.change, axes=1))

    def first(self, n_betas: int) -> ShapedProducts:
        return replace(self, change=self.change[:n_betas])
