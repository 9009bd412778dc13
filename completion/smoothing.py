"""Temporal smoothness: frames coupled by small accelerations; unknowns are pose (3J) and trans (3)."""
from __future__ import annotations

from collections.abc import Callable

import numpy as np

from scanprep.geometry.least_squares import retract_pose, step_between
from scanprep.geometry.sparse import overlapping_windows, solve_smooth

WINDOW, OVERLAP = 880, 60           # frames solved at once, and frames shared with each neighbouring window


def inertia(n_unknowns: int, rate: float, angle: float, place: float) -> np.ndarray:
    """Compute the information (P,) of the change of velocity per frame, from accelerations per second squared."""
    sd = np.full(n_unknowns, angle)
    sd[-3:] = place
    return (rate**2 / sd)**2


def predict(x: np.ndarray, before: np.ndarray, momentum: float) -> np.ndarray:
    """Predict the unknowns (P,) of the next frame from the last two, keeping a share of the velocity."""
    n = len(x) - 3
    return retract_pose(n)(x, momentum * step_between(before, x, n))


def solve_coupled_steps(x: np.ndarray, equations: Callable[[slice], tuple[np.ndarray, np.ndarray]],
                        stiffness: np.ndarray
                        ) -> np.ndarray:
    """Solve for the step (T, P) of frames x (T, P), at least 3, with constant velocity as a prior.

    Parameters
    ----------
    x : (T, P) float
        Unknowns of all frames.
    equations : callable
        Returns, for a slice of frames, half the gradient (n, P), which is overwritten, and the Gauss-Newton matrix
        (n, P, P) of all other terms, by small rotations of the joints from the right.
    stiffness : (P,) float
        Weight of the smoothness, as from `inertia`.

    Returns
    -------
    (T, P) float
        Velocities are differences of the unknowns, which is exact for slow motion.
    """
    step = np.empty_like(x)
    for near, kept, where in overlapping_windows(len(x), WINDOW, OVERLAP):
        window, (half_gradient, hessian) = x[near], equations(near)
        acceleration = np.diff(step_between(window[:-1], window[1:], x.shape[1] - 3), axis=0)
        # gradient of the squared second difference: each acceleration involves three frames
        for i, weight in enumerate((1.0, -2.0, 1.0)):
            half_gradient[i:len(window) - 2 + i] += weight * stiffness * acceleration
        step[where] = -solve_smooth(hessian, stiffness, half_gradient)[kept]
    return step


def smooth_frames(x: np.ndarray, gradient: np.ndarray, hessian: np.ndarray, stiffness: np.ndarray,
                  rounds: int) -> np.ndarray:
    """Smooth all frames (T, P) by some rounds of `solve_coupled_steps`.

    The data of each frame count as a quadratic about its own optimum x: its gradient and its Gauss-Newton matrix. So
    the frames themselves are not needed any more.
    """
    smoothed, n = x, x.shape[1] - 3
    for _ in range(rounds if len(x) > 2 else 0):
        data_gradient = gradient + (hessian @ step_between(x, smoothed, n)[..., None])[..., 0]

        def equations(near: slice, data_gradient: np.ndarray = data_gradient) -> tuple[np.ndarray, np.ndarray]:
            """Return gradient and matrix of some frames."""
            return data_gradient[near].copy(), hessian[near]

        smoothed = retract_pose(n)(smoothed, solve_coupled_steps(smoothed, equations, stiffness))
    return smoothed
