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


def minimise(evaluate: Evaluate, derive: Derive, x: np.ndarray, J: int, tolerance: float, limit: int,
             reuse: int = 1) -> Minimum:
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
    reuse : int
        Steps for which derivatives serve, where they cost far more than residuals; a search ends on new ones only.
    """
    damping, step, used = 1e-4, 0, 0
    residual, columns = derive(x)
    normal, energy = columns @ columns.T, float(residual @ residual)
    while step < limit:
        lower, damping = _lower(evaluate, x, energy, normal, columns @ residual, damping)
        if lower is None and not used:
            return Minimum(x, True, step, energy)
        if lower is not None:
            trial, residual, before, energy = *lower, energy, float(lower[1] @ lower[1])
            x, step, damping = trial.copy(), step + 1, damping / 5
            x[:3 * J] = twists(x[:3 * J].reshape(J, 3)).ravel()
            small = before - energy <= tolerance * before
            if (small and not used) or energy < EXACT**2 * len(residual):
                return Minimum(x, True, step, energy)
            used += 1
        if lower is None or small or used >= reuse or not np.array_equal(x, trial):
            residual, columns = derive(x)
            normal, energy, used = columns @ columns.T, float(residual @ residual), 0
    return Minimum(x, False, step, energy)


def _lower(evaluate: Evaluate, x: np.ndarray, energy: float, normal: np.ndarray, slope: np.ndarray, damping: float
           ) -> tuple[tuple[np.ndarray, np.ndarray] | None, float]:
    """Unknowns of lower energy with their residuals, or None where no step finds any; and the damping it took."""
    scale = np.diag(normal) + 1e-9 * np.trace(normal) / len(normal)
    for _ in range(TRIES):
        trial = x - np.linalg.solve(normal + damping * np.diag(scale), slope)
        value = evaluate(trial)
        if float(value @ value) < energy:
            return (trial, value), damping
        damping = max(damping, 1e-7) * 10
    return None, damping
