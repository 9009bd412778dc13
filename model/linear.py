"""The fast path: points of a fixed body as a function of its pose and place, with derivatives.

Each kind of model has its own `PointOperator`. SCAPE adds up products of features and rotations (`model.products`);
skinning blends rotations at every vertex (`model.blended`).
"""
from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import csr_array, sparray

from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.tree import Skeleton
from scanprep.words import describe_result


def check_pose(skeleton: Skeleton, pose: Any, trans: Any) -> tuple[np.ndarray, np.ndarray]:
    """Check pose (..., J, 3) and trans (..., 3): finite, with the same leading shape; else ValueError."""
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


class SurfaceCombination(ABC):
    """Some surface points of a body that a pose moves."""

    @property
    @abstractmethod
    def skeleton(self) -> Skeleton:
        """The skeleton that the pose turns."""

    @property
    @abstractmethod
    def count(self) -> int:
        """L, the number of points."""

    @property
    @abstractmethod
    def load(self) -> int:
        """Memory estimate: numbers held while one coordinate of a point is differentiated at one pose."""


class PointOperator(SurfaceCombination):
    """Some surface points of a fixed body as a function of pose and place, with derivatives.

    Built by `Subject.points`; it never touches the mesh. The root's joint is at `origin` (3,) when trans is zero.
    """

    origin: np.ndarray

    @abstractmethod
    def relative_positions(self, pose: np.ndarray) -> np.ndarray:
        """Compute positions (..., 3, L) relative to `origin` at checked poses (..., J, 3)."""

    @abstractmethod
    def columns(self, pose: np.ndarray, trans: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute what `jacobian` does, with derivatives (..., 3J, 3, L) that are contiguous for each parameter."""

    @abstractmethod
    def combine(self, weights: np.ndarray | sparray) -> PointOperator:
        """Form combinations of the points with weights (K, L); `origin` counts once, whatever the rows sum to."""

    @abstractmethod
    def plus(self, factor: float, other: PointOperator) -> PointOperator:
        """Add a multiple of another operator of the same model and points, origins included."""

    @abstractmethod
    def scale_by(self, factor: float) -> PointOperator:
        """Scale the body about the root's joint."""

    @abstractmethod
    def astype(self, dtype: Any) -> PointOperator:
        """Convert to float64, or to float32, which is twice as fast and agrees to a few micrometres."""

    def joints(self, regressor: sparray) -> PointOperator:
        """Build the fast path of the joints, as combinations (J, L) of the surface around them.

        Models with joints of their own override this.
        """
        return self.combine(regressor)

    def evaluate(self, pose: np.ndarray, trans: np.ndarray | None = None) -> np.ndarray:
        """Compute the positions (..., L, 3), metres, at poses (..., J, 3) and trans (..., 3)."""
        pose, trans = check_pose(self.skeleton, pose, trans)
        # large batches go in pieces that fit into memory
        step = self._at_once(12)
        if pose.ndim == 2 or len(pose) <= step:
            y = self.relative_positions(pose)
        else:
            y = np.concatenate([self.relative_positions(pose[i:i + step]) for i in range(0, len(pose), step)])
        y += (self.origin + trans)[..., None].astype(y.dtype)
        return np.swapaxes(y, -1, -2)

    def _at_once(self, numbers: int) -> int:
        """Return how many poses to work on together, if each takes `numbers` times `load` numbers."""
        # 2**24 numbers are 128 MB in float64
        return max(1, 2**24 // max(1, numbers * self.load))

    def jacobian(self, pose: np.ndarray, trans: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Compute the positions (..., L, 3) and their derivatives (..., L, 3, 3J) by the pose, metres per radian.

        A pose parameter rotates its part and all that hangs below it, and changes the features of its joint.
        The derivative with respect to trans is the identity.
        """
        pose, trans = check_pose(self.skeleton, pose, trans)
        if pose.ndim == 2:
            y, columns = self.columns(pose, trans)
            return y, np.moveaxis(columns, (0, 1), (-1, -2))
        # a batch goes in pieces; each piece turns from coordinates first to points first
        B, J, L = len(pose), len(self.skeleton.parents), self.count
        y, d_pose = np.empty((B, L, 3)), np.empty((B, L, 3, 3 * J))
        step = self._at_once(3 * L)
        for start in range(0, B, step):
            batch = slice(start, start + step)
            y[batch], columns = self.columns(pose[batch], trans[batch])
            d_pose[batch] = np.moveaxis(columns, (1, 2), (-1, -2))
        return y, d_pose


def check_subject(body: Any) -> Subject:
    """Return a subject as it is; TypeError for a model, which is of nobody, that says how to make one."""
    if not isinstance(body, Subject):
        raise TypeError(f"subject: expected a Subject, got a {type(body).__name__}; model.subject(betas) is a person, "
                        "model.subject(None) the template's own body")
    return body


@dataclass(frozen=True, eq=False)
class Subject:
    """A body of fixed shape, ready to be posed fast; made by `BodyModel.subject`.

    Parameters
    ----------
    template : Mesh
        N vertices, F triangles of the model.
    skeleton : Skeleton
        J parts of the model.
    betas : (K,) float or None
        The body's shape; None is the template's own body.
    operator : PointOperator
        All vertices, in the type that they are to have.
    pose_mean, pose_covariance : (J, 3) and (3J, 3J) float, optional
        The model's pose prior, which a body of known shape keeps.
    pose_examples : (M, J, 3) float, radians, optional
        The model's training poses.
    left_out_error : float, metres, optional
        How far off the model predicted poses that were left out of learning.
    regressor : (J, N) sparse, optional
        Joints as combinations of vertices; else those of the skeleton's rings.

    Examples
    --------
    >>> from model import load_built_in_model
    >>> tall = load_built_in_model().subject([1.0], dtype=np.float32)
    >>> tall.vertices(np.zeros((50, 16, 3))).shape
    (50, 5002, 3)

    [SCAPE] Eq. 9
    """

    template: Mesh
    skeleton: Skeleton
    betas: np.ndarray | None
    operator: PointOperator
    pose_mean: np.ndarray | None = None
    pose_covariance: np.ndarray | None = None
    pose_examples: np.ndarray | None = None
    left_out_error: float | None = None
    regressor: csr_array | None = None
    __repr__ = describe_result

    @property
    def n_vertices(self) -> int:
        """N, the number of vertices."""
        return self.operator.count

    @property
    def origin(self) -> np.ndarray:
        """(3,) metres: the root's joint when trans is zero."""
        return self.operator.origin

    @cached_property
    def joint_regressor(self) -> csr_array:
        """(J, N) weights: `joint_regressor @ vertices` are the joints of a body."""
        return self.skeleton.joint_regressor(self.template) if self.regressor is None else self.regressor

    def vertices(self, poses: np.ndarray, trans: np.ndarray | None = None) -> np.ndarray:
        """Compute the vertices for one pose or a batch.

        Parameters
        ----------
        poses : (J, 3) or (B, J, 3) float, radians
            One pose or a batch.
        trans : (3,) or (B, 3) float, metres, optional
            Travel of the root's joint.

        Returns
        -------
        (N, 3) or (B, N, 3) float of the subject's dtype, metres
        """
        return self.operator.evaluate(poses, trans)

    def joints(self, poses: np.ndarray, trans: np.ndarray | None = None) -> np.ndarray:
        """Compute the joint centres (..., J, 3), metres, for poses (..., J, 3), radians, and trans (..., 3), metres.

        Joints are affine combinations of the surface around them; an imported model has its own.
        """
        return self._joints.evaluate(poses, trans)

    @cached_property
    def rest_skeleton(self) -> Skeleton:
        """The skeleton with the joints of this body at rest."""
        return replace(self.skeleton, joints=self.joints(np.zeros((len(self.skeleton.parents), 3))))

    @cached_property
    def _joints(self) -> PointOperator:
        return self.operator.joints(self.joint_regressor).astype(np.float64)

    def points(self, vertex_ids: np.ndarray, weights: np.ndarray | None = None) -> PointOperator:
        """Build the fast path of some surface points of the body.

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
        return self.operator.combine(combination_weights(self.n_vertices, vertex_ids, weights)).astype(np.float64)


def combination_weights(n_vertices: int, vertex_ids: np.ndarray, weights: np.ndarray | None) -> csr_array:
    """Build the matrix (L, N) of surface points as combinations of vertices; arguments as of `Subject.points`."""
    ids, weights = check_combinations(n_vertices, vertex_ids, weights)
    share = np.ones(ids.shape) if weights is None else weights
    ends = np.arange(len(ids) + 1) * (ids.shape[1] if ids.ndim == 2 else 1)
    matrix = csr_array((share.ravel(), ids.ravel(), ends), shape=(len(ids), n_vertices), copy=True)
    matrix.sum_duplicates()
    return matrix


def find_single_rows(weights: np.ndarray | sparray) -> np.ndarray | None:
    """Find the points (K,) that weights (K, L) pick one by one; None for true combinations."""
    if isinstance(weights, np.ndarray) or weights.nnz != weights.shape[0]:
        return None
    rows = csr_array(weights)
    return rows.indices if (rows.data == 1).all() and (np.diff(rows.indptr) == 1).all() else None


def check_combinations(n_vertices: int, vertex_ids: np.ndarray, weights: np.ndarray | None
                       ) -> tuple[np.ndarray, np.ndarray | None]:
    """Check vertex indices and weights of surface points and return them as arrays; else ValueError."""
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
