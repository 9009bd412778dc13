"""The fast path: a fixed body whose vertices are one matrix product away from its poses.

Every kind of model is, for a fixed body, linear in products of a feature δ and the rotation of a part:

    Y = Σ_m δ_m T_m R_mᵀ + joints[0] + trans

where `T_m` is made once, for SCAPE stitched from the edges that the product contributes.
"""
from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.tree import Skeleton

from .features import Terms


def check_pose(skeleton: Skeleton, pose: Any, trans: Any) -> tuple[np.ndarray, np.ndarray]:
    """Pose (..., J, 3) and trans (..., 3), finite and with the same leading shape."""
    pose = np.asarray(pose, dtype=np.float64)
    J = len(skeleton.parents)
    if pose.ndim not in (2, 3) or pose.shape[-2:] != (J, 3):
        raise ValueError(f"pose: expected shape ({J}, 3) or (B, {J}, 3), got {pose.shape}")
    trans = np.zeros(3) if trans is None else np.asarray(trans, dtype=np.float64)
    if trans.shape not in ((3,), (*pose.shape[:-2], 3)):
        raise ValueError(f"trans: expected shape (3,) or {(*pose.shape[:-2], 3)}, got {trans.shape}")
    if not (np.isfinite(pose).all() and np.isfinite(trans).all()):
        raise ValueError("pose and trans: expected finite numbers")
    return pose, np.broadcast_to(trans, (*pose.shape[:-2], 3))


def posed_product(terms: Terms, flat: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """(..., 3, L) of Σ δ T Rᵀ for `flat` (3M, L) and poses (..., J, 3): one matrix product."""
    W = np.moveaxis(terms.weights(pose), -3, -2)                              # (..., i, m, j)
    W = W.reshape(-1, flat.shape[0]).astype(flat.dtype, copy=False)
    return (W @ flat).reshape(*pose.shape[:-2], 3, flat.shape[1])


@dataclass(frozen=True, eq=False)
class PointOperator:
    """Some surface points of a fixed body, T (M, L, 3), metres, as a function of pose and place, with derivatives.

    Built by `Subject.points`; it never touches the mesh. The root part's centroid stands in `origin` when trans is
    zero.
    """

    terms: Terms
    basis: np.ndarray
    origin: np.ndarray

    @property
    def count(self) -> int:
        """L, the number of points."""
        return self.basis.shape[1]

    @cached_property
    def _flat(self) -> np.ndarray:
        return np.ascontiguousarray(self.basis.transpose(0, 2, 1)).reshape(-1, self.count)

    def evaluate(self, pose: np.ndarray, trans: np.ndarray | None = None) -> np.ndarray:
        """Positions (..., L, 3) of the points at poses (..., J, 3) and trans (..., 3)."""
        pose, trans = check_pose(self.terms.skeleton, pose, trans)
        y = posed_product(self.terms, self._flat, pose)
        y += (self.origin + trans)[..., None].astype(y.dtype)
        return np.swapaxes(y, -1, -2)

    def jacobian(self, pose: np.ndarray, trans: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Positions (..., L, 3) and their derivatives (..., L, 3, 3J) by the pose, metres per radian.

        A pose parameter rotates its part and all that hangs below it, and changes the features of its joint.
        The derivative with respect to trans is the identity.
        """
        pose, trans = check_pose(self.terms.skeleton, pose, trans)
        if pose.ndim == 2:
            y, columns = self.columns(pose, trans)
            return y, np.moveaxis(columns, 0, -1)
        B, J, L = len(pose), len(self.terms.skeleton.parents), self.count
        y, d_pose = np.empty((B, L, 3)), np.empty((B, L, 3, 3 * J))
        # numbers that a batch of derivatives holds at a time
        step = max(1, 2**24 // max(1, 3 * L * (self.terms.count + 4 * J)))
        for start in range(0, B, step):
            mine = slice(start, start + step)
            y[mine], columns = self.columns(pose[mine], trans[mine])
            d_pose[mine] = np.moveaxis(columns, 1, -1)
        return y, d_pose

    def columns(self, pose: np.ndarray, trans: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As `jacobian`, with the derivatives as (..., 3J, L, 3), contiguous for each parameter."""
        terms, skeleton = self.terms, self.terms.skeleton
        J, M, L, leading = len(skeleton.parents), terms.count, self.count, pose.shape[:-2]
        R = skeleton.part_rotations(pose)
        turned = self.basis @ np.swapaxes(R[..., terms.part, :, :], -1, -2)   # (..., M, L, 3)
        gather = np.zeros((*leading, J, M))                                   # C_p = Σ_m δ_m T_m R_pᵀ
        gather[..., terms.part, np.arange(M)] = terms.features.evaluate(pose)[..., terms.feature]
        below = skeleton.descends.T.astype(float) @ gather                    # all that hangs below each joint
        sway = np.moveaxis(terms.features.derivative(pose)[..., terms.feature, :, :], -3, -1)   # (..., J, 3, M)
        both = np.concatenate([below, sway.reshape(*leading, 3 * J, M)], axis=-2) @ turned.reshape(*leading, M, -1)
        carried = both[..., :J, :].reshape(*leading, J, L, 3)
        columns = both[..., J:, :].reshape(*leading, J, 3, L, 3)
        turn = R @ rotations.right_jacobian(pose)                             # world turn per parameter, in columns
        # ω × x = x @ hat(ω)ᵀ for every column ω of `turn`
        columns += carried[..., None, :, :] @ np.swapaxes(rotations.hat(np.swapaxes(turn, -1, -2)), -1, -2)
        y = carried[..., 0, :, :] + (self.origin + trans)[..., None, :]
        return y, columns.reshape(*leading, 3 * J, L, 3)


@dataclass(frozen=True, eq=False)
class Subject:
    """A body of fixed shape, ready to be posed fast.

    Parameters
    ----------
    template : Mesh
    skeleton : Skeleton
    betas : (K,) float or None
        The body's shape; None is the template's own body.
    terms : Terms
    basis : (M, N, 3) float64 or float32, metres
        Of this type are the vertices; float32 is twice as fast and agrees to a few micrometres.
    origin : (3,) float, metres
    pose_mean, pose_covariance : (J, 3) and (3J, 3J) float, optional
        The model's pose prior, which a body of known shape keeps.
    pose_examples : (M, J, 3) float, radians, optional
        The model's training poses.
    left_out_error : float, metres, optional
        How far off the model predicted poses that were left out of learning.
    """

    template: Mesh
    skeleton: Skeleton
    betas: np.ndarray | None
    terms: Terms
    basis: np.ndarray
    origin: np.ndarray
    pose_mean: np.ndarray | None = None
    pose_covariance: np.ndarray | None = None
    pose_examples: np.ndarray | None = None
    left_out_error: float | None = None

    @property
    def n_vertices(self) -> int:
        """N."""
        return self.basis.shape[1]

    @cached_property
    def _all(self) -> PointOperator:
        return PointOperator(self.terms, self.basis, self.origin)

    def vertices(self, poses: np.ndarray, trans: np.ndarray | None = None) -> np.ndarray:
        """Vertices for one pose or a batch.

        Parameters
        ----------
        poses : (J, 3) or (B, J, 3) float, radians
        trans : (3,) or (B, 3) float, metres

        Returns
        -------
        (N, 3) or (B, N, 3) float of the subject's dtype, metres
        """
        return self._all.evaluate(poses, trans)

    def points(self, vertex_ids: np.ndarray, weights: np.ndarray | None = None) -> PointOperator:
        """Some surface points of the body.

        Parameters
        ----------
        vertex_ids : (L,) or (L, k) int
            The vertices, or the k vertices that each point is a combination of.
        weights : (L, k) float, optional
            Each row sums to 1.

        Raises
        ------
        ValueError
            Indices out of range, shapes that do not agree, weights that do not sum to 1.
        """
        ids, weights = check_points(self.n_vertices, vertex_ids, weights)
        if weights is None:
            basis = self.basis[:, ids].astype(np.float64)
        else:
            basis = np.einsum("alkd,lk->ald", self.basis[:, ids].astype(np.float64), weights)
        return PointOperator(self.terms, basis, self.origin)


def check_points(n_vertices: int, vertex_ids: np.ndarray, weights: np.ndarray | None
                 ) -> tuple[np.ndarray, np.ndarray | None]:
    """Vertex indices and weights of surface points as arrays, or ValueError."""
    ids = np.asarray(vertex_ids, dtype=np.int64)
    if ids.ndim != (1 if weights is None else 2):
        raise ValueError(f"vertex_ids: expected shape (L,), or (L, k) with weights, got {ids.shape}")
    if ids.size and (ids.min() < 0 or ids.max() >= n_vertices):
        raise ValueError(f"vertex_ids: expected 0..{n_vertices - 1}, got {ids.min()}..{ids.max()}")
    if weights is None:
        return ids, None
    weights = np.asarray(weights, dtype=np.float64)
    if weights.shape != ids.shape or not np.allclose(weights.sum(axis=1), 1, atol=1e-6):
        raise ValueError(f"weights: expected shape {ids.shape} with rows that sum to 1, got {weights.shape}")
    return ids, weights
