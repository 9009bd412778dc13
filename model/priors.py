"""Pose priors: the Gaussian of a model's training poses."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .body import BodyModel
from .linear import check_pose

# share of the size: a model with a larger error on poses left out of learning is doubtful, 30 mm on a man. A model of 8
# poses and 10 men is 13 mm off; one of 3 poses is 26 mm off, and 24 of the 38 bodies that it completes are wrong.
CRUDE = 0.022
STIFF = np.radians(5)                # a joint that turned less than this in every pose counts as never bent
SHRINKAGE = 0.3                      # share of the diagonal: few poses show correlations between joints by chance
FLOOR = 0.05                         # radians added to the spread of each angle: no joint is as stiff as few poses show


@dataclass(frozen=True, eq=False)
class GaussianPrior:
    """A Gaussian over the joint angles of a pose; the root rotates freely."""

    mean: np.ndarray                 # (3J,), radians
    whitening: np.ndarray            # (3J-3, 3J), 1 / radians: `whitening @ (pose - mean)` has unit covariance


def gaussian_prior(mean: np.ndarray, covariance: np.ndarray, shrinkage: float = SHRINKAGE) -> GaussianPrior:
    """Build the prior from mean (J, 3) and covariance (3J, 3J) of training poses.

    Few training poses show correlations by chance. So the covariance is shrunk towards its diagonal by the share
    `shrinkage`, and the variance `FLOOR`² is added to every angle.
    """
    mean = np.asarray(mean, dtype=np.float64).reshape(-1)
    covariance = np.asarray(covariance, dtype=np.float64)
    if covariance.shape != (len(mean), len(mean)):
        raise ValueError(f"covariance: expected shape {(len(mean), len(mean))}, got {covariance.shape}")
    if not (np.isfinite(mean).all() and np.isfinite(covariance).all()):
        raise ValueError("mean, covariance: expected finite values")
    inner = covariance[3:, 3:]
    safe = (1 - shrinkage) * inner + np.diag(shrinkage * np.diag(inner) + FLOOR**2)
    W = np.zeros((len(inner), len(covariance)))
    W[:, 3:] = np.linalg.inv(np.linalg.cholesky(safe))
    return GaussianPrior(mean, W)


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


def sample_poses(model: BodyModel, count: int, rng: np.random.Generator) -> np.ndarray:
    """Draw random poses from the model's Gaussian pose prior.

    Parameters
    ----------
    model : BodyModel
        The model with its pose prior.
    count : int
        Number of poses.
    rng : numpy.random.Generator
        Source of the random numbers.

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
    return check_pose(model.skeleton, model.pose_mean + (unit @ axes.T).reshape(count, -1, 3), None)[0]
