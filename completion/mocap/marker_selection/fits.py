"""The model fitted to whole bodies, or to some of their points: many bodies at once."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from model.body import BodyModel
from model.priors import gaussian_prior
from scanprep.geometry import rotations
from scanprep.geometry.least_squares import Dense, levenberg_marquardt

from .points import BodyPoints
from .settings import DesignConfig

Tell = Callable[[int], None]
TOGETHER = 24                        # bodies that are minimised at once
LOOSE = 1.0                          # metre and radian: how far the place of a body is known beforehand


@dataclass(frozen=True, eq=False)
class Prior:
    """What is known of the unknowns x of a body before it is measured: a Gaussian.

    Attributes
    ----------
    precision : (P, P) float
    mean : (Z, P) float
        One for each body: its root and its place are known to a radian and a metre, loosely enough to say nothing
        once there are three markers.
    """

    precision: np.ndarray
    mean: np.ndarray

    def system(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Energy (Z,) and half its gradient (Z, P) at x (Z, P)."""
        slope = (x - self.mean) @ self.precision
        return ((x - self.mean) * slope).sum(axis=1), slope

    def of(self, some: slice) -> Prior:
        """That of some of the bodies."""
        return Prior(self.precision, self.mean[some])


def prior_around(model: BodyModel, x: np.ndarray, config: DesignConfig) -> Prior:
    """The prior of bodies that stand and face about as at x (Z, P).

    [MoSh] Eq. 20
    [MoSh] Eq. 21
    """
    poses = gaussian_prior(model.pose_mean, model.pose_covariance, config.prior_shrinkage)
    n, P = len(poses.mean), x.shape[1]
    precision = np.zeros((P, P))
    precision[:n, :n] = config.prior_weight * poses.whitening.T @ poses.whitening
    place = np.r_[:3, n:n + 3]
    precision[place, place] += LOOSE**-2
    precision[np.arange(n + 3, P), np.arange(n + 3, P)] = config.shape_weight
    mean = np.zeros_like(x)
    mean[:, :n] = poses.mean
    mean[:, place] = x[:, place]
    return Prior(precision, mean)


def fit_points(points: BodyPoints, targets: np.ndarray, weights: np.ndarray, prior: Prior, start: np.ndarray,
               iterations: int, tell: Tell | None = None) -> np.ndarray:
    """Unknowns (Z, P) with which the points come nearest to their targets, by Levenberg-Marquardt.

    Parameters
    ----------
    targets : (Z, L, 3) float, metres
    weights : (L,) float
        Factor on the squared distance.
    start : (Z, P) float

    [MoSh] Eq. 26
    """
    root, found = np.sqrt(weights)[:, None], np.empty_like(start)
    size = min(TOGETHER, points.batch)
    for begin in range(0, len(start), size):
        some = slice(begin, begin + size)
        goal, known = targets[some], prior.of(some)

        def system(x: np.ndarray, goal: np.ndarray = goal, known: Prior = known) -> Dense:
            at = points.follow(x)
            residual = (root * (at.positions - goal)).reshape(len(x), -1, 1)
            J = (root[..., None] * at.jacobian).reshape(len(x), -1, x.shape[1])
            transposed = np.swapaxes(J, -1, -2)
            energy, slope = known.system(x)
            return Dense((residual**2).sum(axis=(1, 2)) + energy, (transposed @ residual)[..., 0] + slope,
                         transposed @ J + known.precision)

        found[some] = levenberg_marquardt(system, start[some], iterations, 1e-4).x
        if tell is not None:
            tell(min(begin + size, len(start)))
    return found


def rough_poses(model: BodyModel, bodies: np.ndarray, n_betas: int) -> np.ndarray:
    """Unknowns (Z, 3J + 3 + K) of the mean person whose parts are turned as those of bodies (Z, N, 3)."""
    J = len(model.skeleton.parents)
    rest = model.template.with_vertices(model.vertices(np.zeros((J, 3)), np.zeros(n_betas)))
    ring, share = model.skeleton.joint_weights(model.template, 0)
    x = np.zeros((len(bodies), 3 * J + 3 + n_betas))
    for i, body in enumerate(bodies):
        pose = model.skeleton.pose_of(model.skeleton.fit_rotations(rest, body))
        x[i, :3 * J] = rotations.log(rotations.exp(pose)).ravel()
        x[i, 3 * J:3 * J + 3] = share @ body[ring] - model.skeleton.joints[0]
    return x


def vertex_errors(model: BodyModel, x: np.ndarray, bodies: np.ndarray) -> np.ndarray:
    """(Z,) mean squared distance, square metres, of all vertices of the bodies at x (Z, P) from the given ones."""
    n = 3 * len(model.skeleton.parents)
    out = np.empty(len(x))
    for i, (row, body) in enumerate(zip(x, bodies, strict=True)):
        y = model.vertices(row[:n].reshape(-1, 3), row[n + 3:], row[n:n + 3])
        out[i] = ((y - body)**2).sum(axis=1).mean()
    return out
