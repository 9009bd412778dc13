"""Pose priors: the Gaussian of a model's training poses, and joint limits."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanprep.geometry import rotations

from .body import BodyModel
from .linear import check_pose

LEAST_POSES = 5                      # fewer poses give no quantiles for joint limits
# share of the size: a model with a larger error on poses left out of learning is doubtful, 30 mm on a man. A model of 8
# poses and 10 men is 13 mm off; one of 3 poses is 26 mm off, and 24 of the 38 bodies that it completes are wrong.
CRUDE = 0.022
STIFF = np.radians(5)                # a joint that turned less than this in every pose counts as never bent


SHRINKAGE = 0.3                      # share of the diagonal: few poses show correlations between joints by chance
FLOOR = 0.05                         # radians added to the spread of each angle: no joint is as stiff as few poses show


def whitening(covariance: np.ndarray, shrinkage: float = SHRINKAGE) -> np.ndarray:
    """Compute the matrix (3J - 3, 3J) that takes poses minus their mean to unit covariance; the root is free.

    Few training poses show correlations by chance. So the covariance (3J, 3J) is shrunk towards its diagonal by the
    share `shrinkage`, and the variance `FLOOR`² is added to every angle.
    """
    inner = covariance[3:, 3:]
    safe = (1 - shrinkage) * inner + np.diag(shrinkage * np.diag(inner) + FLOOR**2)
    W = np.zeros((len(inner), len(covariance)))
    W[:, 3:] = np.linalg.inv(np.linalg.cholesky(safe))
    return W


@dataclass(frozen=True, eq=False)
class GaussianPrior:
    """A Gaussian over the joint angles of a pose; the root rotates freely."""

    mean: np.ndarray                 # (3J,), radians
    whitening: np.ndarray            # (3J-3, 3J), 1 / radians: `whitening @ (pose - mean)` has unit covariance

    def energy(self, pose: np.ndarray) -> float:
        """Compute the squared Mahalanobis distance of a pose (J, 3)."""
        return float(((self.whitening @ (pose.ravel() - self.mean))**2).sum())


def gaussian_prior(mean: np.ndarray, covariance: np.ndarray, shrinkage: float = SHRINKAGE) -> GaussianPrior:
    """Build the prior from mean (J, 3) and covariance (3J, 3J) of training poses, regularised by `whitening`."""
    mean = np.asarray(mean, dtype=np.float64).reshape(-1)
    covariance = np.asarray(covariance, dtype=np.float64)
    if covariance.shape != (len(mean), len(mean)):
        raise ValueError(f"covariance: expected shape {(len(mean), len(mean))}, got {covariance.shape}")
    if not (np.isfinite(mean).all() and np.isfinite(covariance).all()):
        raise ValueError("mean, covariance: expected finite values")
    return GaussianPrior(mean, whitening(covariance, shrinkage))


def typical_poses(mean: np.ndarray, covariance: np.ndarray, axes: int) -> np.ndarray:
    """List typical poses (at most 1 + 2 axes, J, 3): the mean, and steps both ways along its principal axes.

    Each step is 1.5 standard deviations long, as a pose of every eighth person; the root is not turned.
    """
    mean = np.array(mean, dtype=np.float64)
    mean[0] = 0
    variance, direction = np.linalg.eigh(np.asarray(covariance)[3:, 3:])
    kept = np.argsort(-variance)[:min(axes, int((variance > 1e-9).sum()))]
    step = np.zeros((len(kept), mean.size))
    step[:, 3:] = 1.5 * (np.sqrt(variance[kept]) * direction[:, kept]).T
    return mean + np.concatenate([np.zeros((1, mean.size)), step, -step]).reshape(-1, *mean.shape)


def stiff_joints(poses: np.ndarray) -> np.ndarray:
    """Find parts whose joints never rotated more than `STIFF` in poses (M, J, 3), radians; none without poses."""
    if not len(poses):
        return np.zeros(0, dtype=np.int64)
    return 1 + np.flatnonzero(np.linalg.norm(poses[:, 1:], axis=-1).max(axis=0) < STIFF)


def sample_poses(model: BodyModel, count: int, rng: np.random.Generator, limits: JointLimits | None = None
                 ) -> np.ndarray:
    """Draw random poses from the model's Gaussian pose prior.

    Parameters
    ----------
    model : BodyModel
        The model with its pose prior.
    count : int
        Number of poses.
    rng : numpy.random.Generator
        Source of the random numbers.
    limits : JointLimits, optional
        Joints beyond these limits are brought back to them.

    Returns
    -------
    (count, J, 3) float, radians
        Poses; the root is at rest.

    Raises
    ------
    ValueError
        `count` is negative.

    Examples
    --------
    >>> from model import load_built_in_model
    >>> sample_poses(load_built_in_model(), 5, np.random.default_rng(0)).shape
    (5, 16, 3)
    """
    if count < 0:
        raise ValueError(f"count: expected 0 or more, got {count}")
    variances, axes = np.linalg.eigh(model.pose_covariance)     # singular: the root does not turn
    unit = rng.normal(size=(count, len(variances))) * np.sqrt(np.maximum(variances, 0))
    poses = check_pose(model.skeleton, model.pose_mean + (unit @ axes.T).reshape(count, -1, 3), None)[0]
    return poses if limits is None else limits.clip(poses)


@dataclass(frozen=True, eq=False)
class JointLimits:
    """Bounds of the rotation of every joint along its own principal directions.

    A rotation is taken relative to the joint's mean (J, 3): `log(mean⁻¹ exp(pose))`. So the jump at half a turn is far
    from the poses that were seen. The columns of `axes` (J, 3, 3) are the principal directions, the widest first. `low`
    and `high` (J, 3), radians, bound them one by one. The root is free.
    """

    mean: np.ndarray
    axes: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @staticmethod
    def from_poses(poses: np.ndarray, coverage: float = 0.98, slack: float = 0.1) -> JointLimits:
        """Compute bounds that hold a share of poses (M, J, 3), M ≥ 5, in each direction, widened by `slack`, radians.

        The poses outside are shared equally between the two sides. The slack is there because few poses do not show
        the whole range of a joint.
        """
        poses = np.asarray(poses, dtype=np.float64)
        if poses.ndim != 3 or poses.shape[2] != 3 or len(poses) < LEAST_POSES or not np.isfinite(poses).all():
            raise ValueError(f"poses: expected at least {LEAST_POSES} finite poses (M, J, 3), got shape {poses.shape}")
        if not 0 < coverage <= 1 or slack < 0:
            raise ValueError(f"coverage and slack: expected 0 < coverage <= 1 and slack >= 0, got {coverage}, {slack}")
        # each joint's rotations relative to their mean, and the principal directions of these
        R, J = rotations.exp(poses), poses.shape[1]
        mean = np.stack([rotations.mean(R[:, j]) for j in range(J)])
        t = rotations.log(np.swapaxes(mean, -1, -2) @ R)
        axes = np.stack([np.linalg.eigh(t[:, j].T @ t[:, j])[1][:, ::-1] for j in range(J)])
        along = np.einsum("mji,jik->mjk", t, axes)
        # quantiles along each direction; the root has no bounds
        low, high = np.quantile(along, [(1 - coverage) / 2, (1 + coverage) / 2], axis=0)
        low, high = low - slack, high + slack
        low[0], high[0] = -np.inf, np.inf
        return JointLimits(rotations.log(mean), axes, low, high)

    def clip(self, pose: np.ndarray) -> np.ndarray:
        """Bring every joint of poses (..., J, 3), radians, back within its bounds."""
        _, along = self._from_mean(pose)
        back = np.clip(along, self.low, self.high)
        rotated = rotations.exp(self.mean) @ rotations.exp(np.einsum("jik,...jk->...ji", self.axes, back))
        return np.where((back != along).any(axis=-1, keepdims=True), rotations.log(rotated), pose)

    def excess(self, pose: np.ndarray) -> np.ndarray:
        """Compute by how much each joint of poses (..., J, 3) exceeds its bounds, (..., J) radians; 0 within."""
        _, along = self._from_mean(pose)
        return np.linalg.norm(along - np.clip(along, self.low, self.high), axis=-1)

    def residual(self, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute the excess (..., 3J) of poses (..., J, 3), radians, and its derivative (..., 3J, 3J) by the pose."""
        pose = np.asarray(pose, dtype=np.float64)
        t, along = self._from_mean(pose)
        beyond = along - np.clip(along, self.low, self.high)
        slope = np.swapaxes(self.axes, -1, -2) @ rotations.inverse_right_jacobian(t) @ rotations.right_jacobian(pose)
        J, leading = len(self.mean), pose.shape[:-2]
        # each joint depends on its own parameters only: a block-diagonal derivative, zero within the bounds
        blocks = np.zeros((*leading, J, 3, J, 3))
        each = np.arange(J)
        blocks[..., each, :, each, :] = np.moveaxis(np.where(beyond[..., None] != 0, slope, 0), -3, 0)
        return beyond.reshape(*leading, 3 * J), blocks.reshape(*leading, 3 * J, 3 * J)

    def _from_mean(self, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute rotation vectors (..., J, 3) from the mean, and their components along the principal directions."""
        t = rotations.log(np.swapaxes(rotations.exp(self.mean), -1, -2) @ rotations.exp(pose))
        return t, np.einsum("...ji,jik->...jk", t, self.axes)
