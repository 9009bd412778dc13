"""A whole sequence at once: all frames coupled by smoothness, one banded system a round."""
from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import solveh_banded

from scanprep.geometry import rotations

from .. import energy
from ..solve import normal_equations

if TYPE_CHECKING:
    from .follow import MarkerFollower


WINDOW, OVERLAP = 1000, 60           # frames solved at once, and those that each side lends to its neighbour


def smooth_sequence(follower: MarkerFollower, x: np.ndarray) -> np.ndarray:
    """One Gauss-Newton step on all frames (T, P) with constant velocity between them as prior.

    Unknowns are small turns of every joint from the right, `exp(pose) exp(d)`, so that nothing happens at a
    half turn; velocities are taken as differences of these, which is exact for slow motion. Long sequences
    are solved in windows that overlap by more than a frame's influence reaches.
    """
    T = len(x)
    if T < 3:
        return x
    step = np.empty_like(x)
    for start in range(0, T, WINDOW):
        first, last = max(0, min(start - OVERLAP, T - 3)), min(T, start + WINDOW + OVERLAP)
        kept = slice(start - first, min(start + WINDOW, T) - first)
        step[start:start + WINDOW] = _window_step(follower, x[first:last], np.arange(first, last))[kept]
    pose = rotations.exp(x[:, :-3].reshape(T, -1, 3)) @ rotations.exp(step[:, :-3].reshape(T, -1, 3))
    return np.concatenate([rotations.log(pose).reshape(T, -1), x[:, -3:] + step[:, -3:]], axis=1)


def _window_step(follower: MarkerFollower, x: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """The step (T, P) in small turns for the unknowns (T, P) of some frames that follow each other."""
    T, P = x.shape
    local = _local(x)
    gradient, hessian = np.empty((T, P)), np.empty((T, P, P))
    positions = follower.positions(x)
    for i, t in enumerate(frames):
        weights = follower.weights(t, positions[i])
        at = x[i][None]
        terms = [energy.point_to_point(follower.follow(at), follower.targets[t], weights),
                 energy.pose_prior(at, follower.prior, follower.config.prior_weight)]
        _, g, H = normal_equations(terms)
        gradient[i], hessian[i] = local[i].T @ g[0], local[i].T @ H[0] @ local[i]
    bend = _second_differences(x)
    D = np.array([1.0, -2.0, 1.0])
    band = np.zeros((3, T, P))                       # of a frame with itself, the next and the one after
    for i in range(3):
        gradient[i:T - 2 + i] += D[i] * follower.inertia * bend
        for j in range(i, 3):
            band[j - i, i:T - 2 + i] += D[i] * D[j] * follower.inertia
    return -_solve_banded(hessian, band, gradient)


def _local(x: np.ndarray) -> np.ndarray:
    """(T, P, P) derivative of the unknowns by small turns from the right."""
    T, P = x.shape
    out = np.zeros((T, P, P))
    inverse = rotations.inverse_right_jacobian(x[:, :-3].reshape(T, -1, 3))
    for j in range(inverse.shape[1]):
        out[:, 3 * j:3 * j + 3, 3 * j:3 * j + 3] = inverse[:, j]
    out[:, -3:, -3:] = np.eye(3)
    return out


def _second_differences(x: np.ndarray) -> np.ndarray:
    """(T-2, P) change of the velocity of every joint and of the place."""
    R = rotations.exp(x[:, :-3].reshape(len(x), -1, 3))
    turn = rotations.log(np.swapaxes(R[:-1], -1, -2) @ R[1:]).reshape(len(x) - 1, -1)
    velocity = np.concatenate([turn, np.diff(x[:, -3:], axis=0)], axis=1)
    return np.diff(velocity, axis=0)


def _solve_banded(hessian: np.ndarray, band: np.ndarray, rhs: np.ndarray) -> np.ndarray:
    """Solve the block system: dense blocks (T, P, P) on the diagonal, diagonal blocks beside it."""
    T, P = rhs.shape
    lower = np.zeros((2 * P + 1, T * P))
    for k in range(P):                               # entries k below the diagonal, inside the blocks
        inside = np.einsum("tii->ti", hessian[:, k:, :P - k])
        lower[k].reshape(T, P)[:, :P - k] = inside
    for hop in range(3):
        lower[hop * P].reshape(T, P)[:] += band[hop]
    lower[0] += 1e-9 * lower[0].max()
    return solveh_banded(lower, rhs.ravel(), lower=True).reshape(T, P)
