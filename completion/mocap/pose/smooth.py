"""A whole sequence at once: all frames coupled by smoothness, one banded system a round."""
from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import solveh_banded

from .marked_body import BATCH, MarkedBody

if TYPE_CHECKING:
    from .follow import MarkerFollower


WINDOW, OVERLAP = 1000, 60           # frames solved at once, and those that each side lends to its neighbour
FURTHEST = 0.5                       # radians or metres that a step may go


def smooth_sequence(follower: MarkerFollower, x: np.ndarray, frames: np.ndarray | None = None) -> np.ndarray:
    """One Gauss-Newton step on frames (T, P) that follow each other, with constant velocity as prior.

    Unknowns are small turns of every joint from the right, `exp(pose) exp(d)`, so that nothing happens at a
    half turn; velocities are taken as differences of these, which is exact for slow motion. Long sequences
    are solved in windows that overlap by more than a frame's influence reaches.

    Parameters
    ----------
    x : (T, P) float
    frames : (T,) int, optional
        Which frames of the sequence these are; else the first ones.
    """
    T = len(x)
    if T < 3:
        return x
    frames = np.arange(T) if frames is None else frames
    gradient, hessian = _measured(follower, x, frames)
    step = coupled_steps(follower.body, follower.inertia, x, gradient, hessian)
    longest = np.abs(step).max(axis=1, keepdims=True)
    return follower.body.retract(x, step * np.minimum(1, FURTHEST / np.maximum(longest, 1e-12)))


def coupled_steps(body: MarkedBody, inertia: np.ndarray, x: np.ndarray, gradient: np.ndarray, hessian: np.ndarray
                  ) -> np.ndarray:
    """The step (T, P) of frames that follow each other, T at least 3, window by window.

    Parameters
    ----------
    body : MarkedBody
    inertia : (P,) float
        Weight on the squared change of velocity.
    x : (T, P) float
    gradient, hessian : (T, P), (T, P, P) float
        Half the gradient and the Gauss-Newton matrix of everything but the change of velocity.
    """
    T, step = len(x), np.empty_like(x)
    for start in range(0, T, WINDOW):
        near = slice(max(0, min(start - OVERLAP, T - 3)), min(T, start + WINDOW + OVERLAP))
        kept = slice(start - near.start, min(start + WINDOW, T) - near.start)
        step[start:start + WINDOW] = _window_step(body, inertia, x[near], gradient[near], hessian[near])[kept]
    return step


def _measured(follower: MarkerFollower, x: np.ndarray, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Half the gradient (T, P) and Gauss-Newton matrix (T, P, P) of markers and pose prior, frame by frame."""
    T, P = x.shape
    gradient, hessian = np.empty((T, P)), np.empty((T, P, P))
    targets, weights = follower.taken(frames), follower.weights(frames, follower.positions(x))
    for start in range(0, T, BATCH):
        some = slice(start, start + BATCH)
        _, gradient[some], hessian[some] = follower.body.system(x[some], targets[some], weights[some])
        if follower.standing:
            _, pull, stiff = follower.standing.system(x[some], frames[some])
            gradient[some] += pull
            hessian[some] += stiff
    return gradient, hessian


def _window_step(body: MarkedBody, inertia: np.ndarray, x: np.ndarray, gradient: np.ndarray, hessian: np.ndarray
                 ) -> np.ndarray:
    """The step (T, P) in small turns for the unknowns (T, P) of some frames that follow each other."""
    T, P = x.shape
    gradient = gradient.copy()
    bend = np.diff(body.step_to(x[:-1], x[1:]), axis=0)
    D = np.array([1.0, -2.0, 1.0])
    band = np.zeros((3, T, P))                       # of a frame with itself, the next and the one after
    for i in range(3):
        gradient[i:T - 2 + i] += D[i] * inertia * bend
        for j in range(i, 3):
            band[j - i, i:T - 2 + i] += D[i] * D[j] * inertia
    return -solve_banded(hessian, band, gradient)


def solve_banded(hessian: np.ndarray, band: np.ndarray, rhs: np.ndarray) -> np.ndarray:
    """Solve the block system: dense blocks (T, P, P) on the diagonal, diagonal blocks beside it."""
    T, P = rhs.shape
    lower = np.zeros((2 * P + 1, T * P))
    for k in range(P):                               # entries k below the diagonal, inside the blocks
        inside = np.einsum("tii->ti", hessian[:, k:, :P - k])
        lower[k].reshape(T, P)[:, :P - k] = inside
    for hop in range(3):
        lower[hop * P].reshape(T, P)[:] += band[hop]
    lower[0] += 1e-9 * lower[0].max()
    return solveh_banded(lower, rhs.ravel(), overwrite_ab=True, lower=True, check_finite=False).reshape(T, P)
