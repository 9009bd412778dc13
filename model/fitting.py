"""Pose and shape of a body from its registered vertices, by Levenberg-Marquardt."""
from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from scanprep.geometry.farthest_points import farthest_points
from scanprep.ranges import Count, Settings
from scanprep.threads import one_thread

from .bilinear import ShapedPoints
from .body import BodyModel
from .features import twists
from .linear import PointOperator, Subject
from .minimise import Derive, Evaluate, Minimum, Slope, descend, minimise
from .pullback import pull_back


@dataclass(frozen=True)
class FitConfig(Settings):
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

    sample: Count = 800
    iterations: Count = 60
    polish: int = 10
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


@one_thread()
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
            found = minimise(*energy, x, J, config.tolerance, config.iterations)
            if best is None or found.energy < best.energy:
                best = found
            if np.sqrt(found.energy / len(chosen)) < 0.02 * np.ptp(vertices, axis=0).max():
                break
        assert best is not None
        steps = best.steps
        if len(chosen) < subject.n_vertices and config.polish:
            best = minimise(*_pose_energy(self._everything, vertices), best.x, J, config.tolerance, config.polish)
            steps += best.steps
        pose, trans = best.x[:3 * J].reshape(J, 3), best.x[3 * J:]
        fitted = np.asarray(subject.vertices(pose, trans), dtype=np.float64)
        return PoseFit(pose, trans, fitted, *_distances(fitted, vertices), best.converged, steps)


@one_thread()
def fit_shape(model: BodyModel, vertices: np.ndarray, config: FitConfig | None = None) -> ShapeFit:
    """Shape, pose and place of an unknown body from all its vertices.

    Parameters
    ----------
    model : BodyModel
        With shape components.
    vertices : (N, 3) float, metres
    config : FitConfig, optional

    Raises
    ------
    ValueError
        Vertices of another count or not finite, or a model without shape components.
    """
    return ShapeFitter(model, config).fit(vertices)


class ShapeFitter:
    """`fit_shape` for many scans: what does not depend on the scan is prepared once.

    Parameters
    ----------
    model : BodyModel
        With shape components.
    config : FitConfig, optional
    """

    def __init__(self, model: BodyModel, config: FitConfig | None = None) -> None:
        self.model, self.config = model, config or FitConfig()
        self.n_betas = model.n_betas if self.config.n_betas is None else self.config.n_betas
        if not 0 < self.n_betas <= model.n_betas:
            raise ValueError(f"n_betas: expected 1..{model.n_betas}, got {self.n_betas}")
        self._chosen = spread_vertices(model.template.vertices, self.config.sample)
        self._share = share_of_vertices(model.template.vertices, self._chosen)
        first = FitConfig(self.config.sample, iterations=10, polish=0, tolerance=1e-3)
        self._mean_person = PoseFitter(model.subject(np.zeros(self.n_betas)), first)

    @cached_property
    def _points(self) -> ShapedPoints:
        return self.model.points(self._chosen, n_betas=self.n_betas)

    def first(self, n_betas: int) -> ShapeFitter:
        """The fitter of the first components only, which shares what has been prepared."""
        if not 0 < n_betas <= self.n_betas:
            raise ValueError(f"n_betas: expected 1..{self.n_betas}, got {n_betas}")
        fewer = copy(self)
        fewer.config, fewer.n_betas = replace(self.config, n_betas=n_betas), n_betas
        fewer._points = replace(self._points, shape_basis=self._points.shape_basis[:n_betas])
        return fewer

    def fit(self, vertices: np.ndarray, start: PoseFit | None = None) -> ShapeFit:
        """Shape, pose and place from all vertices (N, 3), from a start that is sought unless a fit is given."""
        model, config, K = self.model, self.config, self.n_betas
        vertices = _checked_vertices(vertices, len(model.template.vertices))
        J = len(model.skeleton.parents)
        start = start or self._mean_person.fit(vertices)
        betas = start.betas[:K] if isinstance(start, ShapeFit) else np.zeros(K)
        x = np.concatenate([start.pose.ravel(), start.trans, betas])
        evaluate, derive = _shape_energy(self._points, vertices[self._chosen], np.sqrt(self._share))
        best = minimise(evaluate, derive, x, J, config.tolerance, config.iterations)
        steps = best.steps
        if len(self._chosen) < len(vertices) and config.polish:
            columns = derive(best.x)[1]
            best = descend(*_whole_energy(model, vertices), columns @ columns.T, best.x, config.tolerance,
                           config.polish)
            steps += best.steps
        pose, trans, betas = twists(best.x[:3 * J].reshape(J, 3)), best.x[3 * J:3 * J + 3], np.zeros(model.n_betas)
        betas[:K] = best.x[3 * J + 3:]
        fitted = model.vertices(pose, betas, trans)
        return ShapeFit(pose, trans, fitted, *_distances(fitted, vertices), best.converged, steps, betas)


def spread_vertices(vertices: np.ndarray, count: int) -> np.ndarray:
    """Indices (≤ count,) of vertices spread evenly, each next one farthest from those before."""
    return np.arange(len(vertices)) if count >= len(vertices) else np.sort(farthest_points(vertices, count))


def share_of_vertices(vertices: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """(L,) how many of all vertices (N, 3) lie nearest to each of those chosen (L,)."""
    nearest = cKDTree(vertices[chosen]).query(vertices)[1]
    return np.bincount(nearest, minlength=len(chosen)).astype(float)


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
    J3 = 3 * len(operator.terms.skeleton.parents)
    place = np.broadcast_to(np.eye(3)[:, None], (3, operator.count, 3)).reshape(3, -1)

    def evaluate(x: np.ndarray) -> np.ndarray:
        return (operator.evaluate(x[:J3].reshape(-1, 3), x[J3:]) - target).ravel()

    def derive(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        y, columns = operator.columns(x[:J3].reshape(-1, 3), x[J3:])
        return (y - target).ravel(), np.concatenate([columns.reshape(J3, -1), place])

    return evaluate, derive


def _shape_energy(points: ShapedPoints, target: np.ndarray, weights: np.ndarray) -> tuple[Evaluate, Derive]:
    """As `_pose_energy`, with betas behind pose and place; residuals are times the weights (L,) of their points."""
    J3, each = 3 * len(points.terms.skeleton.parents), np.repeat(weights, 3)

    def evaluate(x: np.ndarray) -> np.ndarray:
        return each * _pose_energy(points.operator(x[J3 + 3:]), target)[0](x[:J3 + 3])

    def derive(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        residual, columns = _pose_energy(points.operator(x[J3 + 3:]), target)[1](x[:J3 + 3])
        by_shape = np.moveaxis(points.shape_jacobian(x[:J3].reshape(-1, 3)), -1, 0)
        return each * residual, each * np.concatenate([columns, by_shape.reshape(len(by_shape), -1)])

    return evaluate, derive


def _whole_energy(model: BodyModel, target: np.ndarray) -> tuple[Evaluate, Slope]:
    """Residuals of all vertices, and half the gradient of their squares, with unknowns as `_shape_energy` has."""
    J3 = 3 * len(model.skeleton.parents)

    def evaluate(x: np.ndarray) -> np.ndarray:
        return (model.vertices(x[:J3].reshape(-1, 3), x[J3 + 3:], x[J3:J3 + 3]) - target).ravel()

    def slope(x: np.ndarray, residual: np.ndarray) -> np.ndarray:
        force = residual.reshape(-1, 3)
        by_pose, by_betas = pull_back(model, force, x[:J3].reshape(-1, 3), x[J3 + 3:])
        return np.concatenate([by_pose, force.sum(axis=0), by_betas])

    return evaluate, slope


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
