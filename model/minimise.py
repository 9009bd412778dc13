"""Levenberg-Marquardt over a pose and what comes with it."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .features import twists

EXACT = 1e-9                         # metres: nearer than this needs no further step
TRIES = 12                           # steps of growing damping before giving up

Evaluate = Callable[[np.ndarray], np.ndarray]
Derive = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True, eq=False)
class Minimum:
    """Where the search stopped.

    Attributes
    ----------
    x : (n,) float
        Unknowns.
    converged : bool
    steps : int
    energy : float, square metres
    """

    x: np.ndarray
    converged: bool
    steps: int
    energy: float


def minimise(evaluate: Evaluate, derive: Derive, x: np.ndarray, J: int, tolerance: float, limit: int) -> Minimum:
    """Least squares by Levenberg-Marquardt; a step is taken only where it lowers the energy.

    Parameters
    ----------
    evaluate : x -> (m,) float, metres
        Residuals.
    derive : x -> residuals (m,), derivatives (n, m)
        One row an unknown.
    x : (n,) float
        The first 3J are a pose, which is kept below π.
    tolerance : float
        Relative decrease of the energy at which to stop.
    limit : int
        Largest number of steps.
    """
    damping, step = 1e-4, 0
    residual, columns = derive(x)
    energy = float(residual @ residual)
    while step < limit:
        normal, slope = columns @ columns.T, columns @ residual
        scale = np.diag(normal) + 1e-9 * np.trace(normal) / len(normal)
        for _ in range(TRIES):
            trial = x - np.linalg.solve(normal + damping * np.diag(scale), slope)
            value = evaluate(trial)
            if float(value @ value) < energy:
                break
            damping = max(damping, 1e-7) * 10
        else:
            return Minimum(x, True, step, energy)    # no step lowers it any more
        step += 1
        lower = float(value @ value)
        trial[:3 * J] = twists(trial[:3 * J].reshape(J, 3)).ravel()
        x, damping = trial, damping / 5
        if energy - lower <= tolerance * energy or lower < EXACT**2 * len(residual):
            return Minimum(x, True, step, lower)
        residual, columns = derive(x)
        energy = float(residual @ residual)
    return Minimum(x, False, step, energy)
