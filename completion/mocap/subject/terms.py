"""The terms of the objective, one function each; distances in centimetres inside, so weights are those of the paper.

Unknowns that frames share are a row `z = (betas (K), coefficients of the latent markers (3 L))`, those of one frame
`x = (pose (3J), trans (3))`. A residual holds the square root of what is minimised.
"""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from model.priors import GaussianPrior
from scanprep.geometry.least_squares import Residual

from ... import energy
from ...energy import MovingPoints
from ..settings import Attachment
from .attachment import above_triangles, simulated

CENTIMETRES = 100.0                  # in a metre


@dataclass(frozen=True, eq=False)
class LatentPoints:
    """Points of the skin in the latent pose, which are affine in betas.

    Attributes
    ----------
    mean : (..., 3) float, metres
        Of the mean person.
    by_betas : (..., 3, K) float, metres
    """

    mean: np.ndarray
    by_betas: np.ndarray

    def at(self, betas: np.ndarray) -> np.ndarray:
        """Their places (..., 3) for betas (K,)."""
        return self.mean + self.by_betas @ betas

    def moving(self, z: np.ndarray) -> MovingPoints:
        """The same for unknowns z (P,), with derivatives by all of them."""
        K = self.by_betas.shape[-1]
        rest = np.zeros((*self.mean.shape, len(z) - K))
        return MovingPoints(self.at(z[:K]), np.concatenate([self.by_betas, rest], axis=-1))

    def combined(self, ids: np.ndarray, weights: np.ndarray) -> LatentPoints:
        """Combinations of some of them, ids and weights (n, k)."""
        return LatentPoints(np.einsum("lk,lkd->ld", weights, self.mean[ids]),
                            np.einsum("lk,lkdb->ldb", weights, self.by_betas[ids]))


def latent_places(kind: Attachment, supports: LatentPoints, z: np.ndarray) -> MovingPoints:
    """The latent markers (L) in the latent coordinate system, from their 3 L supports.

    [MoSh] Eq. 16
    """
    K = supports.by_betas.shape[-1]
    points, frame = simulated(kind, supports.moving(z), z[K:].reshape(-1, 3))
    points.jacobian[..., K:] += each_own(frame)
    return points


def each_own(frame: np.ndarray) -> np.ndarray:
    """Derivatives (..., L, 3, 3) of every marker by its own coefficients as those by all of them, (..., L, 3, 3L)."""
    L = frame.shape[-3]
    out = np.zeros((*frame.shape[:-1], L, 3))
    i = np.arange(L)
    np.moveaxis(out, (-4, -2), (0, 1))[i, i] = np.moveaxis(frame, -3, 0)
    return out.reshape(*frame.shape[:-1], 3 * L)


def data(points: MovingPoints, targets: np.ndarray, weights: np.ndarray) -> Residual:
    """Simulated markers against observed ones; what was not seen (NaN) counts nothing.

    Parameters
    ----------
    points : L points
    targets : (..., L, 3) float, metres
    weights : (..., L) float, per square centimetre

    [MoSh] Eq. 17
    """
    return energy.point_to_point(points, targets, CENTIMETRES**2 * weights)


def surface(markers: MovingPoints, corners: MovingPoints, distances: np.ndarray, weights: np.ndarray) -> Residual:
    """Latent markers at their prescribed distance from the skin.

    Parameters
    ----------
    markers : L points
        In the latent coordinate system.
    corners : 3 L points
        Of the triangle that is nearest to each.
    distances : (L,) float, metres
    weights : (L,) float, per square centimetre

    [MoSh] Eq. 18
    """
    L, P = len(distances), markers.jacobian.shape[-1]
    r, by_point, by_corners = above_triangles(markers.positions, corners.positions.reshape(L, 3, 3))
    J = (by_point[:, None] @ markers.jacobian)[:, 0] + \
        (by_corners.reshape(L, 1, 9) @ corners.jacobian.reshape(L, 9, P))[:, 0]
    root = CENTIMETRES * np.sqrt(weights)
    return Residual(root * (r - distances), root[:, None] * J)


def usual_place(markers: MovingPoints, usual: MovingPoints, weights: np.ndarray) -> Residual:
    """Latent markers near their usual place on this body.

    Parameters
    ----------
    markers, usual : L points
        In the latent coordinate system.
    weights : (L,) float, per square centimetre

    [MoSh] Eq. 19
    """
    root = CENTIMETRES * np.sqrt(weights)[:, None]
    r = root * (markers.positions - usual.positions)
    J = root[..., None] * (markers.jacobian - usual.jacobian)
    return Residual(r.ravel(), J.reshape(-1, J.shape[-1]))


def shape(z: np.ndarray, n_betas: int, weight: float) -> Residual:
    """Squared Mahalanobis distance of the betas, standard deviations, from the mean person.

    [MoSh] Eq. 20
    """
    found = energy.shape_prior(z[..., :n_betas], 0, weight)
    J = np.zeros((*found.values.shape, z.shape[-1]))
    J[..., :n_betas] = found.jacobian
    return Residual(found.values, J)


def pose(x: np.ndarray, prior: GaussianPrior, weight: float) -> Residual:
    """Squared Mahalanobis distance of the pose from the training poses; the root is free.

    [MoSh] Eq. 21
    """
    return energy.pose_prior(x, prior, weight)


def velocity(x: np.ndarray, n_angles: int, weight: float) -> Residual:
    """Change of the joints' velocities from frame to frame; unknowns are the rows (..., T, P) one after the other.

    Parameters
    ----------
    x : (..., T, P) float
    n_angles : int
        How many of the P are joint angles, the first.
    weight : float, per square radian

    [MoSh] Eq. 22
    """
    T, P = x.shape[-2:]
    second = np.eye(T - 2, T) - 2 * np.eye(T - 2, T, 1) + np.eye(T - 2, T, 2)
    root = np.sqrt(weight)
    r = root * (second @ x[..., :n_angles])
    J = root * np.einsum("st,ap->satp", second, np.eye(n_angles, P)).reshape(-1, T * P)
    return Residual(r.reshape(*x.shape[:-2], -1), np.broadcast_to(J, (*x.shape[:-2], *J.shape)))
