"""Fit pose and shape of a body to its registered vertices, by Levenberg-Marquardt."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.optimize import OptimizeResult, minimize
from scipy.spatial import cKDTree

from scanprep.geometry.farthest_points import farthest_points
from scanprep.geometry.least_squares import Dense, Minimum, levenberg_marquardt
from scanprep.ranges import Count, Settings
from scanprep.threads import one_thread
from scanprep.words import describe_result

from ..bilinear import PosedPoints, ShapedPoints
from ..body import BodyModel
from ..features import twists
from ..linear import PointOperator, Subject, check_subject


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
        Use only so many first shape components of the model (`fit_shape`).

    Examples
    --------
    >>> FitConfig(polish=0).sample
    800
    """

    sample: Count = 800
    iterations: Count = 60
    polish: int = 10
    tolerance: float = 1e-5
    n_betas: int | None = None


@dataclass(frozen=True, eq=False)
class PoseFit:
    """Result of `fit_pose`.

    Attributes
    ----------
    pose : (J, 3) float, radians
        Fitted pose.
    trans : (3,) float, metres
        Fitted place.
    vertices : (N, 3) float, metres
        The fitted body.
    rms : float, metres
        Root mean square distance of corresponding vertices.
    mean : float, metres
        Mean distance of corresponding vertices.
    converged : bool
        Whether the energy stopped falling before the largest number of steps.
    iterations : int
        Steps that were taken.

    Examples
    --------
    >>> from model import fit_pose, load_built_in_model
    >>> subject = load_built_in_model().subject(None)
    >>> fit = fit_pose(subject, subject.vertices(np.full((16, 3), 0.1)))
    >>> fit.converged, fit.vertices.shape
    (True, (5002, 3))
    """

    pose: np.ndarray
    trans: np.ndarray
    vertices: np.ndarray
    rms: float
    mean: float
    converged: bool
    iterations: int
    __repr__ = describe_result


@dataclass(frozen=True, eq=False)
class ShapeFit(PoseFit):
    """Result of `fit_shape`: what `PoseFit` holds, and the betas.

    Attributes
    ----------
    betas : (K,) float
        Shape coefficients, standard deviations; those that were not fitted are 0.

    Examples
    --------
    >>> from model import fit_shape, load_built_in_model
    >>> model = load_built_in_model()
    >>> fit = fit_shape(model, model.template.vertices, FitConfig(n_betas=5, polish=0))
    >>> fit.betas.shape, fit.rms < 0.01
    ((30,), True)
    """

    betas: np.ndarray
    __repr__ = describe_result


@one_thread()
def fit_pose(subject: Subject, vertices: np.ndarray, config: FitConfig | None = None) -> PoseFit:
    """Fit pose and place of a body of known shape to all its vertices.

    Parameters
    ----------
    subject : Subject
        The body, see `BodyModel.subject`.
    vertices : (N, 3) float, metres
        Registered vertices, in the order of the model's template.
    config : FitConfig, optional
        Settings.

    Returns
    -------
    PoseFit
        Pose, place, the fitted vertices and their distance from the given ones.

    Raises
    ------
    ValueError
        Another number of vertices, or vertices that are not finite.

    Examples
    --------
    >>> from model import load_built_in_model
    >>> subject = load_built_in_model().subject(None)
    >>> pose = np.full((16, 3), 0.1)
    >>> fit = fit_pose(subject, subject.vertices(pose, [0.0, 0.0, 1.0]))
    >>> np.allclose(fit.pose, pose, atol=1e-3), np.allclose(fit.trans, [0, 0, 1], atol=1e-3)
    (True, True)
    """
    return PoseFitter(subject, config).fit(vertices)


class PoseFitter:
    """`fit_pose` for many scans of one subject: what does not depend on the scan is prepared once."""

    def __init__(self, subject: Subject, config: FitConfig | None = None) -> None:
        self.subject, self.config = check_subject(subject), config or FitConfig()
        self._chosen = spread_vertices(subject.template.vertices, self.config.sample)
        self._sample = subject.points(self._chosen)

    @cached_property
    def _everything(self) -> PointOperator:
        return self.subject.points(np.arange(self.subject.n_vertices))

    def fit(self, vertices: np.ndarray, start: np.ndarray | None = None) -> PoseFit:
        """Fit pose and place to all vertices (N, 3), from a start pose (J, 3) or from starts that are found."""
        subject, config, chosen = self.subject, self.config, self._chosen
        vertices = _check_vertices(vertices, subject.n_vertices)
        J = len(subject.skeleton.parents)
        # steps on a sample of the vertices, from each start until one is within 2% of the body's extent
        best: Minimum[np.ndarray] | None = None
        for x in _starts(subject, vertices) if start is None else [_unknowns_of_pose(subject, vertices, start)]:
            end = _minimise(_equations(self._sample, vertices[chosen]), x[None], J, config.iterations,
                            config.tolerance)
            if best is None or end.energy[0] < best.energy[0]:
                best = end
            if np.sqrt(end.energy[0] / len(chosen)) < 0.02 * np.ptp(vertices, axis=0).max():
                break
        assert best is not None
        # a few more steps on all vertices
        steps = best.iterations
        if len(chosen) < subject.n_vertices and config.polish:
            best = _minimise(_equations(self._everything, vertices), best.x, J, config.polish, config.tolerance)
            steps += best.iterations
        pose, trans = best.x[0, :3 * J].reshape(J, 3), best.x[0, 3 * J:]
        fitted = np.asarray(subject.vertices(pose, trans), dtype=np.float64)
        return PoseFit(pose, trans, fitted, *_distances(fitted, vertices), bool(best.converged[0]), steps)


@one_thread()
def fit_shape(model: BodyModel, vertices: np.ndarray, config: FitConfig | None = None) -> ShapeFit:
    """Fit shape, pose and place of an unknown body to all its vertices.

    Parameters
    ----------
    model : BodyModel
        A model with shape components.
    vertices : (N, 3) float, metres
        Registered vertices, in the order of the model's template.
    config : FitConfig, optional
        Settings.

    Returns
    -------
    ShapeFit
        Betas, pose, place, the fitted vertices and their distance from the given ones.

    Raises
    ------
    ValueError
        Another number of vertices, vertices that are not finite, or a model without shape components.

    Examples
    --------
    >>> from model import load_built_in_model
    >>> model = load_built_in_model()
    >>> person = model.vertices(np.zeros((16, 3)), np.array([1.0, -2.0, 0.5]))
    >>> fit = fit_shape(model, person, FitConfig(n_betas=3))
    >>> np.allclose(fit.betas[:3], [1.0, -2.0, 0.5], atol=0.05)
    True
    """
    return ShapeFitter(model, config).fit(vertices)


class ShapeFitter:
    """`fit_shape` for many scans: what does not depend on the scan is prepared once."""

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
        """Return a fitter of the first components only, which shares the prepared points."""
        if n_betas > self.n_betas:
            raise ValueError(f"n_betas: expected 1..{self.n_betas}, got {n_betas}")
        fewer = ShapeFitter(self.model, replace(self.config, n_betas=n_betas))
        fewer._points = self._points.first(n_betas)
        return fewer

    def fit(self, vertices: np.ndarray, start: PoseFit | None = None) -> ShapeFit:
        """Fit shape, pose and place to all vertices (N, 3), from a given fit or from that of the mean person."""
        model, config, K = self.model, self.config, self.n_betas
        vertices = _check_vertices(vertices, len(model.template.vertices))
        J = len(model.skeleton.parents)
        start = start or self._mean_person.fit(vertices)
        betas = start.betas[:K] if isinstance(start, ShapeFit) else np.zeros(K)
        x = np.concatenate([start.pose.ravel(), start.trans, betas])
        # steps on a sample; then all vertices, with the sample's Gauss-Newton matrix as a first guess
        best = _minimise(_equations(self._points, vertices[self._chosen], self._share), x[None], J,
                         config.iterations, config.tolerance)
        x, converged, steps = best.x[0], bool(best.converged[0]), best.iterations
        if len(self._chosen) < len(vertices) and config.polish:
            x, converged, more = _refine_all_vertices(model, vertices, x, best.equations.hessian[0], config)
            steps += more
        pose, trans, betas = twists(x[:3 * J].reshape(J, 3)), x[3 * J:3 * J + 3], np.zeros(model.n_betas)
        betas[:K] = x[3 * J + 3:]
        fitted = model.vertices(pose, betas, trans)
        return ShapeFit(pose, trans, fitted, *_distances(fitted, vertices), converged, steps, betas)


def spread_vertices(vertices: np.ndarray, count: int) -> np.ndarray:
    """Choose at most `count` evenly spread vertices, each the farthest from those before; return indices."""
    return np.arange(len(vertices)) if count >= len(vertices) else np.sort(farthest_points(vertices, count))


def share_of_vertices(vertices: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Count how many of all vertices (N, 3) are nearest to each chosen one, (L,)."""
    nearest = cKDTree(vertices[chosen]).query(vertices)[1]
    return np.bincount(nearest, minlength=len(chosen)).astype(float)


def _starts(subject: Subject, vertices: np.ndarray) -> list[np.ndarray]:
    """List starts: every part with its own Procrustes rotation, then the whole body with that of the root."""
    J = len(subject.skeleton.parents)
    rest = subject.template.with_vertices(np.asarray(subject.vertices(np.zeros((J, 3))), dtype=np.float64))
    R = subject.skeleton.fit_rotations(rest, vertices)
    stiff = np.broadcast_to(R[0], R.shape)
    starts = []
    for rotations in (R, stiff):
        starts.append(_unknowns_of_pose(subject, vertices, subject.skeleton.pose_of(rotations.copy())))
    return starts


def _unknowns_of_pose(subject: Subject, vertices: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Compute unknowns (3J + 3,) for a pose, with the place that fits best."""
    posed = np.asarray(subject.vertices(pose), dtype=np.float64)
    return np.concatenate([pose.ravel(), (vertices - posed).mean(axis=0)])


def _minimise(equations: Callable[[np.ndarray], Dense], x: np.ndarray, J: int, iterations: int, tolerance: float
              ) -> Minimum[np.ndarray]:
    """Minimise over unknowns (1, P) that begin with a pose, whose rotations are kept below π."""
    def retract(x: np.ndarray, step: np.ndarray) -> np.ndarray:
        out = x + step
        out[0, :3 * J] = twists(out[0, :3 * J].reshape(J, 3)).ravel()
        return out

    # square metres, over all points: a step that gains less counts as no progress
    return levenberg_marquardt(equations, x, iterations, tolerance, exact=1e-15, retract=retract)


def _equations(points: PointOperator | ShapedPoints, target: np.ndarray, weights: np.ndarray | None = None
               ) -> Callable[[np.ndarray], Dense]:
    """Build the normal equations of points that should be at their targets (L, 3), with weights (L,)."""
    posed = PosedPoints(points)
    root = np.ones(len(target)) if weights is None else np.sqrt(weights)

    def equations(x: np.ndarray) -> Dense:
        y, columns = posed.columns(x[0])
        residual, columns = (root * (y - target).T).ravel(), (root * columns).reshape(posed.n_unknowns, -1)
        return Dense(np.array([residual @ residual]), (columns @ residual)[None], (columns @ columns.T)[None])

    return equations


def _refine_all_vertices(model: BodyModel, target: np.ndarray, x: np.ndarray, matrix: np.ndarray, config: FitConfig
                         ) -> tuple[np.ndarray, bool, int]:
    """Minimise over all vertices by BFGS, from the minimum of a sample and its Gauss-Newton matrix (P, P).

    Only gradients are computed. Returns the unknowns (P,), whether it converged, and the number of steps.
    """
    J3, lowest = 3 * len(model.skeleton.parents), [np.inf]
    nothing = 0.5 * target.size * (100 * np.finfo(float).eps * np.abs(target).max())**2     # rounding leaves as much

    def energy(x: np.ndarray) -> tuple[float, np.ndarray]:
        force = model.vertices(x[:J3].reshape(-1, 3), x[J3 + 3:], x[J3:J3 + 3]) - target
        by_pose, by_betas = model.pull_back(force, x[:J3].reshape(-1, 3), x[J3 + 3:])
        return 0.5 * float((force**2).sum()), np.concatenate([by_pose, force.sum(axis=0), by_betas])

    def settled(intermediate_result: OptimizeResult) -> None:
        before, lowest[0] = lowest[0], intermediate_result.fun
        if before - lowest[0] <= config.tolerance * lowest[0] or lowest[0] <= nothing:
            raise StopIteration

    start = np.linalg.inv(matrix + 1e-6 * np.diag(np.diag(matrix)))
    end = minimize(energy, x, jac=True, method="BFGS", callback=settled,
                   options={"hess_inv0": 0.5 * (start + start.T), "maxiter": config.polish, "gtol": 0.0})
    return end.x, end.nit < config.polish, end.nit


def _distances(fitted: np.ndarray, vertices: np.ndarray) -> tuple[float, float]:
    far = np.linalg.norm(fitted - vertices, axis=1)
    return float(np.sqrt((far**2).mean())), float(far.mean())


def _check_vertices(vertices: np.ndarray, count: int) -> np.ndarray:
    vertices = np.asarray(vertices, dtype=np.float64)
    if vertices.shape != (count, 3):
        raise ValueError(f"vertices: expected shape ({count}, 3), got {vertices.shape}")
    if not np.isfinite(vertices).all():
        raise ValueError("vertices: expected finite numbers")
    return vertices
