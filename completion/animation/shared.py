"""Least squares over many frames that share some unknowns."""
from __future__ import annotations

from collections.abc import Callable

import numpy as np

Equations = tuple[np.ndarray, np.ndarray, np.ndarray]


def minimise_shared(equations: Callable[[np.ndarray], Equations], x: np.ndarray, shared: int, iterations: int
                     ) -> tuple[np.ndarray, bool, int]:
    """Levenberg-Marquardt on rows (B, P) whose last unknowns are the same in all of them.

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
    now, damping = equations(x), 1e-3
    for done in range(1, iterations + 1):
        step = _shared_step(now, shared, damping)
        tried = equations(x + step)
        change = now[0].sum() - tried[0].sum()
        if change > 0:
            x, now, damping = x + step, tried, max(damping / 5, 1e-9)
        else:
            damping *= 8
        if abs(change) <= 1e-5 * now[0].sum() or damping > 1e8:
            return x, True, done
    return x, False, iterations


def _shared_step(equations: Equations, shared: int, damping: float) -> np.ndarray:
    """The step (B, P) of the damped normal equations, rows coupled by their last unknowns alone."""
    _, gradient, hessian = equations
    B, P = gradient.shape
    n = P - shared
    whole, slope = np.zeros((B * n + shared, B * n + shared)), np.zeros(B * n + shared)
    for i in range(B):
        own = slice(i * n, (i + 1) * n)
        whole[own, own], slope[own] = hessian[i, :n, :n], gradient[i, :n]
        whole[own, B * n:], whole[B * n:, own] = hessian[i, :n, n:], hessian[i, n:, :n]
    whole[B * n:, B * n:], slope[B * n:] = hessian[:, n:, n:].sum(axis=0), gradient[:, n:].sum(axis=0)
    diagonal = np.diag(whole)
    whole += np.diag(damping * diagonal + 1e-9 * diagonal.max())
    step = -np.linalg.solve(whole, slope)
    return np.concatenate([step[:B * n].reshape(B, n), np.tile(step[B * n:], (B, 1))], axis=1)
