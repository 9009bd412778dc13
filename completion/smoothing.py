"""Frames that follow each other, coupled by how little a body accelerates; unknowns are pose (3J) and trans (3)."""
from __future__ import annotations

from collections.abc import Callable

import numpy as np

from scanprep.geometry.least_squares import retract_pose, step_between
from scanprep.geometry.sparse import overlapping_windows, solve_smooth

WINDOW, OVERLAP = 880, 60           # frames solved at once, and those that each side lends to its neighbour


def inertia(n_unknowns: int, rate: float, angle: float, place: float) -> np.ndarray:
    """Information (P,) of the change of velocity from frame to frame, from accelerations per second squared."""
    sd = np.full(n_unknowns, angle)
    sd[-3:] = place
    return (rate**2 / sd)**2


def predict(x: np.ndarray, before: np.ndarray, momentum: float) -> np.ndarray:
    """Unknowns (P,) of the next frame from those of the last two, by the share of the velocity that is kept."""
    n = len(x) - 3
    return retract_pose(n)(x, momentum * step_between(before, x, n))


def solve_coupled_steps(x: np.ndarray, equations: Callable[[slice], tuple[np.ndarray, np.ndarray]],
                        stiffness: np.ndarray
                        ) -> np.ndarray:
    """The step (T, P) of frames x (T, P), at least 3, constant velocity as a prior with `inertia` as its stiffness.

    Of everything else come half the gradient (n, P), which is used up, and the Gauss-Newton matrix (n, P, P) of some
    frames at a time, by small rotations of the joints from the right. Velocities are differences of these, which is
    exact for slow motion.
    """
    step = np.empty_like(x)
    for near, kept, where in overlapping_windows(len(x), WINDOW, OVERLAP):
        at, (pull, hessian) = x[near], equations(near)
        bend = np.diff(step_between(at[:-1], at[1:], x.shape[1] - 3), axis=0)
        for i, share in enumerate((1.0, -2.0, 1.0)):
            pull[i:len(at) - 2 + i] += share * stiffness * bend
        step[where] = -solve_smooth(hessian, stiffness, pull)[kept]
    return step


def smooth_frames(x: np.ndarray, gradient: np.ndarray, hessian: np.ndarray, stiffness: np.ndarray,
                  rounds: int) -> np.ndarray:
    """Smooth all frames (T, P) by some rounds of `solve_coupled_steps`, the data of each frame as a quadratic.

    Frames are no longer needed: near its own optimum x a frame is its gradient and its Gauss-Newton matrix.
    """
    at, n = x, x.shape[1] - 3
    for _ in range(rounds if len(x) > 2 else 0):
        slope = gradient + (hessian @ step_between(x, at, n)[..., None])[..., 0]

        def equations(near: slice, slope: np.ndarray = slope) -> tuple[np.ndarray, np.ndarray]:
            return slope[near].copy(), hessian[near]

        at = retract_pose(n)(at, solve_coupled_steps(at, equations, stiffness))
    return at
