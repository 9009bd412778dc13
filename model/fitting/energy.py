"""Residuals of completion and animation: one function for each energy, with its Jacobian.

The unknowns of one body are a row `x = (pose (3J), trans (3), betas (K))`. All functions take any number of leading
dimensions, so a batch of starts or frames is one call. The energy is the sum of the squared residuals.
"""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanprep.geometry import rotations
from scanprep.geometry.least_squares import Residual

from ..priors import GaussianPrior


@dataclass(frozen=True, eq=False)
class MovingPoints:
    """Points that move with a body."""

    positions: np.ndarray   # (..., L, 3), metres
    jacobian: np.ndarray    # (..., L, 3, P), with respect to the unknowns x

    def __getitem__(self, some: slice) -> MovingPoints:
        """Some of the points."""
        return MovingPoints(self.positions[..., some, :], self.jacobian[..., some, :, :])


def moving_points(positions: np.ndarray, d_pose: np.ndarray, d_betas: np.ndarray | None = None) -> MovingPoints:
    """Join the derivatives with respect to pose, trans (the identity) and betas.

    `positions` (..., L, 3), metres; `d_pose` (..., L, 3, 3J); `d_betas` (..., L, 3, K).
    """
    blocks = [d_pose, np.broadcast_to(np.eye(3), (*positions.shape, 3))]
    if d_betas is not None:
        blocks.append(np.broadcast_to(d_betas, (*positions.shape, d_betas.shape[-1])))
    return MovingPoints(positions, np.concatenate(blocks, axis=-1))


def above_skin(supports: MovingPoints, distance: np.ndarray) -> MovingPoints:
    """Compute points at a distance (L,), metres, from the skin, along normals that move with the body.

    Three supports (..., 3L, 3) span the skin below each point.
    """
    p = supports.positions.reshape(*supports.positions.shape[:-2], -1, 3, 3)
    J = supports.jacobian.reshape(*p.shape, -1)
    u, v = p[..., 1, :] - p[..., 0, :], p[..., 2, :] - p[..., 0, :]
    du, dv = J[..., 1, :, :] - J[..., 0, :, :], J[..., 2, :, :] - J[..., 0, :, :]
    # unit normal n = c / |c|, and its derivative (I - n nᵀ) / |c| dc
    c = np.cross(u, v)
    length = np.linalg.norm(c, axis=-1)[..., None]
    n = c / length
    tangent = (np.eye(3) - n[..., :, None] * n[..., None, :]) / length[..., None]
    dc = rotations.hat(u) @ dv - rotations.hat(v) @ du
    lift = distance[:, None]
    return MovingPoints(p[..., 0, :] + lift * n, J[..., 0, :, :] + lift[..., None] * (tangent @ dc))


def rise_above_skin(supports: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Compute only the positions (..., L, 3) of `above_skin`, from supports (..., 3L, 3), metres."""
    p = supports.reshape(*supports.shape[:-2], -1, 3, 3)
    c = np.cross(p[..., 1, :] - p[..., 0, :], p[..., 2, :] - p[..., 0, :])
    return p[..., 0, :] + distance[:, None] * c / np.linalg.norm(c, axis=-1, keepdims=True)


def point_to_point(points: MovingPoints, targets: np.ndarray, weights: np.ndarray) -> Residual:
    """Compute residuals of points from their targets; a target of NaN (not seen) does not count.

    `targets` (..., L, 3), metres; `weights` (..., L), factor on the squared distance.
    """
    missing = np.isnan(targets).any(axis=-1)
    root = np.where(missing, 0.0, np.sqrt(weights))[..., None]
    r = root * np.where(missing[..., None], 0.0, points.positions - targets)
    J = root[..., None] * points.jacobian
    return Residual(r.reshape(*r.shape[:-2], -1), J.reshape(*J.shape[:-3], -1, J.shape[-1]))


def pose_prior_term(x: np.ndarray, prior: GaussianPrior, weight: float | np.ndarray = 1.0) -> Residual:
    """Compute residuals of the Gaussian pose prior: Mahalanobis distance from the training poses; the root is free.

    [SCAPE] §9
    """
    count = len(prior.mean)
    root = np.sqrt(weight) * np.ones(x.shape[:-1])
    r = root[..., None] * ((x[..., :count] - prior.mean) @ prior.whitening.T)
    J = np.zeros((*r.shape, x.shape[-1]))
    J[..., :count] = root[..., None, None] * prior.whitening
    return Residual(r, J)


def upright_term(x: np.ndarray, of_body: np.ndarray, up: np.ndarray, sd: float) -> Residual:
    """Compute residuals of the lean of the root's axis `of_body` (3,) from direction `up` (..., 3), in units of `sd`.
    """
    R = rotations.exp(x[..., :3])
    axis = R @ of_body
    J = np.zeros((*axis.shape, x.shape[-1]))
    J[..., :3] = -rotations.hat(axis) @ R @ rotations.right_jacobian(x[..., :3]) / sd
    return Residual((axis - up) / sd, J)


def shape_prior(x: np.ndarray, first: int, weight: float = 1.0) -> Residual:
    """Compute residuals of the unit Gaussian shape prior; the betas stand in x from `first` on."""
    r = np.sqrt(weight) * x[..., first:]
    J = np.zeros((*r.shape, x.shape[-1]))
    J[..., first:] = np.sqrt(weight) * np.eye(x.shape[-1] - first)
    return Residual(r, J)


def stay_near(x: np.ndarray, expected: np.ndarray, weights: np.ndarray) -> Residual:
    """Compute residuals of the unknowns (..., P) from expected values, with weights (P,).

    With the joint angles of the previous iteration as expectation this is the paper's damping w_T |t_a - t_b|². To
    first order the twists of neighbouring parts differ by the rotation of their joint.

    [SCAPE] Eq. 11
    """
    root = np.sqrt(weights)
    return Residual(root * (x - expected), np.broadcast_to(np.diag(root), (*x.shape, x.shape[-1])))


def geman_mcclure(distance: np.ndarray, scale: float) -> np.ndarray:
    """Compute Geman-McClure weights in (0, 1] of distances that may be outliers; a quarter at `scale`."""
    return (scale**2 / (scale**2 + distance**2))**2
