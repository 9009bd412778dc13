"""Least squares over many frames that share some unknowns."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Equations = tuple[np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class SharedMinimum:
    """Where a minimisation over frames ended.

    Attributes
    ----------
    x : (B, n) float
        What each frame has for itself.
    z : (S,) float
        What they share.
    converged : bool
    iterations : int
    energy : float
    """

    x: np.ndarray
    z: np.ndarray
    converged: bool
    iterations: int
    energy: float


def minimise_arrow(frames: Callable[[np.ndarray, np.ndarray], Equations],
                   common: Callable[[np.ndarray], Equations] | None, x: np.ndarray, z: np.ndarray, iterations: int,
                   tolerance: float = 1e-5) -> SharedMinimum:
    """Levenberg-Marquardt on frames with unknowns of their own that are coupled by those they share alone.

    Parameters
    ----------
    frames : x (B, n), z (S,) -> energies (B,), half their gradients (B, n + S), matrices (B, n + S, n + S)
    common : z (S,) -> energy, half its gradient (S,), Gauss-Newton matrix (S, S); optional
        What concerns the shared unknowns alone.
    x : (B, n) float
    z : (S,) float
    iterations : int
        Most steps.
    tolerance : float
        Stop when a step lowers the energy by less than this fraction.
    """
    def equations(x: np.ndarray, z: np.ndarray) -> tuple[float, Equations, Equations | None]:
        rows, rest = frames(x, z), common(z) if common else None
        return float(rows[0].sum()) + (float(rest[0]) if rest else 0.0), rows, rest

    now, damping = equations(x, z), 1e-3
    for done in range(1, iterations + 1):
        dx, dz = _arrow_step(now[1], now[2], x.shape[1], damping)
        tried = equations(x + dx, z + dz)
        change = now[0] - tried[0]
        if change > 0:
            x, z, now, damping = x + dx, z + dz, tried, max(damping / 5, 1e-9)
        else:
            damping *= 8
        if abs(change) <= tolerance * now[0] or damping > 1e8:
            return SharedMinimum(x, z, True, done, now[0])
    return SharedMinimum(x, z, False, iterations, now[0])


def minimise_shared(equations: Callable[[np.ndarray], Equations], x: np.ndarray, shared: int, iterations: int
                     ) -> tuple[np.ndarray, bool, int]:
    """`minimise_arrow` on rows (B, P) whose last unknowns are the same in all of them.

    Parameters
    ----------
    equations : x (B, P) -> energies (B,), half their gradients (B, P), Gauss-Newton matrices (B, P, P)
    x : (B, P) float
    shared : int
        How many of the unknowns are the same in all rows.
    iterations : int
        Most steps.

    Returns
    -------
    (B, P) float
    bool
        Whether it settled.
    int
        Steps taken.
    """
    def rows(x: np.ndarray, z: np.ndarray) -> np.ndarray:
        return np.concatenate([x, np.tile(z, (len(x), 1))], axis=1)

    n = x.shape[1] - shared
    end = minimise_arrow(lambda x, z: equations(rows(x, z)), None, x[:, :n], x[0, n:], iterations)
    return rows(end.x, end.z), end.converged, end.iterations


def _arrow_step(rows: Equations, rest: Equations | None, n: int, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """The step of the damped normal equations: frames are eliminated, what they share is solved for."""
    _, gradient, hessian = rows
    slope, shared = gradient[:, n:].sum(axis=0), hessian[:, n:, n:].sum(axis=0)
    if rest:
        slope, shared = slope + rest[1], shared + rest[2]
    own, cross = hessian[:, :n, :n], hessian[:, :n, n:]
    diagonal = np.diagonal(own, axis1=1, axis2=2)
    floor = 1e-9 * max(diagonal.max(), np.diag(shared).max(initial=0.0))
    own = own + (damping * diagonal + floor)[:, :, None] * np.eye(n)
    solved = np.linalg.solve(own, np.concatenate([cross, gradient[:, :n, None]], axis=2))
    shared = shared + np.diag(damping * np.diag(shared) + floor)
    back = np.swapaxes(cross, 1, 2) @ solved                                       # (B, S, S + 1)
    dz = -np.linalg.solve(shared - back[..., :-1].sum(axis=0), slope - back[..., -1].sum(axis=0))
    return -(solved[..., -1] + solved[..., :-1] @ dz), dz
