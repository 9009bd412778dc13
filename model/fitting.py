"""Pose and shape of a body from its registered vertices, by Levenberg-Marquardt."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .linear import PointOperator, Subject
from .pose_space import twists
from .scape import ScapeModel

EXACT = 1e-9                         # metres: nearer than this needs no further step


@dataclass(frozen=True)
class FitConfig:
    """Settings of `fit_pose` and `fit_shape`.

    Parameters
    ----------
    sample : int
        Vertices, well spread over the surface, on which the first steps run.
    iterations : int
        Largest number of steps on the sample.
    polish : int
        Largest number of further steps on all vertices.
    tolerance : float
        Relative decrease of the energy below which to stop.
    n_betas : int, optional
        Use the first of the model's shape components only (`fit_shape`).
    """

    sample: int = 800
    iterations: int = 60
    polish: int = 4
    tolerance: float = 1e-5
    n_betas: int | None = None


@dataclass(frozen=True, eq=False)
class PoseFit:
    """A fitted pose.

    Attributes
    ----------
    pose : (J, 3) float, radians
    trans : (3,) float, metres
    vertices : (N, 3) float, metres
    rms, mean : float, metres
        Of the distances of corresponding vertices.
    converged : bool
    iterations : int
    """

    pose: np.ndarray
    trans: np.ndarray
    vertices: np.ndarray
    rms: float
    mean: float
    converged: bool
    iterations: int


@dataclass(frozen=True, eq=False)
class ShapeFit(PoseFit):
    """A fitted shape and pose; `betas` (K,) in standard deviations."""

    betas: np.ndarray


Evaluate = Callable[[np.ndarray], np.ndarray]
Derive = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


def fit_pose(subject: Subject, vertices: np.ndarray, config: FitConfig | None = None) -> PoseFit:
    """Pose and place of a known body from all its vertices.

    Parameters
    ----------
    subject : Subject
    vertices : (N, 3) float, metres
    config : FitConfig, optional

    Raises
    ------
    ValueError
        Vertices of another count or not finite.
    """
    return PoseFitter(subject, config).fit(vertices)


class PoseFitter:
    """`fit_pose` for many scans of one subject: what does not depend on the scan is prepared once.

    Parameters
    ----------
    subject : Subject
    config : FitConfig, optional
    """

    def __init__(self, subject: Subject, config: FitConfig | None = None) -> None:
        self.subject, self.config = subject, config or FitConfig()
        self._chosen = spread_vertices(subject.template.vertices, self.config.sample)
        self._sample = subject.points(self._chosen)

    @cached_property
    def _everything(self) -> PointOperator:
        return self.subject.points(np.arange(self.subject.n_vertices))

    def fit(self, vertices: np.ndarray, start: np.ndarray | None = None) -> PoseFit:
        """Pose and place from all vertices (N, 3), from a start that is sought unless a pose (J, 3) is given."""
        subject, config, chosen = self.subject, self.config, self._chosen
        vertices = _checked_vertices(vertices, subject.n_vertices)
        J = len(subject.skeleton.parents)
        energy = _pose_energy(self._sample, vertices[chosen])
        best: Minimum | None = None
        for x in _starts(subject, vertices) if start is None else [_placed(subject, vertices, start)]:
            found = _minimise(*energy, x, J, config.tolerance, config.iterations)
            if best is None or found.energy < best.energy:
                best = found
            if np.sqrt(found.energy / len(chosen)) < 0.02 * np.ptp(vertices, axis=0).max():
                break
        assert best is not None
        steps = best.steps
        if len(chosen) < subject.n_vertices and config.polish:
            best = _minimise(*_pose_energy(self._everything, vertices), best.x, J, config.tolerance, config.polish)
            steps += best.steps
        pose, trans = best.x[:3 * J].reshape(J, 3), best.x[3 * J:]
        fitted = np.asarray(subject.vertices(pose, trans), dtype=np.float64)
        return PoseFit(pose, trans, fitted, *_distances(fitted, vertices), best.converged, steps)


def fit_shape(model: ScapeModel, vertices: np.ndarray, config: FitConfig | None = None) -> ShapeFit:
    """Shape, pose and place of an unknown body from all its vertices.

    Parameters
    ----------
    model : ScapeModel
        With shape components.
    vertices : (N, 3) float, metres
    config : FitConfig, optional

    Raises
    ------
    ValueError
        Vertices of another count or not finite, or a model without shape components.
    """
    config = config or FitConfig()
    vertices = _checked_vertices(vertices, len(model.template.vertices))
    K = model.n_betas if config.n_betas is None else config.n_betas
    if not 0 < K <= model.n_betas:
        raise ValueError(f"n_betas: expected 1..{model.n_betas}, got {K}")
    J = len(model.skeleton.parents)
    first = fit_pose(model.subject(np.zeros(K)), vertices, FitConfig(config.sample, 10, 0, 1e-3))
    x = np.concatenate([first.pose.ravel(), first.trans, np.zeros(K)])
    chosen = spread_vertices(model.template.vertices, config.sample)
    best = _minimise(*_shape_energy(model, chosen, vertices[chosen], K), x, J, config.tolerance, config.iterations)
    steps = best.steps
    if config.polish:
        best = _minimise(*_whole_energy(model, vertices, K), best.x, J, config.tolerance, config.polish)
        steps += best.steps
    x = best.x
    pose, trans, betas = x[:3 * J].reshape(J, 3), x[3 * J:3 * J + 3], np.zeros(model.n_betas)
    betas[:K] = x[3 * J + 3:]
    fitted = model.vertices(pose, betas, trans)
    return ShapeFit(pose, trans, fitted, *_distances(fitted, vertices), best.converged, steps, betas)


def spread_vertices(vertices: np.ndarray, count: int) -> np.ndarray:
    """Indices (≤ count,) of vertices spread evenly, each next one farthest from those before."""
    if count >= len(vertices):
        return np.arange(len(vertices))
    chosen = np.empty(count, dtype=np.int64)
    far = np.full(len(vertices), np.inf)
    at = int(((vertices - vertices.mean(axis=0)) ** 2).sum(axis=1).argmax())
    for i in range(count):
        chosen[i] = at
        far = np.minimum(far, ((vertices - vertices[at]) ** 2).sum(axis=1))
        at = int(far.argmax())
    return np.sort(chosen)


def _starts(subject: Subject, vertices: np.ndarray) -> list[np.ndarray]:
    """Pose and place to start from: each part where it fits best, then the whole body stiff."""
    J = len(subject.skeleton.parents)
    rest = subject.template.with_vertices(np.asarray(subject.vertices(np.zeros((J, 3))), dtype=np.float64))
    R = subject.skeleton.fit_rotations(rest, vertices)
    stiff = np.broadcast_to(R[0], R.shape)
    starts = []
    for rotations in (R, stiff):
        starts.append(_placed(subject, vertices, subject.skeleton.pose_of(rotations.copy())))
    return starts


def _placed(subject: Subject, vertices: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Unknowns (3J + 3,) for a pose, standing where it fits best."""
    posed = np.asarray(subject.vertices(pose), dtype=np.float64)
    return np.concatenate([pose.ravel(), (vertices - posed).mean(axis=0)])


def _pose_energy(operator: PointOperator, target: np.ndarray) -> tuple[Evaluate, Derive]:
    """Residual (3L,) of the points against their targets, and its derivatives (3J + 3, 3L)."""
    J3 = 3 * len(operator.features.skeleton.parents)
    place = np.broadcast_to(np.eye(3)[:, None], (3, operator.count, 3)).reshape(3, -1)

    def evaluate(x: np.ndarray) -> np.ndarray:
        return (operator.evaluate(x[:J3].reshape(-1, 3), x[J3:]) - target).ravel()

    def derive(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        y, columns = operator.columns(x[:J3].reshape(-1, 3), x[J3:])
        return (y - target).ravel(), np.concatenate([columns.reshape(J3, -1), place])

    return evaluate, derive


def _shape_energy(model: ScapeModel, chosen: np.ndarray, target: np.ndarray, K: int) -> tuple[Evaluate, Derive]:
    """As `_pose_energy`, with betas behind pose and place, on a few vertices."""
    points = model.points(chosen)
    J3 = 3 * len(model.skeleton.parents)

    def evaluate(x: np.ndarray) -> np.ndarray:
        return _pose_energy(points.operator(x[J3 + 3:]), target)[0](x[:J3 + 3])

    def derive(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        residual, columns = _pose_energy(points.operator(x[J3 + 3:]), target)[1](x[:J3 + 3])
        by_shape = np.moveaxis(points.shape_jacobian(x[:J3].reshape(-1, 3))[..., :K], -1, 0)
        return residual, np.concatenate([columns, by_shape.reshape(K, -1)])

    return evaluate, derive


def _whole_energy(model: ScapeModel, target: np.ndarray, K: int) -> tuple[Evaluate, Derive]:
    """As `_shape_energy`, on all vertices: the operator is stitched again whenever betas change."""
    J3 = 3 * len(model.skeleton.parents)
    everything = np.arange(len(target))

    def evaluate(x: np.ndarray) -> np.ndarray:
        return (model.vertices(x[:J3].reshape(-1, 3), x[J3 + 3:], x[J3:J3 + 3]) - target).ravel()

    def derive(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        operator = model.subject(x[J3 + 3:]).points(everything)
        residual, columns = _pose_energy(operator, target)[1](x[:J3 + 3])
        by_shape = np.moveaxis(model.shape_jacobian(x[:J3].reshape(-1, 3))[..., :K], -1, 0)
        return residual, np.concatenate([columns, by_shape.reshape(K, -1)])

    return evaluate, derive


@dataclass(frozen=True, eq=False)
class Minimum:
    """Where Levenberg-Marquardt stopped: unknowns, energy in square metres."""

    x: np.ndarray
    converged: bool
    steps: int
    energy: float


def _minimise(evaluate: Evaluate, derive: Derive, x: np.ndarray, J: int, tolerance: float, limit: int) -> Minimum:
    """Levenberg-Marquardt; the first 3J unknowns are a pose, kept below π."""
    damping, step = 1e-4, 0
    residual, columns = derive(x)
    energy = float(residual @ residual)
    while step < limit:
        normal, slope = columns @ columns.T, columns @ residual
        scale = np.diag(normal) + 1e-9 * np.trace(normal) / len(normal)
        for _ in range(12):
            trial = x - np.linalg.solve(normal + damping * np.diag(scale), slope)
            value = evaluate(trial)
            if float(value @ value) < energy:
                break
            damping = max(damping, 1e-7) * 10
        else:
            return Minimum(x, True, step, energy)    # no step lowers it any more
        step += 1
        decrease = energy - float(value @ value)
        trial[:3 * J] = twists(trial[:3 * J].reshape(J, 3)).ravel()
        x, damping = trial, damping / 5
        if decrease <= tolerance * energy or energy - decrease < EXACT**2 * len(residual):
            return Minimum(x, True, step, energy - decrease)
        residual, columns = derive(x)
        energy = float(residual @ residual)
    return Minimum(x, False, step, energy)


def _distances(fitted: np.ndarray, vertices: np.ndarray) -> tuple[float, float]:
    far = np.linalg.norm(fitted - vertices, axis=1)
    return float(np.sqrt((far**2).mean())), float(far.mean())


def _checked_vertices(vertices: np.ndarray, count: int) -> np.ndarray:
    vertices = np.asarray(vertices, dtype=np.float64)
    if vertices.shape != (count, 3):
        raise ValueError(f"vertices: expected shape ({count}, 3), got {vertices.shape}")
    if not np.isfinite(vertices).all():
        raise ValueError("vertices: expected finite numbers")
    return vertices
