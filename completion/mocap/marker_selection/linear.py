"""Estimate bodies from markers, linearised around the fit to their whole surface."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.body import BodyModel
from model.fitting.vertices import FitConfig, ShapeFitter, share_of_vertices, spread_vertices
from model.linear import check_pose
from model.posing.transfer import own_body
from scanprep.geometry import rotations
from scanprep.geometry.farthest_points import farthest_points

from ...motion import Progress
from ..marker_sets.layout import MarkerLayout
from .fits import BodyPoints, DesignConfig, Prior, fit_points, prior_around, rough_poses

FIT_ITERATIONS = 20                  # most steps of the fit to the whole surface, and of a full refit
SURFACE = 1000                       # vertices that stand for the surface while sets are compared, 5 cm apart on people


@dataclass(frozen=True, eq=False)
class LinearBodies:
    """Bodies whose points are affine in a step d of their unknowns, from the fit to the whole surface.

    From markers T the step is `d = (Λ + Σ_T BᵀB)⁻¹ (l + Σ_T Bᵀ g)`. The surface then has a mean squared distance of
    `dᵀ G d - 2 dᵀ p + c`.
    """

    rows: np.ndarray                 # (Z, C, r, P), B: derivatives of every candidate, over `marker_sd`
    gaps: np.ndarray                 # (Z, C, r), g: offset of the marker from its simulation, over `marker_sd`
    gram: np.ndarray                 # (Z, P, P), square metres, G
    pull: np.ndarray                 # (Z, P), square metres, p
    rest: np.ndarray                 # (Z,), square metres, c: error of the fit to the whole surface
    precision: np.ndarray            # (P, P), Λ of the priors
    lean: np.ndarray                 # (Z, P), l: pull of the priors

    def steps(self, chosen: Sequence[int] | np.ndarray) -> np.ndarray:
        """Solve for the steps (Z, P) of all bodies from chosen candidates. [MoSh] Eq. 26"""
        Z, _, _, P = self.rows.shape
        B = self.rows[:, chosen].reshape(Z, -1, P)
        transposed = np.swapaxes(B, -1, -2)
        right = self.lean + (transposed @ self.gaps[:, chosen].reshape(Z, -1, 1))[..., 0]
        return np.asarray(np.linalg.solve(transposed @ B + self.precision, right[..., None])[..., 0])

    def surface_error(self, steps: np.ndarray) -> np.ndarray:
        """Compute the mean squared distance (Z,) of the surface, square metres, after steps (Z, P)."""
        return np.asarray(((steps[:, None] @ self.gram)[:, 0] * steps - 2 * self.pull * steps).sum(axis=1) + self.rest)

    def rmse(self, chosen: Sequence[int] | np.ndarray) -> float:
        """Compute the RMSE over all vertices and bodies, metres, from chosen candidates. [MoSh] Eq. 27"""
        return float(np.sqrt(self.surface_error(self.steps(chosen)).mean()))

    def of(self, bodies: np.ndarray) -> LinearBodies:
        """Return some of the bodies."""
        return LinearBodies(self.rows[bodies], self.gaps[bodies], self.gram[bodies], self.pull[bodies],
                            self.rest[bodies], self.precision, self.lean[bodies])


@dataclass(frozen=True, eq=False)
class WholeFits:
    """Bodies, their candidate markers, and the model fitted to their whole surface."""

    x: np.ndarray                    # (Z, P) unknowns: pose, trans, betas
    markers: BodyPoints              # the candidates, on the skin
    places: np.ndarray               # (Z, C, 3), metres: their places on the bodies
    prior: Prior
    linear: LinearBodies

    def refit(self, chosen: Sequence[int] | np.ndarray, config: DesignConfig) -> np.ndarray:
        """Fit unknowns (Z, P) to some candidates without linearisation, from that of the whole body. [MoSh] Eq. 26"""
        chosen = np.asarray(chosen)
        weights = np.full(len(chosen), config.marker_sd**-2)
        return fit_points(self.markers.some(chosen), self.places[:, chosen], weights, self.prior, self.x,
                          FIT_ITERATIONS)


def fit_bodies(model: BodyModel, bodies: np.ndarray, candidates: MarkerLayout, config: DesignConfig,
               progress: Progress | None = None) -> WholeFits:
    """Fit the model to every whole body (Z, N, 3), metres, in any poses, and linearise there."""
    bodies, n_betas = check_marker_bodies(model, bodies), model.n_betas
    N, most = len(model.template.vertices), int(np.max(candidates.vertices, initial=0))
    if not candidates.labels or most >= N:
        raise ValueError(f"candidates: expected markers on vertices 0..{N - 1}, got {len(candidates.labels)} markers "
                         f"up to vertex {most}")
    report_progress, template, sd = progress or (lambda done, total: None), model.template.vertices, config.marker_sd
    # fit to the whole surface, represented by 400 spread vertices, each weighted by its share
    sample = spread_vertices(template, 400)
    weights = share_of_vertices(template, sample) * len(sample) / (len(template) * sd**2)
    start = rough_poses(model, bodies, n_betas)
    x = fit_points(BodyPoints(model.points(sample, None, n_betas)), bodies[:, sample], weights,
                   prior_around(model, start), start, FIT_ITERATIONS,
                   lambda done: report_progress(done, 2 * len(bodies)))
    ids, shares = candidates.skin
    markers, prior = BodyPoints(model.points(ids, shares, n_betas)), prior_around(model, x)
    places = np.einsum("lk,zlkd->zld", shares, bodies[:, ids])

    # linearise markers and surface there, in batches of bodies
    spread = spread_vertices(template, SURFACE)
    surface = BodyPoints(model.points(spread, None, n_betas))
    root = np.sqrt(share_of_vertices(template, spread) / len(template))[:, None]
    (Z, P), C = x.shape, markers.count
    rows, gaps = np.empty((Z, C, 3, P)), np.empty((Z, C, 3))
    gram, pull, rest = np.empty((Z, P, P)), np.empty((Z, P)), np.empty(Z)
    size = min(surface.batch, markers.batch)
    for begin in range(0, Z, size):
        some = slice(begin, begin + size)
        at = markers.follow(x[some])
        rows[some], gaps[some] = at.jacobian / sd, (places[some] - at.positions) / sd
        at = surface.follow(x[some])
        J = (root[..., None] * at.jacobian).reshape(len(at.positions), -1, P)
        e = (root * (bodies[some][:, spread] - at.positions)).reshape(len(J), -1, 1)
        transposed = np.swapaxes(J, -1, -2)
        gram[some], pull[some], rest[some] = transposed @ J, (transposed @ e)[..., 0], (e**2).sum(axis=(1, 2))
        report_progress(Z + min(begin + size, Z), 2 * Z)
    linear = LinearBodies(rows, gaps, gram, pull, rest, prior.precision, (prior.mean - x) @ prior.precision)
    return WholeFits(x, markers, places, prior, linear)


def check_marker_bodies(model: BodyModel, bodies: np.ndarray) -> np.ndarray:
    """Return bodies (Z, N, 3) as an array; ValueError for another shape, or for a model without betas."""
    if not model.n_betas:
        raise ValueError("model: expected one with betas, this one knows its template's body only")
    bodies, wanted = np.asarray(bodies), model.template.vertices.shape
    if bodies.ndim != 3 or not len(bodies) or bodies.shape[1:] != wanted or not np.isfinite(bodies).all():
        raise ValueError(f"bodies: expected finite numbers of shape (Z, {wanted[0]}, 3), got shape {bodies.shape}")
    return bodies


def example_poses(model: BodyModel, count: int) -> np.ndarray:
    """Return poses (count, J, 3) of the training set that differ most; the first is the most usual one."""
    examples = model.pose_examples
    if not 1 <= count <= len(examples):
        raise ValueError(f"count: expected 1..{len(examples)} poses, those that the model keeps, got {count}")
    turned = rotations.exp(examples).reshape(len(examples), -1)
    usual = ((turned - turned.mean(axis=0))**2).sum(axis=1).argmin()
    return examples[farthest_points(turned, count, usual, least=-0.5)]


def in_poses(model: BodyModel, bodies: np.ndarray, poses: np.ndarray,
             progress: Progress | None = None) -> np.ndarray:
    """Put registered bodies (Z, N, 3), metres, with their own shape into poses (F, J, 3): (Z, F, N, 3) float32."""
    bodies = check_marker_bodies(model, bodies)
    poses, _ = check_pose(model.skeleton, poses, None)
    fitter, report_progress = ShapeFitter(model, FitConfig(polish=0)), progress or (lambda done, total: None)
    out = np.empty((len(bodies), len(poses), *bodies.shape[1:]), dtype=np.float32)
    for i, body in enumerate(np.asarray(bodies, dtype=np.float64)):
        out[i] = own_body(model, body, fitter.fit(body)).subject.vertices(poses)
        report_progress(i + 1, len(bodies))
    return out
