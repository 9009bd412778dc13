"""What is known about poses before anything is measured."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class GaussianPrior:
    """A Gaussian over the joint angles of a pose; the root turns freely.

    Attributes
    ----------
    mean : (3J,) float, radians
    whitening : (3J-3, 3J) float, 1 / radians
        `whitening @ (pose - mean)` has unit covariance.
    """

    mean: np.ndarray
    whitening: np.ndarray

    @property
    def free(self) -> int:
        """How many angles the prior speaks about."""
        return len(self.whitening)


def gaussian_prior(mean: np.ndarray, covariance: np.ndarray, shrinkage: float = 0.3, floor: float = 0.05
                   ) -> GaussianPrior:
    """The prior from moments of a few training poses, made safe to invert and to extrapolate with.

    Parameters
    ----------
    mean : (J, 3) float, radians
    covariance : (3J, 3J) float
        The rows of the root are not used.
    shrinkage : float in [0, 1]
        How far the covariance moves towards its diagonal: few poses make many chance correlations.
    floor : float, radians
        Standard deviation added to every angle.

    Raises
    ------
    ValueError
        Shapes that do not agree, values that are not finite.
    """
    mean = np.asarray(mean, dtype=np.float64).reshape(-1)
    covariance = np.asarray(covariance, dtype=np.float64)
    if covariance.shape != (len(mean), len(mean)):
        raise ValueError(f"covariance: expected shape {(len(mean), len(mean))}, got {covariance.shape}")
    if not (np.isfinite(mean).all() and np.isfinite(covariance).all()):
        raise ValueError("mean, covariance: expected finite values")
    inner = covariance[3:, 3:]
    safe = (1 - shrinkage) * inner + np.diag(shrinkage * np.diag(inner) + floor**2)
    whitening = np.zeros((len(mean) - 3, len(mean)))
    whitening[:, 3:] = np.linalg.inv(np.linalg.cholesky(safe))
    return GaussianPrior(mean, whitening)


def typical_poses(mean: np.ndarray, covariance: np.ndarray, axes: int, deviation: float = 1.5) -> np.ndarray:
    """Poses to start a search from: the mean, and a step each way along the main directions of variation.

    Parameters
    ----------
    mean : (J, 3) float, radians
    covariance : (3J, 3J) float
    axes : int
        Number of directions, those of largest variance.
    deviation : float
        Length of the step in standard deviations.

    Returns
    -------
    (1 + 2 axes, J, 3) float, radians
        The root is not turned.
    """
    mean = np.array(mean, dtype=np.float64)
    mean[0] = 0
    inner = np.asarray(covariance)[3:, 3:]
    if not axes or not len(inner):
        return mean[None]
    variance, direction = np.linalg.eigh(inner)
    kept = np.argsort(-variance)[:axes]
    step = np.zeros((len(kept), mean.size))
    step[:, 3:] = deviation * (np.sqrt(np.maximum(variance[kept], 0)) * direction[:, kept]).T
    return mean + np.concatenate([0 * step[:1], step, -step]).reshape(-1, *mean.shape)
