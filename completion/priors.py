"""What is known about poses before anything is measured."""
from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

PosePrior = Literal["gaussian", "mixture", "nearest"]

WIDTH = 0.7                          # of a mixture's kernels, in standard deviations of the whole: leave-one-out best
MARGIN, GIVE = 0.2, 0.1              # radians beyond the range that was seen, and how hard the limit is



@dataclass(frozen=True, eq=False)
class GaussianPrior:
    """A Gaussian over the joint angles of a pose; the root turns freely."""

    mean: np.ndarray        # (3J,), radians
    whitening: np.ndarray   # (3J-3, 3J), 1 / radians, `whitening @ (pose - mean)` has unit covariance

    @property
    def free(self) -> int:
        """How many angles the prior speaks about."""
        return len(self.whitening)

    def near(self, pose: np.ndarray) -> GaussianPrior:
        """The Gaussian that stands for the prior near a pose: itself."""
        return self

    def energy(self, pose: np.ndarray) -> float:
        """Squared Mahalanobis distance of a pose (J, 3)."""
        return float(((self.whitening @ (pose.ravel() - self.mean))**2).sum())


@dataclass(frozen=True, eq=False)
class MixturePrior:
    """A mixture around the training poses, for each limb by itself.

    A pose may take its left arm from one training pose and its right leg from another. The kernels of a limb share
    one covariance, the shrunk one of all poses made narrower, and their centres are drawn towards the mean so that
    the whole keeps its covariance.
    """

    limbs: tuple[np.ndarray, ...]  # tuple of (a,) int
    centres: tuple[np.ndarray, ...]  # tuple of (M, a), radians, of the kernels of each limb
    whitenings: tuple[np.ndarray, ...]  # tuple of (a, a), 1 / radians, of the kernels of each limb
    size: int               # 3J
    sharp: bool = False     # the nearest kernel of each limb counts alone

    def near(self, pose: np.ndarray) -> GaussianPrior:
        """The Gaussian (J, 3) whose energy touches that of the mixture at a pose from above, up to a constant.

        Its mean is that of the kernels, each counted as much as it is responsible for the pose; its gradient at
        the pose is the mixture's.
        """
        mean, whitening = np.zeros(self.size), np.zeros((self.size - 3, self.size))
        for limb, centres, W in zip(self.limbs, self.centres, self.whitenings, strict=True):
            half = 0.5 * self._distances(pose, limb, centres, W)
            share = half == half.min() if self.sharp else np.exp(half.min() - half)
            mean[limb] = share @ centres / share.sum()
            whitening[np.ix_(limb - 3, limb)] = W
        return GaussianPrior(mean, whitening)

    def energy(self, pose: np.ndarray) -> float:
        """Twice the negative logarithm of the mixture at a pose (J, 3), up to a constant."""
        total = 0.0
        for limb, centres, W in zip(self.limbs, self.centres, self.whitenings, strict=True):
            squared = self._distances(pose, limb, centres, W)
            low = squared.min()
            total += low if self.sharp else low - 2 * np.log(np.exp(0.5 * (low - squared)).mean())
        return float(total)

    @staticmethod
    def _distances(pose: np.ndarray, limb: np.ndarray, centres: np.ndarray, W: np.ndarray) -> np.ndarray:
        return (((pose.ravel()[limb] - centres) @ W.T)**2).sum(axis=1)


@dataclass(frozen=True, eq=False)
class JointLimits:
    """How far joints were seen to turn, and a margin."""

    low: np.ndarray
    high: np.ndarray
    give: float = GIVE      # radians, overrun that costs as much as one standard deviation


def choose_prior(kind: PosePrior, mean: np.ndarray, covariance: np.ndarray, examples: np.ndarray,
                 parents: np.ndarray, shrinkage: float = 0.3) -> GaussianPrior | MixturePrior:
    """The prior of that kind; a model that keeps no examples (M < 2, an older file) has the Gaussian."""
    if kind not in ("gaussian", "mixture", "nearest"):
        raise ValueError(f"pose_prior: expected gaussian, mixture or nearest, got {kind!r}")
    if kind == "gaussian" or len(examples) < 2:
        return gaussian_prior(mean, covariance, shrinkage)
    return mixture_prior(examples, parents, shrinkage, sharp=kind == "nearest")


def mixture_prior(examples: np.ndarray, parents: np.ndarray, shrinkage: float = 0.3, width: float = WIDTH,
                  floor: float = 0.05, sharp: bool = False) -> MixturePrior:
    """The mixture around training poses.

    `examples` (M, J, 3), radians, at least 2; `parents` (J,) int; `width` float in (0, 1].
    """
    examples = np.asarray(examples, dtype=np.float64)
    if examples.ndim != 3 or len(examples) < 2 or not np.isfinite(examples).all():
        raise ValueError(f"examples: expected at least 2 finite poses (M, J, 3), got shape {examples.shape}")
    if not 0 < width <= 1:
        raise ValueError(f"width: expected more than 0 and at most 1, got {width}")
    flat = examples.reshape(len(examples), -1)
    mean, spread = flat.mean(axis=0), np.cov(flat.T)
    limbs = tuple((3 * np.array(parts)[:, None] + np.arange(3)).ravel() for parts in unbranched(parents))
    pull = np.sqrt(1 - width**2)
    centres = tuple(mean[limb] + pull * (flat[:, limb] - mean[limb]) for limb in limbs)
    whitenings = []
    for limb in limbs:
        inner = spread[np.ix_(limb, limb)]
        safe = (1 - shrinkage) * inner + np.diag(shrinkage * np.diag(inner) + floor**2)
        whitenings.append(np.linalg.inv(np.linalg.cholesky(width**2 * safe)))
    return MixturePrior(limbs, centres, tuple(whitenings), flat.shape[1], sharp)


def unbranched(parents: np.ndarray) -> list[list[int]]:
    """The limbs of a tree of parts: longest runs without a branch, the root in none."""
    children = [np.flatnonzero(np.asarray(parents) == j) for j in range(len(parents))]
    runs = []
    for j in range(1, len(parents)):
        if parents[j] != 0 and len(children[parents[j]]) == 1:
            continue
        run = [j]
        while len(children[run[-1]]) == 1:
            run.append(int(children[run[-1]][0]))
        runs.append(run)
    return runs


def joint_limits(examples: np.ndarray, margin: float = MARGIN, give: float = GIVE) -> JointLimits:
    """Limits from training poses (M, J, 3), radians, wider by a margin; without examples there are none."""
    high = np.full(3 * examples.shape[1], np.inf)
    low = -high
    if len(examples):
        flat = examples.reshape(len(examples), -1)[:, 3:]
        low[3:], high[3:] = flat.min(axis=0) - margin, flat.max(axis=0) + margin
    return JointLimits(low, high, give)


def gaussian_prior(mean: np.ndarray, covariance: np.ndarray, shrinkage: float = 0.3, floor: float = 0.05
                   ) -> GaussianPrior:
    """The prior from moments of a few training poses, made safe to invert and to extrapolate with.

    `mean` (J, 3), radians; `covariance` (3J, 3J), the rows of the root are not used; `floor` radians, standard
    deviation added to every angle.
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

    `mean` (J, 3), radians; `covariance` (3J, 3J).
    Returns (1 + 2 axes, J, 3), radians, The root is not turned.
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
