"""How a body moves from frame to frame: prediction at constant velocity, and the sequence smoothed at the end."""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scanprep.geometry import rotations
from scanprep.geometry.sparse import overlapping_windows, solve_smooth

WINDOW, OVERLAP = 600, 60            # frames smoothed at once, and those that each side lends to its neighbour


def predicted(past: Sequence[np.ndarray], momentum: float) -> np.ndarray:
    """Unknowns (P,) of the next frame from those of one or two before, the nearest first.

    `past` (P,) each, pose (3J) and trans (3).
    """
    near = past[0].copy()
    turn = rotations.exp(near[:-3].reshape(-1, 3))
    if len(past) > 1:
        step = rotations.log(np.swapaxes(rotations.exp(past[1][:-3].reshape(-1, 3)), -1, -2) @ turn)
        turn = turn @ rotations.exp(momentum * step)
        near[-3:] += momentum * (near[-3:] - past[1][-3:])
    near[:-3] = rotations.log(turn).ravel()
    return near


def inertia(size: int, rate: float, angle: float, place: float) -> np.ndarray:
    """(P,) inverse variances of the change of velocity between frames, from accelerations per second squared."""
    sd = np.full(size, angle)
    sd[-3:] = place
    return (rate**2 / sd)**2


def smoothed(x: np.ndarray, gradient: np.ndarray, precision: np.ndarray, weights: np.ndarray, rounds: int
             ) -> np.ndarray:
    """All frames coupled by constant velocity, each with what its own data said as a quadratic.

    Frames are no longer needed: near its own optimum a frame is its gradient and its Gauss-Newton matrix. Unknowns
    of the step are small turns of every joint from the right, so that nothing happens at a half turn.

    `x` (T, P), pose and trans of every frame, where the quadratics were made; `gradient, precision` (T, P) and (T,
    P, P); `weights` (P,), see `inertia`.
    """
    T = len(x)
    if T < 3:
        return x
    out = np.empty_like(x)
    for near, kept, where in overlapping_windows(T, WINDOW, OVERLAP):
        out[where] = _window(x[near], gradient[near], precision[near], weights, rounds)[kept]
    return out


def _window(x: np.ndarray, gradient: np.ndarray, precision: np.ndarray, weights: np.ndarray, rounds: int
            ) -> np.ndarray:
    local = _local(x)
    g = np.einsum("tpq,tp->tq", local, gradient)
    H = np.swapaxes(local, -1, -2) @ precision @ local
    D, at = np.array([1.0, -2.0, 1.0]), x
    for _ in range(rounds):
        rhs = g + np.einsum("tpq,tq->tp", H, difference(x, at))
        bend = np.diff(difference(at[:-1], at[1:]), axis=0)
        for i in range(3):
            rhs[i:len(x) - 2 + i] += D[i] * weights * bend
        at = moved(at, -solve_smooth(H, weights, rhs))
    return at


def difference(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(..., P) small turns from the right, and the shift, that lead from bodies x to bodies y."""
    turn = np.swapaxes(_turns(x), -1, -2) @ _turns(y)
    return np.concatenate([rotations.log(turn).reshape(*x.shape[:-1], -1), y[..., -3:] - x[..., -3:]], axis=-1)


def moved(x: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Bodies (..., P) after small turns from the right and a shift; `moved(x, difference(x, y))` is y."""
    pose = rotations.log(_turns(x) @ _turns(step))
    return np.concatenate([pose.reshape(*x.shape[:-1], -1), x[..., -3:] + step[..., -3:]], axis=-1)


def _turns(x: np.ndarray) -> np.ndarray:
    return rotations.exp(x[..., :-3].reshape(*x.shape[:-1], -1, 3))


def _local(x: np.ndarray) -> np.ndarray:
    """(T, P, P) derivative of the unknowns by small turns from the right."""
    T, P = x.shape
    out = np.zeros((T, P, P))
    inverse = rotations.inverse_right_jacobian(x[:, :-3].reshape(T, -1, 3))
    for j in range(inverse.shape[1]):
        out[:, 3 * j:3 * j + 3, 3 * j:3 * j + 3] = inverse[:, j]
    out[:, -3:, -3:] = np.eye(3)
    return out
