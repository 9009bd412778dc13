"""The last pass of a registration: the surface settles on the scan, evenly stretched and without folds.

Rounds of three steps: measure how every triangle has turned and stretched; smooth that field, so that folds and
needles, which differ from their surroundings, vanish from it; lay the triangles out as the smooth field says while
the data draw the surface across, but not along itself. Growth that varies smoothly costs nothing, so other people
are as welcome as other poses, and where there are no data the template continues as its surroundings turned it.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from scipy.sparse import csc_array, diags_array

from ..geometry.mesh import Mesh, check_template
from ..geometry.sparse import Factored
from ..ranges import Count, Positive, Range, Settings
from .energies import Pull, pull
from .final_fit_data import Skin, Touch, oriented, skin_of, touch
from .final_fit_field import Field, Triangles
from .matches import Target, target_of
from .shell import conjugate_gradients


@dataclass(frozen=True)
class SettleRound(Settings):
    """One round of `settle`. Lengths are multiples of the template's size, √area.

    Attributes
    ----------
    field : float
        Length over which turns and stretches are smoothed.
    tension : float
        Distance to the data that a gradient of one off the smooth field is worth.
    reach : float
        Farthest match that counts.
    """

    field: Positive
    tension: Positive
    reach: Positive


@dataclass(frozen=True)
class SettleConfig(Settings):
    """Settings of `settle`. Lengths are multiples of the template's size, √area.

    Attributes
    ----------
    rounds : of measuring, smoothing and laying out
    noise_width : float
        Neighbourhood over which the scan's noise is averaged.
    slide : float
        Force of the data along the surface, as a share of that across it.
    stay : float
        Force towards the start where there are no data, as a share of what the data would have.
    landmarks : float
        The share of the surface that one landmark weighs as much as.
    normal_weight : float
        Distance that a difference of normals of one is worth when matching.
    neighbours : int
        Points of the scan over which its normals are averaged, where a scan and not a `Target` is given.
    limit : float
        Stretch against the smooth field, or its inverse, beyond which a triangle counts as a needle.
    stiffer : float
        Factor by which folded triangles, needles and their neighbours grow stiffer, as often as it takes.
    repairs : int
        Most times of that.
    settled : float
        Converged when the last round moves the mean vertex by less than this.
    """

    rounds: tuple[SettleRound, ...] = (
        SettleRound(0.02, 0.007, 0.02),
        SettleRound(0.015, 0.004, 0.015),
        SettleRound(0.015, 0.004, 0.015),
        SettleRound(0.015, 0.004, 0.015),
    )
    noise_width: Positive = 0.007
    slide: float = 0.05
    stay: float = 0.003
    landmarks: float = 0.0002
    normal_weight: float = 0.04
    neighbours: Count = 16
    limit: Annotated[float, Range(1)] = 4.0
    stiffer: Annotated[float, Range(1)] = 4.0
    repairs: int = 12
    settled: float = 0.001


@dataclass(frozen=True, eq=False)
class Settled:
    """Where the surface came to lie.

    Attributes
    ----------
    vertices : (N, 3) float, metres
    seen : (N,) bool
        Whether there were data here.
    distances : (N,) float, metres
        From each vertex seen to the smoothed scan; NaN for the others.
    noise : float, metres
        Of the scan, standard deviation across its surface.
    strain : float
        Root mean square over the area of the logarithm of the stretches against the template.
    roughness : float
        The same against the smooth field of stretches.
    flipped : int
        Triangles that face against their surroundings.
    needles : int
        Triangles stretched beyond the limit against their surroundings.
    iterations : int
        Rounds and repairs.
    converged : bool
    """

    vertices: np.ndarray
    seen: np.ndarray
    distances: np.ndarray
    noise: float
    strain: float
    roughness: float
    flipped: int
    needles: int
    iterations: int
    converged: bool


def settle(template: Mesh, start: np.ndarray, target: Target | Mesh | np.ndarray,
           landmarks: tuple[np.ndarray, np.ndarray] | None = None, config: SettleConfig | None = None,
           confidence: np.ndarray | None = None, extra: Pull | None = None,
           progress: Callable[[int, int], None] | None = None) -> Settled:
    """Let a template that lies near a scan settle on it.

    Parameters
    ----------
    template : Mesh
    start : (N, 3) float, metres
        Its vertices near the scan.
    target : Target, Mesh or (n, 3) float, metres
    landmarks : (L,) int and (L, 3) float, metres, optional
    confidence : (N,) float, optional
        How far the data near each vertex are trusted, from 0 to 1.
    extra : Pull, optional
        What else draws the vertices, such as correspondences.
    progress : callable, optional
        Called as progress(done, total).

    Raises
    ------
    ValueError
        A template that is not one manifold component, vertices of another shape or not finite.
    """
    config = config or SettleConfig()
    check_template(template)
    start, trust = _checked(template, start, confidence)
    goal = target if isinstance(target, Target) else target_of(target, config.neighbours)
    rest = _Settling(template, start, goal, landmarks, config, trust, extra)
    total = len(config.rounds)
    for k, stage in enumerate(config.rounds):
        rest.round(stage)
        if progress:
            progress(k + 1, total)
    rest.repair(config.rounds[-1])
    return rest.result(config.rounds[-1])


class _Settling:
    """A surface on its way: where it lies, what holds it, how stiff each triangle is."""

    def __init__(self, template: Mesh, start: np.ndarray, target: Target,
                 landmarks: tuple[np.ndarray, np.ndarray] | None, config: SettleConfig, trust: np.ndarray,
                 extra: Pull | None) -> None:
        self.template, self.config, self.trust, self.x, self.start = template, config, trust, start, start
        self.size = float(np.sqrt(template.face_areas.sum()))
        self.triangles = Triangles(template)
        self.areas = np.maximum(template.vertex_areas, 1e-3 * template.vertex_areas.mean())
        normals = config.normal_weight * self.size
        self.skin: Skin = skin_of(oriented(target, template.with_vertices(start), normals),
                                  config.noise_width * self.size)
        self.held = self._held(start, landmarks, extra)
        self.stiff = np.ones(len(template.faces))
        self.iterations, self.moved = 0, np.inf

    def _held(self, start: np.ndarray, landmarks: tuple[np.ndarray, np.ndarray] | None, extra: Pull | None) -> Pull:
        N, everywhere = len(start), np.arange(len(start))
        held = pull(N, everywhere, start, 1e-9 * self.areas)
        if landmarks is not None:
            weights = np.full(len(landmarks[0]), self.config.landmarks * self.size**2)
            held += pull(N, landmarks[0], landmarks[1], weights)
        return held if extra is None else held + extra

    def field(self, length: float) -> tuple[Field, Field, np.ndarray]:
        """The field measured, the smooth one, and the weights of triangles that agree with it."""
        measured = self.triangles.measured(self.x)
        weights = np.ones(len(self.template.faces))
        for _ in range(2):
            smooth = self.triangles.smoothed(measured, length, weights)
            off = np.linalg.norm(measured.gradient - smooth.gradient, axis=(1, 2))
            weights = 1 / (1 + (off / 0.5) ** 2) ** 2
        return measured, smooth, weights

    def touch(self, reach: float) -> Touch:
        """The data near the surface as it lies."""
        return touch(self.template.with_vertices(self.x), self.areas, self.skin, reach * self.size,
                     self.config.slide, self.config.normal_weight * self.size, self.trust)

    def round(self, stage: SettleRound) -> None:
        """Measure, smooth, and lay out anew under the pull of the data."""
        _, smooth, _ = self.field(stage.field * self.size)
        data = self.touch(stage.reach)
        # Rounds of smoothing would straighten a limb that nothing holds: there the start is all that is known.
        free = 1 - self.trust * data.seen
        stay = pull(len(self.x), np.arange(len(self.x)), self.start, self.config.stay * free * self.areas)
        x = self.laid(smooth, data.wanted + self.held + stay, stage.tension * self.size)
        self.moved = float(np.linalg.norm(x - self.x, axis=1).mean())
        self.x = x
        self.iterations += 1

    def laid(self, field: Field, wanted: Pull, tension: float) -> np.ndarray:
        """Vertices that come nearest to a field of gradients and to what is wanted of them."""
        weights = tension**2 * self.triangles.areas * self.stiff
        K = self.triangles.stiffness(weights)
        across = np.linalg.eigvalsh(wanted.A)[:, 2]
        nearly = Factored(csc_array(K + diags_array(across)))
        force = self.triangles.force(weights, field.gradient) + wanted.b
        force -= K @ self.x + np.einsum("nij,nj->ni", wanted.A, self.x)
        return self.x + conjugate_gradients(lambda d: K @ d + np.einsum("nij,nj->ni", wanted.A, d), force,
                                            nearly.solve)

    def bad(self, length: float) -> tuple[np.ndarray, np.ndarray]:
        """(F,) bool twice: triangles that face against their surroundings, and needles."""
        measured, smooth, _ = self.field(length)
        n = self.template.face_normals[..., None]
        flipped = np.einsum("fdk,fdk->f", measured.R @ n, smooth.R @ n) < 0
        relative = np.linalg.svd(measured.gradient @ np.linalg.inv(smooth.gradient), compute_uv=False)
        return flipped, (relative[:, 0] > self.config.limit) | (relative[:, 2] < 1 / self.config.limit)

    def repair(self, stage: SettleRound) -> None:
        """Stiffen triangles that are folded or needles, and their neighbours, until there are none."""
        for _ in range(self.config.repairs):
            bad = np.logical_or(*self.bad(stage.field * self.size))
            if not bad.any():
                return
            near = np.zeros(len(self.x))
            near[self.template.faces[bad]] = 1
            self.stiff[near[self.template.faces].any(axis=1)] *= self.config.stiffer
            self.round(stage)

    def result(self, stage: SettleRound) -> Settled:
        """What was reached."""
        flipped, needles = self.bad(stage.field * self.size)
        measured, smooth, _ = self.field(stage.field * self.size)
        found = self.touch(stage.reach)
        return Settled(self.x, found.seen, found.distances, self.skin.noise, self._strain(measured.gradient),
                       self._strain(measured.gradient @ np.linalg.inv(smooth.gradient)), int(flipped.sum()),
                       int(needles.sum()), self.iterations, self.moved <= self.config.settled * self.size)

    def _strain(self, gradient: np.ndarray) -> float:
        stretch = np.log(np.linalg.svd(gradient, compute_uv=False))
        return float(np.sqrt(np.average((stretch**2).mean(axis=1), weights=self.triangles.areas)))


def _checked(template: Mesh, start: np.ndarray, confidence: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    start = np.asarray(start, dtype=np.float64)
    if start.shape != template.vertices.shape:
        raise ValueError(f"start: expected shape {template.vertices.shape}, got {start.shape}")
    if not np.isfinite(start).all():
        raise ValueError(f"start: {(~np.isfinite(start).all(axis=1)).sum()} vertices are not finite")
    trust = np.ones(len(start)) if confidence is None else np.asarray(confidence, dtype=np.float64)
    if trust.shape != (len(start),) or not ((trust >= 0) & (trust <= 1)).all():
        raise ValueError(f"confidence: expected {len(start)} numbers from 0 to 1, got shape {trust.shape}")
    return start, trust
