"""The unknowns of bodies by Levenberg-Marquardt, a batch of problems at once."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from scanprep.ranges import Settings

from .energy import Residual

Energy = Callable[[np.ndarray], Sequence[Residual]]
System = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]
Move = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class MinimiseConfig(Settings):
    """Settings of Levenberg-Marquardt.

    Attributes
    ----------
    iterations : int
        Most steps taken.
    damping : float
        First factor on the diagonal of the normal matrix.
    tolerance : float
        Stop when a step lowers the energy by less than this fraction.
    """

    iterations: int = 30
    damping: float = 1e-3
    tolerance: float = 1e-5


@dataclass(frozen=True, eq=False)
class Minimum:
    """Where a batch of minimisations ended.

    Attributes
    ----------
    x : (B, P) float
    energy : (B,) float
    converged : (B,) bool
    iterations : int
    hessian : (B, P, P) float
        The Gauss-Newton matrix at x.
    """

    x: np.ndarray
    energy: np.ndarray
    converged: np.ndarray
    iterations: int
    hessian: np.ndarray


def minimise(energy: Energy, start: np.ndarray, config: MinimiseConfig | None = None) -> Minimum:
    """Levenberg-Marquardt on a batch of independent problems, each with its own damping.

    Parameters
    ----------
    energy : x (B, P) -> residuals with leading dimension B
    start : (B, P) float
    """
    return descend(lambda x: normal_equations(energy(x)), start, config)


def descend(system: System, start: np.ndarray, config: MinimiseConfig | None = None, move: Move = np.add) -> Minimum:
    """`minimise` for those who make the normal equations themselves, and whose unknowns need not add.

    Parameters
    ----------
    system : x (B, P) -> energy (B,), half its gradient (B, P), Gauss-Newton matrix (B, P, P)
    start : (B, P) float
    move : x (B, P), step (B, P) -> x (B, P)
        What a step does to the unknowns.
    """
    config = config or MinimiseConfig()
    x = np.array(start, dtype=np.float64)
    cost, gradient, hessian = system(x)
    damping = np.full(len(x), config.damping)
    converged = np.zeros(len(x), dtype=bool)
    done = 0
    while done < config.iterations and not converged.all():
        done += 1
        diagonal = np.einsum("bpp->bp", hessian)
        ridge = damping[:, None] * diagonal + 1e-9 * diagonal.max(axis=1, keepdims=True)
        step = -np.linalg.solve(hessian + ridge[:, :, None] * np.eye(x.shape[1]), gradient[..., None])[..., 0]
        step[converged] = 0
        ahead = move(x, step)
        tried = system(ahead)
        better = (tried[0] < cost) & ~converged
        hoped = -np.einsum("bp,bp->b", 2 * gradient + (hessian @ step[..., None])[..., 0], step)
        least = config.tolerance * np.maximum(cost, 1e-300)
        # a step that failed settles nothing unless there was nothing to gain: it may have been too long
        settled = (better & (cost - tried[0] <= least)) | (hoped <= least)
        converged |= settled | (damping > 1e8)
        x[better] = ahead[better]
        for old, new in zip((cost, gradient, hessian), tried, strict=True):
            old[better] = new[better]
        damping = np.where(better, np.maximum(damping / 5, 1e-9), damping * 8)
    return Minimum(x, cost, converged, done, hessian)


def normal_equations(residuals: Sequence[Residual]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Energy (B,), half its gradient (B, P) and the Gauss-Newton matrix (B, P, P) of a sum of residuals."""
    first = residuals[0].jacobian
    cost = np.zeros(len(first))
    gradient = np.zeros((len(first), first.shape[-1]))
    hessian = np.zeros((len(first), first.shape[-1], first.shape[-1]))
    for term in residuals:
        transposed = np.swapaxes(term.jacobian, -1, -2)
        cost += term.energy
        gradient += (transposed @ term.values[..., None])[..., 0]
        hessian += transposed @ term.jacobian
    return cost, gradient, hessian
