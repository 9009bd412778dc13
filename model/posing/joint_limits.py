"""How far joints turn, learned from poses."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanprep.geometry import rotations
from scanprep.skeleton.tree import Skeleton

LEAST_POSES = 5


@dataclass(frozen=True, eq=False)
class JointLimits:
    """Bounds of the turn of every joint along its own main directions.

    The turn of a joint is looked at from its mean rotation: `log(mean⁻¹ exp(pose))`, which has no seam near the
    poses that were seen. Its principal directions are bounded one by one: a box in turns. The
    root is free.

    Parameters
    ----------
    mean : (J, 3) float, radians
        Mean rotation of every joint.
    axes : (J, 3, 3) float
        Principal directions of the turns from there, in columns, the widest first.
    low, high : (J, 3) float, radians
        Bounds along them; infinite where a joint is free.
    """

    mean: np.ndarray
    axes: np.ndarray
    low: np.ndarray
    high: np.ndarray

    def __post_init__(self) -> None:
        J = len(self.mean)
        for name, shape in (("mean", (J, 3)), ("axes", (J, 3, 3)), ("low", (J, 3)), ("high", (J, 3))):
            if np.shape(getattr(self, name)) != shape:
                raise ValueError(f"{name}: expected shape {shape}, got {np.shape(getattr(self, name))}")
        if not (np.asarray(self.low) <= np.asarray(self.high)).all():
            raise ValueError("low and high: expected low <= high everywhere")

    @staticmethod
    def from_poses(skeleton: Skeleton, poses: np.ndarray, coverage: float = 0.98, slack: float = 0.1) -> JointLimits:
        """Bounds that hold most of some poses.

        Parameters
        ----------
        skeleton : Skeleton
        poses : (M, J, 3) float, radians
        coverage : float in (0, 1]
            Share of the poses within the bounds of each direction; what is left out is left out on both sides alike.
        slack : float, radians
            By how much the bounds are then moved outwards: few poses do not show all that a joint can do.

        Raises
        ------
        ValueError
            Fewer than five poses, poses of another skeleton, settings out of range.
        """
        poses, J = np.asarray(poses, dtype=np.float64), len(skeleton.parents)
        if poses.ndim != 3 or poses.shape[1:] != (J, 3) or len(poses) < LEAST_POSES:
            raise ValueError(f"poses: expected shape (M, {J}, 3) with at least {LEAST_POSES} poses, got {poses.shape}")
        if not np.isfinite(poses).all():
            raise ValueError("poses: expected finite numbers")
        if not 0 < coverage <= 1 or slack < 0:
            raise ValueError(f"coverage and slack: expected 0 < coverage <= 1 and slack >= 0, got {coverage}, {slack}")
        R = rotations.exp(poses)
        mean = np.stack([rotations.mean(R[:, j]) for j in range(J)])
        t = rotations.log(np.swapaxes(mean, -1, -2) @ R)
        axes = np.stack([np.linalg.eigh(t[:, j].T @ t[:, j])[1][:, ::-1] for j in range(J)])
        along = np.einsum("mji,jik->mjk", t, axes)
        low, high = np.quantile(along, [(1 - coverage) / 2, (1 + coverage) / 2], axis=0)
        low, high = low - slack, high + slack
        low[0], high[0] = -np.inf, np.inf
        return JointLimits(rotations.log(mean), axes, low, high)

    def clip(self, pose: np.ndarray) -> np.ndarray:
        """The poses (..., J, 3), radians, with every joint that is beyond its bounds brought back to them.

        Joints within their bounds keep their numbers.
        """
        pose = np.asarray(pose, dtype=np.float64)
        c = self._along(pose)
        back = np.clip(c, self.low, self.high)
        turned = rotations.exp(self.mean) @ rotations.exp(np.einsum("jik,...jk->...ji", self.axes, back))
        return np.where((back != c).any(axis=-1, keepdims=True), rotations.log(turned), pose)

    def excess(self, pose: np.ndarray) -> np.ndarray:
        """(..., J) by how much each joint of poses (..., J, 3) is beyond its bounds, radians; 0 within."""
        c = self._along(np.asarray(pose, dtype=np.float64))
        return np.linalg.norm(c - np.clip(c, self.low, self.high), axis=-1)

    def residual(self, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How far a pose is beyond the bounds, for least squares: its square has a continuous slope.

        Parameters
        ----------
        pose : (J, 3) float, radians

        Returns
        -------
        (3J,) float, radians
            Along the directions of every joint, 0 within the bounds.
        (3J, 3J) float
            Its derivative with respect to the pose parameters.
        """
        pose = np.asarray(pose, dtype=np.float64)
        J = len(self.mean)
        if pose.shape != (J, 3):
            raise ValueError(f"pose: expected shape ({J}, 3), got {pose.shape}")
        t = self._turns(pose)
        c = np.einsum("ji,jik->jk", t, self.axes)
        beyond = c - np.clip(c, self.low, self.high)
        slope = np.swapaxes(self.axes, -1, -2) @ rotations.inverse_right_jacobian(t) @ rotations.right_jacobian(pose)
        blocks = np.zeros((J, 3, J, 3))
        blocks[np.arange(J), :, np.arange(J)] = np.where(beyond[..., None] != 0, slope, 0)
        return beyond.ravel(), blocks.reshape(3 * J, 3 * J)

    def _turns(self, pose: np.ndarray) -> np.ndarray:
        return rotations.log(np.swapaxes(rotations.exp(self.mean), -1, -2) @ rotations.exp(pose))

    def _along(self, pose: np.ndarray) -> np.ndarray:
        return np.einsum("...ji,jik->...jk", self._turns(pose), self.axes)
