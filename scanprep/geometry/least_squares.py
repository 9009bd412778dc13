"""Levenberg-Marquardt for batches of least-squares problems, with rotations as unknowns.

The caller gives the normal equations at a state; their structure determines how a step is solved:

- `Dense`: B independent problems with P unknowns each, every one with its own damping;
- `Deferred`: one such problem whose matrix is assembled only for accepted steps, not for tried ones;
- `Arrow`: many frames with unknowns of their own, coupled only by shared unknowns;
- `Sparse`: one large problem with a sparse matrix.

A step is added to the state, unless a `retract` says otherwise, as for rotations.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

import numpy as np
from scipy.sparse import csc_array

from . import rotations, sparse

State = TypeVar("State")
FLOOR = 1e-9                         # share of the largest diagonal entry added to all: unknowns may have no data


@dataclass(frozen=True, eq=False)
class Residual:
    """Values (..., m) whose squares are summed, and their derivative (..., m, P) with respect to the unknowns."""

    values: np.ndarray
    jacobian: np.ndarray

    @property
    def energy(self) -> np.ndarray:
        """(...) sum of squares."""
        return np.einsum("...m,...m->...", self.values, self.values)


class NormalEquations(Protocol):
    """The quadratic model of an energy at one state: its value (B,), and the step that lowers it."""

    @property
    def energy(self) -> np.ndarray: ...

    def step(self, damping: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Solve for the step at a damping (B,); return it with the decrease (B,) of the quadratic model."""
        ...


class Dense(NamedTuple):
    """Energy (B,), half its gradient (B, P) and the Gauss-Newton matrix (B, P, P) of independent problems."""

    energy: np.ndarray
    gradient: np.ndarray
    hessian: np.ndarray

    def step(self, damping: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        # (H + damping diag(H) + floor) step = -g
        diagonal = np.diagonal(self.hessian, axis1=1, axis2=2)
        ridge = damping[:, None] * diagonal + FLOOR * diagonal.max(axis=1, keepdims=True)
        step = -np.linalg.solve(self.hessian + ridge[:, :, None] * np.eye(ridge.shape[1]),
                                self.gradient[..., None])[..., 0]
        return step, _gain(self.gradient, step, ridge)


@dataclass(frozen=True, eq=False)
class Deferred:
    """One dense problem, a batch of one: its energy (1,), and its equations when a step is solved."""

    energy: np.ndarray
    assemble: Callable[[], Dense]

    @cached_property
    def dense(self) -> Dense:
        """The equations, assembled once."""
        return self.assemble()

    def step(self, damping: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.dense.step(damping)


class Arrow(NamedTuple):
    """Frames (B, P) as one problem whose last `shared` unknowns are the same in all rows.

    `common` are the equations (a batch of one) of what concerns the shared unknowns alone.
    """

    rows: Dense
    shared: int
    common: Dense | None = None

    @property
    def energy(self) -> np.ndarray:
        return self.rows.energy.sum(keepdims=True) + (0.0 if self.common is None else self.common.energy)

    def step(self, damping: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Eliminate the frames from the damped equations (Schur complement), and solve for the shared unknowns."""
        _, gradient, hessian = self.rows
        n = gradient.shape[1] - self.shared
        slope, shared = gradient[:, n:].sum(axis=0), hessian[:, n:, n:].sum(axis=0)
        if self.common is not None:
            slope, shared = slope + self.common.gradient[0], shared + self.common.hessian[0]
        own, cross = hessian[:, :n, :n], hessian[:, :n, n:]
        diagonal = np.diagonal(own, axis1=1, axis2=2)
        floor = FLOOR * max(diagonal.max(), np.diag(shared).max(initial=0.0))
        ridge, ridge_shared = damping[0] * diagonal + floor, damping[0] * np.diag(shared) + floor
        # solve every frame for its gradient and its coupling; then the reduced system; then back-substitute
        solved = np.linalg.solve(own + ridge[:, :, None] * np.eye(n),
                                 np.concatenate([cross, gradient[:, :n, None]], axis=2))
        back = np.swapaxes(cross, 1, 2) @ solved                                       # (B, S, S + 1)
        dz = -np.linalg.solve(shared + np.diag(ridge_shared) - back[..., :-1].sum(axis=0),
                              slope - back[..., -1].sum(axis=0))
        dx = -(solved[..., -1] + solved[..., :-1] @ dz)
        gain = _gain(gradient[:, :n], dx, ridge).sum() + _gain(slope, dz, ridge_shared)
        return np.concatenate([dx, np.broadcast_to(dz, (len(dx), self.shared))], axis=1), gain[None]


@dataclass(frozen=True, eq=False)
class Sparse:
    """One problem with a sparse matrix (P, P); it and half the gradient (P,) are assembled when a step is solved.

    `terms` may list the parts of the energy.
    """

    value: float
    assemble: Callable[[], tuple[np.ndarray, csc_array]]
    terms: dict[str, float] = field(default_factory=dict)

    @property
    def energy(self) -> np.ndarray:
        return np.array([self.value])

    @cached_property
    def _system(self) -> tuple[np.ndarray, csc_array]:
        return self.assemble()

    def step(self, damping: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        gradient, matrix = self._system
        diagonal = matrix.diagonal()
        ridge = damping[0] * diagonal + FLOOR * diagonal.max()
        damped = matrix.copy()
        damped.setdiag(diagonal + ridge)
        step = -sparse.factor(damped)(gradient)
        return step, _gain(gradient, step, ridge)[None]


def normal_equations(residuals: Sequence[Residual]) -> Dense:
    """Assemble the Gauss-Newton equations of a sum of residuals with a leading dimension B."""
    first = residuals[0].jacobian
    cost = np.zeros(len(first))
    gradient = np.zeros((len(first), first.shape[-1]))
    hessian = np.zeros((len(first), first.shape[-1], first.shape[-1]))
    for term in residuals:
        transposed = np.swapaxes(term.jacobian, -1, -2)
        cost += term.energy
        gradient += (transposed @ term.values[..., None])[..., 0]
        hessian += transposed @ term.jacobian
    return Dense(cost, gradient, hessian)


def retract_pose(angles: int) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Return a retraction of rows (..., P) whose first unknowns are rotation vectors: `R exp(d)`; the rest is added.

    For equations with derivatives with respect to `d` at zero. Resulting rotation vectors are at most π long.
    """
    def retract(x: np.ndarray, step: np.ndarray) -> np.ndarray:
        out = x + step
        first, second = (part[..., :angles].reshape(-1, 3) for part in (x, step))
        out[..., :angles] = rotations.compose(first, second).reshape(out[..., :angles].shape)
        return out

    return retract


def step_between(x: np.ndarray, goal: np.ndarray, angles: int) -> np.ndarray:
    """Return the step (..., P) by which the retraction `retract_pose(angles)` leads from rows x to others."""
    return retract_pose(angles)(-x, goal)


def by_rotations(equations: Any, x: Any, angles: int) -> Any:
    """Convert `Dense` or `Arrow` equations at rows x (B, P) from rotation vectors to small rotations `R exp(d)`."""
    if isinstance(equations, Arrow):
        return equations._replace(rows=by_rotations(equations.rows, x, angles))
    local = np.swapaxes(rotations.inverse_right_jacobian(x[:, :angles].reshape(len(x), -1, 3)), -1, -2)

    def along(matrix: np.ndarray) -> np.ndarray:
        """Convert rows (B, P, k) by the chain rule."""
        out = matrix.copy()
        own = out[:, :angles]
        own[:] = (local @ own.reshape(*local.shape[:3], -1)).reshape(own.shape)
        return out

    return Dense(equations.energy, along(equations.gradient[..., None])[..., 0],
                 along(np.swapaxes(along(equations.hessian), 1, 2)))


@dataclass(frozen=True, eq=False)
class Minimum(Generic[State]):
    """The result: the state, its equations, which of the B problems converged, and the number of steps tried."""

    x: State
    equations: Any
    converged: np.ndarray
    iterations: int

    @property
    def energy(self) -> np.ndarray:
        """(B,) energy at the minimum."""
        return np.asarray(self.equations.energy)


def levenberg_marquardt(equations: Callable[[State], NormalEquations], start: State, iterations: int = 30,
                        tolerance: float = 1e-5, damping: float = 1e-3, exact: float = 0.0,
                        retract: Callable[[Any, np.ndarray], Any] = np.add, angles: int = 0) -> Minimum[State]:
    """Minimise an energy from a start by Levenberg-Marquardt; a step is accepted only if it lowers the energy.

    A state is (B, P) float for `Dense` and `Arrow`, and anything that `retract` accepts for `Sparse`. The search stops
    after `iterations` tried steps, or when a step lowers the energy by less than the fraction `tolerance`, or by less
    than `exact`. `damping` is the initial factor on the diagonal of the matrix. The first `angles` unknowns of a row
    are rotation vectors: derivatives are with respect to them, but steps and returned equations are in small rotations.
    """
    if angles:
        retract, by_vectors = retract_pose(angles), equations

        def equations(x: State) -> NormalEquations:
            return by_rotations(by_vectors(x), x, angles)

    x, now = start, equations(start)
    factor = np.full(len(now.energy), damping)
    converged = np.zeros(len(factor), dtype=bool)
    done = 0
    while done < iterations and not converged.all():
        done += 1
        step, gain = now.step(factor)
        ahead = retract(x, step)
        tried = equations(ahead)
        better = (tried.energy < now.energy) & ~converged
        least = np.maximum(tolerance * now.energy, max(exact, 1e-300))
        # a failed step proves convergence only if nothing was to be gained: it may just have been too long
        settled = (better & (now.energy - tried.energy <= least)) | (gain <= least)
        converged |= settled | (factor > 1e8)        # with so much damping no step lowers the energy
        x, now = _take(better, x, ahead), _take(better, now, tried)
        # damping: divided by 5 after a success, times 8 after a failure
        factor = np.where(better, np.maximum(factor / 5, 1e-9), factor * 8)
    return Minimum(x, now, converged, done)


def _gain(gradient: np.ndarray, step: np.ndarray, ridge: np.ndarray) -> np.ndarray:
    """Compute the decrease of the quadratic model by a step s of (H + ridge) s = -g: sᵀ ridge s - g·s."""
    return np.einsum("...p,...p->...", ridge * step - gradient, step)


def _take(better: np.ndarray, old: Any, new: Any) -> Any:
    """Take the new rows where they are better; a single problem is taken or left whole."""
    if better.all():
        return new
    if not better.any():
        return old
    if isinstance(old, Dense):
        return Dense(*(_take(better, a, b) for a, b in zip(old, new, strict=True)))
    rows = better.reshape(-1, *(1,) * (np.ndim(old) - 1))
    return np.where(rows, new, old)                                                 
