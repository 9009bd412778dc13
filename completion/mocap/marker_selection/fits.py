"""Fit the model to many bodies at once: to their whole surface, or to some of their points."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from model.bilinear import ShapedPoints
from model.body import BodyModel
from model.fitting.energy import MovingPoints, moving_points
from model.linear import combination_weights
from model.priors import gaussian_prior
from scanprep.geometry import rotations
from scanprep.geometry.least_squares import Dense, levenberg_marquardt
from scanprep.ranges import FLAG, Count, Positive, Settings


@dataclass(frozen=True)
class DesignConfig(Settings):
    """Settings of `design_markers`.

    [MoSh] Eq. 26 has no prior, so it is undetermined with fewer markers than a third of the unknowns. Here priors hold
    betas near the mean person and poses near usual ones, balanced by `marker_sd`.

    Attributes
    ----------
    count : int
        Number of markers of the set.
    through : ints
        Further counts at which the curve must have a set of exactly that size; pairs change it by two.
    poses : int
        Number of poses of the model's training set into which `scape layout design` puts each body; 0 keeps the bodies
        as they are.
    marker_sd : float, metres
        Standard deviation of a marker from its simulated place.
    """

    count: Annotated[Count, FLAG] = 47
    through: tuple[Count, ...] = ()
    poses: int = 0
    marker_sd: Positive = 0.005


class BodyPoints:
    """Surface points as a function of unknowns x = (pose (3J), trans (3), betas (K)) of a batch of bodies."""

    def __init__(self, shaped: ShapedPoints) -> None:
        self.shaped = shaped
        self.n_betas, self.count = shaped.n_betas, shaped.count
        self.n_angles = 3 * len(shaped.skeleton.parents)
        self.n_unknowns = self.n_angles + 3 + self.n_betas

    def some(self, chosen: np.ndarray) -> BodyPoints:
        """Return some of the points."""
        return BodyPoints(self.shaped.combine(combination_weights(self.count, np.arange(self.count)[chosen], None)))

    @property
    def batch(self) -> int:
        """Bodies whose derivatives are in memory at once: 2**25 numbers, 256 MB."""
        return max(1, 2**25 // max(1, 3 * self.count * (self.n_unknowns + self.shaped.load)))

    def _split(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Split unknowns (B, P) into poses, places and betas."""
        n = self.n_angles
        return x[:, :n].reshape(len(x), -1, 3), x[:, n:n + 3], x[:, n + 3:]

    def positions(self, x: np.ndarray) -> np.ndarray:
        """Compute points (B, L, 3), metres, for unknowns (B, P)."""
        out = np.empty((len(x), self.count, 3))
        for start in range(0, len(x), self.batch):
            pose, trans, betas = self._split(x[start:start + self.batch])
            for i, own in enumerate(betas):
                out[start + i] = self.shaped.operator(own).evaluate(pose[i], trans[i])
        return out

    def follow(self, x: np.ndarray) -> MovingPoints:
        """Compute the points with their derivatives by the unknowns (B, P); keep B small."""
        pose, trans, betas = self._split(x)
        found = [self.shaped.operator(own).columns(p, t) for own, p, t in zip(betas, pose, trans, strict=True)]
        by_pose = np.swapaxes(np.stack([columns for _, columns in found]), 1, 3)
        return moving_points(np.stack([y for y, _ in found]), by_pose, self.shaped.shape_jacobian(pose))


@dataclass(frozen=True, eq=False)
class Prior:
    """Gaussian prior of the unknowns x of a body."""

    precision: np.ndarray            # (P, P) float
    # (Z, P) float, one for each body: root and place have a standard deviation of a radian and a metre, so loose that
    # they do not matter with three markers
    mean: np.ndarray

    def system(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute the energy (Z,) and half its gradient (Z, P) at x (Z, P)."""
        slope = (x - self.mean) @ self.precision
        return ((x - self.mean) * slope).sum(axis=1), slope

    def of(self, some: slice) -> Prior:
        """Return the prior of some of the bodies."""
        return Prior(self.precision, self.mean[some])


def prior_around(model: BodyModel, x: np.ndarray) -> Prior:
    """Build the prior of bodies with place and orientation near those of x (Z, P). [MoSh] Eq. 20, Eq. 21"""
    poses = gaussian_prior(model.pose_mean, model.pose_covariance)
    n, P = len(poses.mean), x.shape[1]
    precision = np.zeros((P, P))
    precision[:n, :n] = poses.whitening.T @ poses.whitening
    place = np.r_[:3, n:n + 3]
    precision[place, place] += 1.0                       # standard deviations of a metre and a radian
    precision[np.arange(n + 3, P), np.arange(n + 3, P)] = 1.0
    mean = np.zeros_like(x)
    mean[:, :n] = poses.mean
    mean[:, place] = x[:, place]
    return Prior(precision, mean)


def fit_points(points: BodyPoints, targets: np.ndarray, weights: np.ndarray, prior: Prior, start: np.ndarray,
               iterations: int, report_progress: Callable[[int], None] | None = None) -> np.ndarray:
    """Fit unknowns (Z, P) to targets (Z, L, 3), metres, with weights (L,). [MoSh] Eq. 26"""
    root, solution = np.sqrt(weights)[:, None], np.empty_like(start)
    size = min(24, points.batch)  # bodies that are fitted at once
    for begin in range(0, len(start), size):
        some = slice(begin, begin + size)
        goal, prior_of_batch = targets[some], prior.of(some)

        def system(x: np.ndarray, goal: np.ndarray = goal, prior_of_batch: Prior = prior_of_batch) -> Dense:
            at = points.follow(x)
            residual = (root * (at.positions - goal)).reshape(len(x), -1, 1)
            J = (root[..., None] * at.jacobian).reshape(len(x), -1, x.shape[1])
            transposed = np.swapaxes(J, -1, -2)
            energy, slope = prior_of_batch.system(x)
            return Dense((residual**2).sum(axis=(1, 2)) + energy, (transposed @ residual)[..., 0] + slope,
                         transposed @ J + prior_of_batch.precision)

        solution[some] = levenberg_marquardt(system, start[some], iterations, 1e-4, angles=points.n_angles).x
        if report_progress is not None:
            report_progress(min(begin + size, len(start)))
    return solution


def rough_poses(model: BodyModel, bodies: np.ndarray, n_betas: int) -> np.ndarray:
    """Initialise unknowns (Z, 3J + 3 + K): the mean person with the rotations of the parts of bodies (Z, N, 3)."""
    J = len(model.skeleton.parents)
    rest = model.template.with_vertices(model.vertices(np.zeros((J, 3)), np.zeros(n_betas)))
    root = model.joint_regressor[[0]]
    x = np.zeros((len(bodies), 3 * J + 3 + n_betas))
    for i, body in enumerate(bodies):
        pose = model.skeleton.pose_of(model.skeleton.fit_rotations(rest, body))
        x[i, :3 * J] = rotations.log(rotations.exp(pose)).ravel()
        x[i, 3 * J:3 * J + 3] = (root @ body)[0] - model.skeleton.joints[0]
    return x


def vertex_errors(model: BodyModel, x: np.ndarray, bodies: np.ndarray) -> np.ndarray:
    """Compute the mean squared distance (Z,), square metres, of all vertices at x (Z, P) from those of the bodies."""
    n = 3 * len(model.skeleton.parents)
    out = np.empty(len(x))
    for i, (row, body) in enumerate(zip(x, bodies, strict=True)):
        y = model.vertices(row[:n].reshape(-1, 3), row[n + 3:], row[n:n + 3])
        out[i] = ((y - body)**2).sum(axis=1).mean()
    return out
