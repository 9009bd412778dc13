"""Points of a skinned body: a pose-corrective shift at rest, then the weighted mean of the motions of the parts.

    y_n = Σ_p w_np (R_p (x_n + Σ_f f(pose) C_fn) + t_p) + origin + trans,    t_p = y_jp - R_p j_p

For a batch of poses, the sum over the joints' features f is one matrix product; the mean of the rotations is another.
SCAPE instead adds up products of features and rotations; here that would be as many as features times parts.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
from scipy.sparse import block_diag, csr_array, eye_array, sparray

from scanprep.geometry import rotations
from scanprep.skeleton.tree import Skeleton

from .bilinear import ShapedPoints
from .features import PoseFeatures, lift_derivative, lift_twists
from .linear import PointOperator, find_single_rows
from .products import Products

AT_ONCE = 2**21                      # numbers of the blended motions that are held together: 16 MB in float64

Mix: TypeAlias = np.ndarray | sparray | None


@dataclass(frozen=True, eq=False)
class Blended(PointOperator):
    """Points of a skinned body.

    Parameters
    ----------
    features : PoseFeatures
        Functions of the pose; the bends are linear in its lifted twists.
    weights : (n, J) float
        Blend weights.
    rest : (n, 3) float, metres
        Vertices at zero pose.
    places : (J, 3) float, metres
        Joints at zero pose.
    bends : (J - 1, m, 3, n) float, metres
        Change of the rest vertices by every lifted number of every joint but the root's.
    origin : (3,) float, metres
    bent : float
        Factor on the bends; differs from 1 for sums and multiples of bodies.
    middle : Products, optional
        A mean of vertices that is held at `origin` instead of the root's joint.
    mix : (L, n) float, optional
        Points as combinations of vertices; None where the points are the vertices.
    """

    features: PoseFeatures
    weights: np.ndarray
    rest: np.ndarray
    places: np.ndarray
    bends: np.ndarray
    origin: np.ndarray
    bent: float = 1.0
    middle: Products | None = None
    mix: Mix = None

    @property
    def skeleton(self) -> Skeleton:
        return self.features.skeleton

    @property
    def count(self) -> int:
        return len(self.rest) if self.mix is None else self.mix.shape[0]

    @property
    def load(self) -> int:
        return 16 * len(self.skeleton.parents) * max(1, len(self.rest) // max(1, self.count))

    @cached_property
    def _share(self) -> np.ndarray:
        """(L,) sum of each point's weights: 1, except for rows that are directions and not points."""
        return np.ones(self.count) if self.mix is None else np.asarray(self.mix.sum(axis=1)).ravel()

    def relative_positions(self, pose: np.ndarray) -> np.ndarray:
        # slices of the batch whose blended motions fit into AT_ONCE numbers
        poses, n = pose.reshape(-1, *pose.shape[-2:]), len(self.rest)
        out = np.empty((len(poses), 3, self.count), dtype=self.rest.dtype)
        step = max(1, AT_ONCE // max(1, 12 * n))
        for start in range(0, len(poses), step):
            batch = slice(start, start + step)
            M, x = self._motions(*self._rigid(poses[batch])), self._correct_rest(poses[batch])
            # y = M x of every vertex, one axis of x after the other: faster than einsum over small matrices
            y = M[:, :, 3]
            for k in range(3):
                y += M[:, :, k] * x[:, k, None]
            out[batch] = _mix(y, self.mix)
        if self.middle is not None:
            out -= self.middle.relative_positions(poses) * self._share
        return out.reshape(*pose.shape[:-2], 3, self.count)

    def columns(self, pose: np.ndarray, trans: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        poses, (n, J), leading = pose.reshape(-1, *pose.shape[-2:]), self.weights.shape, pose.shape[:-2]
        B, descends = len(poses), self.skeleton.descends.astype(float)
        # 1. where every part alone would take every vertex, weighted, and summed over all that hangs below a joint
        R, t, moved = self._rigid(poses)
        each = R @ self._correct_rest(poses)[:, None] + t[..., None]          # (B, J, 3, n) where a part alone takes it
        each *= self.weights.T[:, None]
        carried = (descends.T @ each.reshape(B, J, -1)).reshape(each.shape)   # all that hangs below each joint
        # relative to the joint about which the parameter turns
        carried -= (self.weights @ descends).T[:, None] * moved[..., None]
        turn = R @ rotations.right_jacobian(poses)                            # world turn per parameter, in columns
        # ω × x = hat(ω) @ x for every column ω of `turn`
        columns = rotations.hat(np.swapaxes(turn, -1, -2)) @ carried[:, :, None]                # (B, J, 3, 3, n)
        # 2. the pose correctives change with the joint's own parameters, and turn with the blended rotation
        if self.bent and self.bends.size:
            slope = self.bent * np.swapaxes(lift_derivative(self.features.lift, poses)[:, 1:], -1, -2)
            sway = (slope @ self.bends.reshape(*self.bends.shape[:2], -1)).reshape(B, J - 1, 3, 3, n)
            G = self._motions(R, t, moved)[:, None, None]
            for k in range(3):
                columns[:, 1:] += G[..., k, :] * sway[..., k, None, :]
        # 3. combinations of vertices, and the point that is held still is subtracted
        y = np.swapaxes(_mix(carried[:, 0], self.mix), -1, -2).reshape(*leading, self.count, 3)
        columns = _mix(columns, self.mix).reshape(*leading, 3 * J, 3, self.count)
        if self.middle is not None:
            held, by_pose = self.middle.columns(pose, np.zeros(3))
            y, columns = y - held * self._share[:, None], columns - by_pose * self._share
        return y + (self.origin + trans)[..., None, :], columns

    def _rigid(self, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute the part rotations (B, J, 3, 3), translations t_p (B, J, 3) and joints (B, J, 3), the root's 0."""
        R = self.skeleton.part_rotations(poses)
        return R, *relative_to_parents(self.skeleton, R, self.places)

    def _motions(self, R: np.ndarray, t: np.ndarray, _: np.ndarray) -> np.ndarray:
        """Blend the motions of the parts: (B, 3, 4, n) mean rotation and translation of every vertex."""
        motion = np.concatenate([R, t[..., None]], axis=-1).reshape(*R.shape[:2], 12)
        M = np.swapaxes(motion, 1, 2).astype(self.rest.dtype, copy=False) @ self.weights.T
        return M.reshape(len(R), 3, 4, -1)

    def _correct_rest(self, poses: np.ndarray) -> np.ndarray:
        """Add the pose correctives to the rest vertices: (B, 3, n), metres."""
        x = np.ascontiguousarray(self.rest.T)
        if not self.bent or not self.bends.size:
            return np.broadcast_to(x, (len(poses), *x.shape))
        f = self.bent * lift_twists(self.features.lift, poses)[:, 1:].reshape(len(poses), -1)
        return (f.astype(x.dtype, copy=False) @ self.bends.reshape(f.shape[1], -1)).reshape(-1, *x.shape) + x

    def combine(self, weights: np.ndarray | sparray) -> Blended:
        used, mix = _find_needed_vertices(self.mix, weights)
        return replace(self, weights=self.weights[used], rest=self.rest[used],
                       bends=np.ascontiguousarray(self.bends[..., used]), mix=mix)

    def joints(self, regressor: sparray) -> Blended:
        if self.middle is not None:
            return self.combine(regressor)
        above = np.maximum(self.skeleton.parents, 0)              # a joint hangs on the part above it
        return replace(self, weights=np.eye(len(above))[above], rest=self.places, bends=np.zeros((0, 0, 3, len(above))),
                       mix=None)

    def plus(self, factor: float, other: PointOperator) -> Blended:
        assert isinstance(other, Blended), "of the same kind of model"
        middle = self.middle if self.middle is None or other.middle is None else self.middle.plus(factor, other.middle)
        return replace(self, rest=self.rest + self.rest.dtype.type(factor) * other.rest, middle=middle,
                       places=self.places + factor * other.places, origin=self.origin + factor * other.origin,
                       bent=self.bent + factor * other.bent)

    def scale_by(self, factor: float) -> Blended:
        return replace(self, rest=(factor * self.rest).astype(self.rest.dtype), places=factor * self.places,
                       bent=factor * self.bent, middle=None if self.middle is None else self.middle.scale_by(factor))

    def astype(self, dtype: Any) -> Blended:
        weights, rest, bends = (a.astype(dtype, copy=False) for a in (self.weights, self.rest, self.bends))
        return replace(self, weights=weights, rest=rest, bends=bends)

    def concatenate(self, other: Blended) -> Blended:
        """Append other points of the same body."""
        mix = csr_array(block_diag([eye_array(one.count) if one.mix is None else one.mix for one in (self, other)]))
        weights, rest = (np.concatenate([getattr(self, name), getattr(other, name)]) for name in ("weights", "rest"))
        return replace(self, weights=weights, rest=rest, bends=np.concatenate([self.bends, other.bends], axis=-1),
                       mix=mix)


def relative_to_parents(skeleton: Skeleton, R: np.ndarray, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Chain the joints (..., J, 3) by part rotations (B, J, 3, 3).

    Returns the translations `y_j - R j` of the parts and the posed joints `y_j`, both (B, ..., J, 3), metres; the
    root's joint is in the origin.
    """
    R = R.reshape(len(R), *(1,) * (joints.ndim - 2), *R.shape[1:])
    y = np.zeros(np.broadcast_shapes(R.shape[:-1], joints.shape))
    for j in range(1, len(skeleton.parents)):
        p = skeleton.parents[j]
        y[..., j, :] = y[..., p, :] + (R[..., p, :, :] @ (joints[..., j, :] - joints[..., p, :])[..., None])[..., 0]
    return y - (R @ joints[..., None])[..., 0], y


def _find_needed_vertices(mix: Mix, weights: np.ndarray | sparray) -> tuple[np.ndarray | slice, Mix]:
    """Find the vertices that combinations (K, L) of points need, and the combinations in terms of those vertices.

    The points are combinations `mix` (L, n) of n vertices.
    """
    # picking single vertices needs no combination
    rows = find_single_rows(weights) if mix is None else None
    if rows is not None:
        return rows, None
    if isinstance(weights, np.ndarray):
        return slice(None), weights if mix is None else weights @ mix
    # sparse combinations: keep only the vertices with a weight, and renumber the columns
    whole = csr_array(weights if mix is None else weights @ csr_array(mix))
    used, place = np.unique(whole.indices, return_inverse=True)
    return used, csr_array((whole.data, place, whole.indptr), shape=(whole.shape[0], len(used)))


def _mix(y: np.ndarray, mix: Mix) -> np.ndarray:
    """Apply combinations (L, n) to coordinates (..., n)."""
    return y if mix is None else np.asarray(y.reshape(-1, y.shape[-1]) @ mix.T).reshape(*y.shape[:-1], mix.shape[0])


@dataclass(frozen=True, eq=False)
class ShapedBlended(ShapedPoints):
    """Points of a skinned body with unknown betas.

    Holds the template's own body and the mean person. For one standard deviation of each beta it holds the change of
    rest vertices (K, n, 3), joints (K, J, 3), origin (K, 3) and products of the middle (K, M, 3, 1), metres.
    """

    own: Blended
    mean: Blended
    rest: np.ndarray
    joints: np.ndarray
    origin: np.ndarray
    middle: np.ndarray

    @property
    def skeleton(self) -> Skeleton:
        return self.mean.skeleton

    @property
    def count(self) -> int:
        return self.mean.count

    @property
    def n_betas(self) -> int:
        return len(self.rest)

    @property
    def load(self) -> int:
        return self.mean.load

    def operator(self, betas: np.ndarray | None = None) -> Blended:
        if betas is None:
            return self.own
        # rest vertices, joints, origin and the held point are all linear in the betas
        betas, mean = self._check_betas(betas), self.mean
        rest, joints, origin, middle = (np.tensordot(betas, by_beta[:len(betas)], axes=1)
                                        for by_beta in (self.rest, self.joints, self.origin, self.middle))
        held = None if mean.middle is None else replace(mean.middle, basis=mean.middle.basis + middle)
        return replace(mean, rest=mean.rest + rest, places=mean.places + joints, origin=mean.origin + origin,
                       middle=held)

    def shape_jacobian(self, pose: np.ndarray) -> np.ndarray:
        pose = np.asarray(pose, dtype=np.float64)
        poses = pose.reshape(-1, *pose.shape[-2:])
        R = self.skeleton.part_rotations(poses)
        # derivative of the translations by the betas, blended: (B, K, 3, n)
        out = np.swapaxes(relative_to_parents(self.skeleton, R, self.joints)[0], -1, -2) @ self.mean.weights.T
        # plus the blended rotation of every vertex, applied to its change at rest
        G = (np.swapaxes(R.reshape(*R.shape[:2], 9), 1, 2) @ self.mean.weights.T).reshape(len(R), 1, 3, 3, -1)
        for k in range(3):
            out += G[:, :, :, k] * self.rest[:, None, :, k]
        out = _mix(out, self.mean.mix)
        if self.mean.middle is not None:
            out -= np.swapaxes(self._middles.relative_positions(poses), -1, -2)[..., None]
        out += self.origin[..., None]
        return np.moveaxis(out, -1, 1).swapaxes(-1, -2).reshape(*pose.shape[:-2], self.count, 3, self.n_betas)

    @cached_property
    def _middles(self) -> Products:
        """The change of the middle by the betas, one beta in the place of one point."""
        assert self.mean.middle is not None, "a body that is held by its middle"
        return replace(self.mean.middle, basis=np.moveaxis(self.middle[..., 0], 0, -1))

    def combine(self, weights: np.ndarray | sparray) -> ShapedBlended:
        used, _ = _find_needed_vertices(self.mean.mix, weights)
        return replace(self, own=self.own.combine(weights), mean=self.mean.combine(weights), rest=self.rest[:, used])

    def concatenate(self, other: ShapedPoints) -> ShapedBlended:
        assert isinstance(other, ShapedBlended), "of the same model"
        return replace(self, own=self.own.concatenate(other.own), mean=self.mean.concatenate(other.mean),
                       rest=np.concatenate([self.rest, other.rest], axis=1))

    def along(self, directions: np.ndarray) -> ShapedBlended:
        return self._each(lambda by_beta: np.tensordot(directions, by_beta, axes=1))

    def first(self, n_betas: int) -> ShapedBlended:
        return self._each(lambda by_beta: by_beta[:n_betas])

    def _each(self, change: Callable[[np.ndarray], np.ndarray]) -> ShapedBlended:
        """Apply a function to the four arrays that change with the betas."""
        return replace(self, rest=change(self.rest), joints=change(self.joints), origin=change(self.origin),
                       middle=change(self.middle))
