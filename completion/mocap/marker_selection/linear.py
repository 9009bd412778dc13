"""Bodies estimated from markers, linearised around the fit to their whole surface."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from model.body import BodyModel
from model.fitting import share_of_vertices, spread_vertices

from ..marker_sets.layout import MarkerLayout
from .fits import Prior, fit_points, prior_around, rough_poses
from .points import BodyPoints
from .settings import DesignConfig

Progress = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class LinearBodies:
    """Bodies whose every point is affine in a step d of their unknowns, near where the whole surface has them.

    From markers T the step is `(Λ + Σ_T BᵀB)⁻¹ (l + Σ_T Bᵀ g)`, and leaves the surface a mean squared distance of
    `dᵀ G d - 2 dᵀ p + c`.

    Attributes
    ----------
    rows : (Z, C, r, P) float
        B: derivatives of every candidate, over the standard deviation of a marker.
    gaps : (Z, C, r) float
        g: how far it is from where the body has it, over the same.
    gram : (Z, P, P) float, square metres
        G
    pull : (Z, P) float, square metres
        p
    rest : (Z,) float, square metres
        c: what the model cannot reach.
    precision : (P, P) float
        Λ of the priors.
    lean : (Z, P) float
        l: where the priors pull.
    """

    rows: np.ndarray
    gaps: np.ndarray
    gram: np.ndarray
    pull: np.ndarray
    rest: np.ndarray
    precision: np.ndarray
    lean: np.ndarray

    def steps(self, chosen: Sequence[int] | np.ndarray) -> np.ndarray:
        """(Z, P) from these candidates, each solved for by itself.

        [MoSh] Eq. 26
        """
        Z, _, _, P = self.rows.shape
        B = self.rows[:, chosen].reshape(Z, -1, P)
        transposed = np.swapaxes(B, -1, -2)
        right = self.lean + (transposed @ self.gaps[:, chosen].reshape(Z, -1, 1))[..., 0]
        return np.asarray(np.linalg.solve(transposed @ B + self.precision, right[..., None])[..., 0])

    def left(self, steps: np.ndarray) -> np.ndarray:
        """(Z,) mean squared distance of the surface, square metres, after steps (Z, P)."""
        return np.asarray(((steps[:, None] @ self.gram)[:, 0] * steps - 2 * self.pull * steps).sum(axis=1) + self.rest)

    def rmse(self, chosen: Sequence[int] | np.ndarray) -> float:
        """Root of the mean squared distance, metres, over all vertices and bodies.

        [MoSh] Eq. 27
        """
        return float(np.sqrt(self.left(self.steps(chosen)).mean()))

    def of(self, bodies: np.ndarray) -> LinearBodies:
        """Some of the bodies only."""
        return LinearBodies(self.rows[bodies], self.gaps[bodies], self.gram[bodies], self.pull[bodies],
                            self.rest[bodies], self.precision, self.lean[bodies])


@dataclass(frozen=True, eq=False)
class WholeFits:
    """Bodies, their candidates, and the model fitted to their whole surfaces.

    Attributes
    ----------
    x : (Z, P) float
        Unknowns (pose, trans, betas).
    markers : BodyPoints
        The candidates, on the skin.
    places : (Z, C, 3) float, metres
        Where they are on the bodies.
    prior : Prior
    linear : LinearBodies
    """

    x: np.ndarray
    markers: BodyPoints
    places: np.ndarray
    prior: Prior
    linear: LinearBodies

    def refitted(self, chosen: Sequence[int] | np.ndarray, config: DesignConfig,
                 tell: Callable[[int], None] | None = None) -> np.ndarray:
        """Unknowns (Z, P) from some candidates without linearising, from the fit to the whole body on.

        [MoSh] Eq. 26
        """
        chosen = np.asarray(chosen)
        weights = np.full(len(chosen), config.marker_sd**-2)
        return fit_points(self.markers.some(chosen), self.places[:, chosen], weights, self.prior, self.x,
                          config.fit_iterations, tell)


def fit_bodies(model: BodyModel, bodies: np.ndarray, candidates: MarkerLayout, config: DesignConfig,
               progress: Progress | None = None) -> WholeFits:
    """Fit the model to every whole body, and linearise there.

    Parameters
    ----------
    model : BodyModel
        With betas.
    bodies : (Z, N, 3) float, metres
        In the topology of the model's template, in any poses.
    candidates : MarkerLayout
        Their distance from the skin is not used.

    Raises
    ------
    ValueError
        A model without betas, bodies of another shape or not finite, a layout of another body.
    """
    bodies, n_betas = check_bodies(model, bodies), _check(model, candidates, config)
    tell = progress or (lambda done, total: None)
    template, total = model.template.vertices, 2 * len(bodies)
    few = spread_vertices(template, config.fit_surface)
    weights = share_of_vertices(template, few) * len(few) / (len(template) * config.marker_sd**2)
    start = rough_poses(model, bodies, n_betas)
    x = fit_points(BodyPoints(model.points(few, None, n_betas)), bodies[:, few], weights,
                   prior_around(model, start, config), start, config.fit_iterations, lambda done: tell(done, total))
    ids, shares = support(candidates)
    markers, prior = BodyPoints(model.points(ids, shares, n_betas)), prior_around(model, x, config)
    places = np.einsum("lk,zlkd->zld", shares, bodies[:, ids])
    some = spread_vertices(template, config.surface)
    surface = BodyPoints(model.points(some, None, n_betas))
    share = share_of_vertices(template, some) / len(template)
    linear = _linearised(x, markers, places, surface, bodies[:, some], share, prior, config.marker_sd,
                         lambda done: tell(len(bodies) + done, total))
    return WholeFits(x, markers, places, prior, linear)


def check_bodies(model: BodyModel, bodies: np.ndarray) -> np.ndarray:
    """The bodies (Z, N, 3) as an array, or ValueError; also for a model without betas."""
    if not model.n_betas:
        raise ValueError("model: expected one with betas, this one knows its template's body only")
    bodies, wanted = np.asarray(bodies), model.template.vertices.shape
    if bodies.ndim != 3 or not len(bodies) or bodies.shape[1:] != wanted or not np.isfinite(bodies).all():
        raise ValueError(f"bodies: expected finite numbers of shape (Z, {wanted[0]}, 3), got shape {bodies.shape}")
    return bodies


def _check(model: BodyModel, candidates: MarkerLayout, config: DesignConfig) -> int:
    """How many betas are estimated."""
    n_betas = model.n_betas if config.n_betas is None else config.n_betas
    if not 0 < n_betas <= model.n_betas:
        raise ValueError(f"n_betas: expected 1..{model.n_betas}, got {n_betas}")
    N, most = len(model.template.vertices), int(np.max(candidates.vertices, initial=0))
    if not candidates.labels or most >= N:
        raise ValueError(f"candidates: expected markers on vertices 0..{N - 1}, got {len(candidates.labels)} markers "
                         f"up to vertex {most}")
    return n_betas


def support(layout: MarkerLayout) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and weights (C, k) of the points of the skin under the markers."""
    ids = layout.vertices.reshape(len(layout.labels), -1)
    return ids, np.ones(ids.shape) if layout.weights is None else layout.weights


def _linearised(x: np.ndarray, markers: BodyPoints, places: np.ndarray, surface: BodyPoints, targets: np.ndarray,
                share: np.ndarray, prior: Prior, sd: float, tell: Callable[[int], None]) -> LinearBodies:
    """`LinearBodies` at x (Z, P); the surface's points (L) stand for shares (L,) of it."""
    (Z, P), C, root = x.shape, markers.count, np.sqrt(share)[:, None]
    rows, gaps = np.empty((Z, C, 3, P)), np.empty((Z, C, 3))
    gram, pull, rest = np.empty((Z, P, P)), np.empty((Z, P)), np.empty(Z)
    size = min(surface.batch, markers.batch)
    for begin in range(0, Z, size):
        some = slice(begin, begin + size)
        at = markers.follow(x[some])
        rows[some], gaps[some] = at.jacobian / sd, (places[some] - at.positions) / sd
        at = surface.follow(x[some])
        J = (root[..., None] * at.jacobian).reshape(len(at.positions), -1, P)
        e = (root * (targets[some] - at.positions)).reshape(len(J), -1, 1)
        transposed = np.swapaxes(J, -1, -2)
        gram[some], pull[some], rest[some] = transposed @ J, (transposed @ e)[..., 0], (e**2).sum(axis=(1, 2))
        tell(min(begin + size, Z))
    lean = (prior.mean - x) @ prior.precision
    return LinearBodies(rows, gaps, gram, pull, rest, prior.precision, lean)
