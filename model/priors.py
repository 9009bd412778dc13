"""What is known of a pose before anything is measured: the Gaussian of a model's training poses, and joint limits."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanprep.geometry import rotations

from .body import BodyModel
from .linear import check_pose

LEAST_POSES = 5
# Metres off in poses that were left out, from where on a model is doubtful. Of 8 poses and 10 men it is 13 mm off in
# others, of 3 poses 26, and 24 of 38 bodies that it completes are wrong.
CRUDE = 0.03
STIFF = np.radians(5)                # a joint that rotated less in every pose was not seen to bend


def whitening(covariance: np.ndarray, shrinkage: float = 0.3, floor: float = 0.15) -> np.ndarray:
    """(3J - 3, 3J) takes poses minus their mean to unit covariance; the root is free.

    Few training poses make chance correlations, so the covariance (3J, 3J) is shrunk towards its diagonal by a share,
    and a variance of `floor`², in radians, is added to every angle.
    """
    inner = covariance[3:, 3:]
    safe = (1 - shrinkage) * inner + np.diag(shrinkage * np.diag(inner) + floor**2)
    W = np.zeros((len(inner), len(covariance)))
    W[:, 3:] = np.linalg.inv(np.linalg.cholesky(safe))
    return W


@dataclass(frozen=True, eq=False)
class GaussianPrior:
    """A Gaussian over the joint angles of a pose; the root rotates freely."""

    mean: np.ndarray                 # (3J,), radians
    whitening: np.ndarray            # (3J-3, 3J), 1 / radians: `whitening @ (pose - mean)` has unit covariance

    def energy(self, pose: np.ndarray) -> float:
        """Squared Mahalanobis distance of a pose (J, 3)."""
        return float(((self.whitening @ (pose.ravel() - self.mean))**2).sum())


def gaussian_prior(mean: np.ndarray, covariance: np.ndarray, shrinkage: float = 0.3, floor: float = 0.05
                   ) -> GaussianPrior:
    """The prior from mean (J, 3) and covariance (3J, 3J) of a few training poses, safe to invert: see `whitening`."""
    mean = np.asarray(mean, dtype=np.float64).reshape(-1)
    covariance = np.asarray(covariance, dtype=np.float64)
    if covariance.shape != (len(mean), len(mean)):
        raise ValueError(f"covariance: expected shape {(len(mean), len(mean))}, got {covariance.shape}")
    if not (np.isfinite(mean).all() and np.isfinite(covariance).all()):
        raise ValueError("mean, covariance: expected finite values")
    return GaussianPrior(mean, whitening(covariance, shrinkage, floor))


def typical_poses(mean: np.ndarray, covariance: np.ndarray, axes: int, deviation: float = 1.5) -> np.ndarray:
    """(≤ 1 + 2 axes, J, 3), the root not turned: the mean, and a step of some deviations each way along main axes."""
    mean = np.array(mean, dtype=np.float64)
    mean[0] = 0
    variance, direction = np.linalg.eigh(np.asarray(covariance)[3:, 3:])
    kept = np.argsort(-variance)[:min(axes, int((variance > 1e-9).sum()))]
    step = np.zeros((len(kept), mean.size))
    step[:, 3:] = deviation * (np.sqrt(variance[kept]) * direction[:, kept]).T
    return mean + np.concatenate([np.zeros((1, mean.size)), step, -step]).reshape(-1, *mean.shape)


def stiff_joints(poses: np.ndarray) -> np.ndarray:
    """Parts whose joints never rotated more than `STIFF` in poses (M, J, 3), radians; none where there are no poses."""
    if not len(poses):
        return np.zeros(0, dtype=np.int64)
    return 1 + np.flatnonzero(np.linalg.norm(poses[:, 1:], axis=-1).max(axis=0) < STIFF)


def sample_poses(model: BodyModel, count: int, rng: np.random.Generator, limits: JointLimits | None = None
                 ) -> np.ndarray:
    """Poses (count, J, 3), radians, drawn from the model's Gaussian prior, the root at rest, brought within joint
    limits.
    """
    if count < 0:
        raise ValueError(f"count: expected 0 or more, got {count}")
    variances, axes = np.linalg.eigh(model.pose_covariance)     # singular: the root does not turn
    unit = rng.normal(size=(count, len(variances))) * np.sqrt(np.maximum(variances, 0))
    poses = check_pose(model.skeleton, model.pose_mean + (unit @ axes.T).reshape(count, -1, 3), None)[0]
    return poses if limits is None else limits.clip(poses)


@dataclass(frozen=True, eq=False)
class JointLimits:
    """Bounds of the rotation of every joint along its own main directions.

    A rotation is looked at from the joint's mean (J, 3), `log(mean⁻¹ exp(pose))`, which has no seam near the poses that
    were seen. Its principal directions, the columns of `axes` (J, 3, 3), the widest first, are bounded one by one by
    `low` and `high` (J, 3), radians. The root is free.
    """

    mean: np.ndarray
    axes: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @staticmethod
    def from_poses(poses: np.ndarray, coverage: float = 0.98, slack: float = 0.1) -> JointLimits:
        """Bounds that hold a share of poses (M, J, 3), M ≥ 5, in each direction, moved outwards by `slack`, radians.

        What is left out is left out on both sides alike; few poses do not show all that a joint can do.
        """
        poses = np.asarray(poses, dtype=np.float64)
        if poses.ndim != 3 or poses.shape[2] != 3 or len(poses) < LEAST_POSES or not np.isfinite(poses).all():
            raise ValueError(f"poses: expected at least {LEAST_POSES} finite poses (M, J, 3), got shape {poses.shape}")
        if not 0 < coverage <= 1 or slack < 0:
            raise ValueError(f"coverage and slack: expected 0 < coverage <= 1 and slack >= 0, got {coverage}, {slack}")
        R, J = rotations.exp(poses), poses.shape[1]
        mean = np.stack([rotations.mean(R[:, j]) for j in range(J)])
        t = rotations.log(np.swapaxes(mean, -1, -2) @ R)
        axes = np.stack([np.linalg.eigh(t[:, j].T @ t[:, j])[1][:, ::-1] for j in range(J)])
        along = np.einsum("mji,jik->mjk", t, axes)
        low, high = np.quantile(along, [(1 - coverage) / 2, (1 + coverage) / 2], axis=0)
        low, high = low - slack, high + slack
        low[0], high[0] = -np.inf, np.inf
        return JointLimits(rotations.log(mean), axes, low, high)

    def clip(self, pose: np.ndarray) -> np.ndarray:
        """The poses (..., J, 3), radians, with every joint beyond its bounds brought back to them."""
        _, along = self._from_mean(pose)
        back = np.clip(along, self.low, self.high)
        rotated = rotations.exp(self.mean) @ rotations.exp(np.einsum("jik,...jk->...ji", self.axes, back))
        return np.where((back != along).any(axis=-1, keepdims=True), rotations.log(rotated), pose)

    def excess(self, pose: np.ndarray) -> np.ndarray:
        """(..., J) by how much each joint of poses (..., J, 3) is beyond its bounds, radians; 0 within."""
        _, along = self._from_mean(pose)
        return np.linalg.norm(along - np.clip(along, self.low, self.high), axis=-1)

    def residual(self, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How far poses (..., J, 3) are beyond, (..., 3J) radians, and its derivative (..., 3J, 3J) by the pose."""
        pose = np.asarray(pose, dtype=np.float64)
        t, along = self._from_mean(pose)
        beyond = along - np.clip(along, self.low, self.high)
        slope = np.swapaxes(self.axes, -1, -2) @ rotations.inverse_right_jacobian(t) @ rotations.right_jacobian(pose)
        J, leading = len(self.mean), pose.shape[:-2]
        blocks = np.zeros((*leading, J, 3, J, 3))
        each = np.arange(J)
        blocks[..., each, :, each, :] = np.moveaxis(np.where(beyond[..., None] != 0, slope, 0), -3, 0)
        return beyond.reshape(*leading, 3 * J), blocks.reshape(*leading, 3 * J, 3 * J)

    def _from_mean(self, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rotations (..., J, 3) from the mean, and the same along the main directions."""
        t = rotations.log(np.swapaxes(rotations.exp(self.mean), -1, -2) @ rotations.exp(pose))
        return t, np.einsum("...ji,jik->...jk", t, self.axes)
