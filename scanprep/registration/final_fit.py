"""The last pass of a registration: the surface follows the scan below its noise, evenly stretched and without folds.

Rounds of three steps: measure how every triangle has rotated and stretched; smooth that field, so that folds and
needles, which differ from their surroundings, vanish from it; lay the triangles out as the smooth field says while
the data draw the surface across, but not along itself. Growth that varies smoothly costs nothing, so other people
are as welcome as other poses, and where there are no data the template continues as its surroundings rotated it.
"""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csc_array, diags_array
from scipy.spatial import cKDTree

from ..geometry.mesh import Mesh
from ..geometry.sparse import Factored, conjugate_gradients
from ..geometry.surface import OrientedPoints
from ..geometry.target import Target, orient
from ..ranges import Positive, Settings
from ..threads import search_threads
from .energies import Pull, pull
from .gradient_field import Field, Triangles
from .matches import NORMALS


@dataclass(frozen=True)
class FinalFitRound(Settings):
    """One round of `final_fit`. Lengths are multiples of the template's size, √area.

    Attributes
    ----------
    field : float
        Length over which rotations and stretches are smoothed.
    tension : float
        Distance to the data that a gradient of one off the smooth field is worth.
    reach : float
        Farthest match that counts.
    """

    field: Positive
    tension: Positive
    reach: Positive


@dataclass(frozen=True)
class FinalFitConfig(Settings):
    """Settings of `final_fit`. Lengths are multiples of the template's size, √area.

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
    """

    rounds: tuple[FinalFitRound, ...] = (
        FinalFitRound(0.02, 0.007, 0.02),
        FinalFitRound(0.015, 0.004, 0.015),
        FinalFitRound(0.015, 0.004, 0.015),
        FinalFitRound(0.015, 0.004, 0.015),
    )
    noise_width: Positive = 0.007
    slide: float = 0.05
    stay: float = 0.003
    landmarks: float = 0.0002


@dataclass(frozen=True, eq=False)
class FinalFit:
    """Where the surface came to lie: vertices (N, 3), metres, and which of them, seen (N,), had data."""

    vertices: np.ndarray
    seen: np.ndarray
    noise: float                 # metres, standard deviation of the scan across its surface
    strain: float                # root mean square over the area of the logarithm of the stretches
    roughness: float             # the same against the smooth field of stretches
    inverted: int                # triangles that face against their surroundings
    needles: int                 # triangles that are stretched too far against their surroundings
    iterations: int              # rounds and repairs
    moved: float                 # metres, of the mean vertex in the last round


def final_fit(template: Mesh, start: np.ndarray, target: Target,
              landmarks: tuple[np.ndarray, np.ndarray] | None = None, config: FinalFitConfig | None = None) -> FinalFit:
    """A template whose vertices (N, 3) lie near a scan, on it; landmarks are vertices (L,) and places (L, 3)."""
    given = _prepared(template, start, target, landmarks, config or FinalFitConfig())
    x, before, stiff = start, start, np.ones(len(template.faces))
    for stage in given.config.rounds:
        x, before = _laid_out(given, x, stage, stiff), x
    repairs = 0
    while repairs < 12 and (bad := np.logical_or(*_bad(given, x, stage))).any():
        near = np.zeros(len(x))
        near[template.faces[bad]] = 1
        stiff = np.where(near[template.faces].any(axis=1), 4 * stiff, stiff)
        x, before = _laid_out(given, x, stage, stiff), x
        repairs += 1
    inverted, needles = _bad(given, x, stage)
    measured, smooth = _fields(given, x, stage)
    return FinalFit(x, _data(given, x, stage.reach)[1], given.scan.noise, _strain(given, measured.gradient),
                    _strain(given, measured.gradient @ np.linalg.inv(smooth.gradient)), int(inverted.sum()),
                    int(needles.sum()), len(given.config.rounds) + repairs,
                    float(np.linalg.norm(x - before, axis=1).mean()))


@dataclass(frozen=True, eq=False)
class SmoothedScan:
    """Points and normals (n, 3) of a scan, moved to the smooth surface that fits their neighbours.

    `noise` is the standard deviation, metres, of the points around the fitted surfaces; `spacing` the distance between
    neighbours; `border` (n,) says which lie on the edge of a hole.
    """

    points: np.ndarray
    normals: np.ndarray
    border: np.ndarray
    noise: float
    spacing: float


def smoothed_scan(target: Target, width: float, neighbours: int = 40) -> SmoothedScan:
    """A scan with a quadratic surface fitted around every point; others count by a Gaussian of `width` metres."""
    P, n = target.points, target.normals
    apart, near = cKDTree(P).query(P, min(neighbours, len(P)), workers=search_threads(len(P)))
    agree = np.einsum("nkd,nd->nk", n[near], n)
    w = np.exp(-0.5 * (apart / width) ** 2) * np.maximum(agree, 0)
    side = np.cross(n, np.eye(3)[np.argmin(np.abs(n), axis=1)])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    axes = np.stack([side, np.cross(n, side), n], axis=1)
    u, v, h = np.moveaxis(np.einsum("nad,nkd->nka", axes, P[near] - P[:, None]) / width, 2, 0)
    basis = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=2)
    weighed = basis * w[..., None]
    normal = np.matmul(weighed.transpose(0, 2, 1), basis)
    # Few points say little about curvature: near borders the fit falls back to a plane.
    normal += np.diag([1e-9, 1e-2, 1e-2, 0.3, 0.3, 0.3])
    fit = np.linalg.solve(normal, np.einsum("nkb,nk->nb", weighed, h)[..., None])[..., 0]
    rest = np.einsum("nkb,nb->nk", basis, fit) - h
    noise = width * np.sqrt(np.median(np.sum(w * rest**2, axis=1) / np.maximum(w.sum(axis=1), 1e-12)))
    normals = n - fit[:, 1:2] * axes[:, 0] - fit[:, 2:3] * axes[:, 1]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    spacing = np.median(apart[:, min(4, apart.shape[1] - 1)])
    return SmoothedScan(P + width * np.clip(fit[:, :1], -1, 1) * n, normals, target.border, float(noise),
                        float(spacing))


@dataclass(frozen=True, eq=False)
class _Given:
    """What does not change: the template, where it began, the scan, what holds it everywhere."""

    template: Mesh
    start: np.ndarray
    config: FinalFitConfig
    size: float
    triangles: Triangles
    areas: np.ndarray
    scan: SmoothedScan
    held: Pull


def _prepared(template: Mesh, start: np.ndarray, target: Target, landmarks: tuple[np.ndarray, np.ndarray] | None,
              config: FinalFitConfig) -> _Given:
    size, N = float(np.sqrt(template.face_areas.sum())), len(start)
    areas = np.maximum(template.vertex_areas, 1e-3 * template.vertex_areas.mean())
    scan = smoothed_scan(orient(target, template.with_vertices(start), NORMALS * size), config.noise_width * size)
    held = pull(N, np.arange(N), start, 1e-9 * areas)
    if landmarks is not None:
        held += pull(N, *landmarks, np.full(len(landmarks[0]), config.landmarks * size**2))
    return _Given(template, start, config, size, Triangles(template), areas, scan, held)


def _fields(given: _Given, x: np.ndarray, stage: FinalFitRound) -> tuple[Field, Field]:
    """The field of rotations and stretches measured, and the smooth one, in which what disagrees counts little."""
    measured = given.triangles.measured(x)
    weights = np.ones(len(given.template.faces))
    for _ in range(2):
        smooth = given.triangles.smoothed(measured, stage.field * given.size, weights)
        off = np.linalg.norm(measured.gradient - smooth.gradient, axis=(1, 2))
        weights = 1 / (1 + (off / 0.5) ** 2) ** 2
    return measured, smooth


def _data(given: _Given, x: np.ndarray, reach: float) -> tuple[Pull, np.ndarray]:
    """Vertices drawn to the tangent planes of the nearest smoothed points with like normals, and which (N,) are."""
    reach, scan, body = reach * given.size, given.scan, given.template.with_vertices(x)
    found = OrientedPoints(scan.points, scan.normals, NORMALS * given.size).match(x, body.vertex_normals, reach)
    # At the edge of a hole a point speaks for its own neighbourhood, not for what lies beyond the edge.
    beside = np.linalg.norm(np.cross(scan.normals[found.index], x - scan.points[found.index]), axis=1)
    seen = found.valid & (~scan.border[found.index] | (beside <= scan.spacing))
    v = np.flatnonzero(seen)
    p = found.index[v]
    weights = given.areas[v] * np.maximum(1 - (found.distances[v] / reach) ** 2, 0) ** 2
    return pull(len(x), v, scan.points[p], weights, scan.normals[p], given.config.slide), seen


def _laid_out(given: _Given, x: np.ndarray, stage: FinalFitRound, stiff: np.ndarray) -> np.ndarray:
    """Vertices that come nearest to the smooth field of gradients and to what the data want of them."""
    _, smooth = _fields(given, x, stage)
    wanted, seen = _data(given, x, stage.reach)
    # Rounds of smoothing would straighten a limb that nothing holds: there the start is all that is known.
    wanted = wanted + given.held + pull(len(x), np.arange(len(x)), given.start,
                                        given.config.stay * ~seen * given.areas)
    weights = (stage.tension * given.size)**2 * given.triangles.areas * stiff
    K = given.triangles.stiffness(weights)
    across = np.linalg.eigvalsh(wanted.A)[:, 2]
    nearly = Factored(csc_array(K + diags_array(across)))
    force = given.triangles.force(weights, smooth.gradient) + wanted.b
    force -= K @ x + np.einsum("nij,nj->ni", wanted.A, x)
    return x + conjugate_gradients(lambda d: K @ d + np.einsum("nij,nj->ni", wanted.A, d), force, nearly.solve)


def _bad(given: _Given, x: np.ndarray, stage: FinalFitRound) -> tuple[np.ndarray, np.ndarray]:
    """(F,) bool twice: triangles that face against their surroundings, and needles."""
    measured, smooth = _fields(given, x, stage)
    n = given.template.face_normals[..., None]
    inverted = np.einsum("fdk,fdk->f", measured.R @ n, smooth.R @ n) < 0
    relative = np.linalg.svd(measured.gradient @ np.linalg.inv(smooth.gradient), compute_uv=False)
    return inverted, (relative[:, 0] > 4) | (relative[:, 2] < 1 / 4)


def _strain(given: _Given, gradient: np.ndarray) -> float:
    stretch = np.log(np.linalg.svd(gradient, compute_uv=False))
    return float(np.sqrt(np.average((stretch**2).mean(axis=1), weights=given.triangles.areas)))
