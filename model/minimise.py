"""Least squares over a pose and what comes with it: Levenberg-Marquardt, and a last descent by gradients alone."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .features import twists

EXACT = 1e-9                         # metres: nearer than this needs no further step
TRIES = 12                           # steps of growing damping before giving up

Evaluate = Callable[[np.ndarray], np.ndarray]
Derive = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
Slope = Callable[[np.ndarray, np.ndarray], np.ndarray]


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
        energy = lower
        if step == limit:
            break
        residual, columns = derive(x)
        energy = float(residual @ residual)
    return Minimum(x, False, step, energy)


def descend(evaluate: Evaluate, slope: Slope, normal: np.ndarray, x: np.ndarray, tolerance: float, limit: int
            ) -> Minimum:
    """Least squares from a good start, by gradients and a normal matrix of a like problem: L-BFGS that begins there.

    The minimum is that of `evaluate`, whatever the matrix; a good one saves steps.

    Parameters
    ----------
    evaluate : x -> (m,) float, metres
        Residuals.
    slope : x, residuals -> (n,) float
        Half the gradient of the sum of squared residuals.
    normal : (n, n) float
        Near half the second derivatives of that sum.
    x : (n,) float
    tolerance : float
        Expected relative decrease of the energy at which to stop.
    limit : int
        Largest number of steps.
    """
    inverse = np.linalg.inv(normal + 1e-6 * np.diag(np.diag(normal)))
    residual = evaluate(x)
    energy, gradient, steps = float(residual @ residual), slope(x, residual), 0
    memory: list[tuple[np.ndarray, np.ndarray]] = []
    while True:
        ahead = -_quasi_newton(inverse, memory, gradient)
        if -gradient @ ahead <= max(tolerance * energy, EXACT**2 * len(residual)):
            return Minimum(x, True, steps, energy)
        if steps == limit:
            return Minimum(x, False, steps, energy)
        for halving in range(TRIES):
            trial = x + 0.5**halving * ahead
            residual = evaluate(trial)
            if float(residual @ residual) < energy:
                break
        else:
            return Minimum(x, True, steps, energy)       # no step lowers it any more
        before, gradient = gradient, slope(trial, residual)
        if (trial - x) @ (gradient - before) > 0:
            memory.append((trial - x, gradient - before))
        x, energy, steps = trial, float(residual @ residual), steps + 1


def _quasi_newton(inverse: np.ndarray, memory: list[tuple[np.ndarray, np.ndarray]], gradient: np.ndarray
                  ) -> np.ndarray:
    """The gradient times the inverse of the normal matrix, corrected by the steps (s, y) that were seen."""
    q, shares = gradient.copy(), []
    for s, y in reversed(memory):
        shares.append(s @ q / (s @ y))
        q -= shares[-1] * y
    q = inverse @ q
    for (s, y), share in zip(memory, reversed(shares), strict=True):
        q += (share - y @ q / (s @ y)) * s
    return q
