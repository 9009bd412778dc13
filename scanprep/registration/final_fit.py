"""The last pass of a registration: the surface follows the scan to its noise, evenly stretched and without folds.

Each round has three steps:

1. Measure how every triangle has rotated and stretched.
2. Smooth that field. Folds and needles differ from their surroundings, so they vanish.
3. Solve for vertices that follow the smooth field, while the data pull them along the surface normal.

Stretch that varies smoothly costs nothing, so other body shapes are as easy as other poses. Where there are no data the
template continues as its surroundings rotated it.
"""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csc_array, diags_array
from scipy.spatial import cKDTree

from ..geometry.mesh import Mesh
from ..geometry.sparse import Factored, conjugate_gradients
from ..geometry.surface import OrientedPoints
from ..geometry.target import Target, orient_by_mesh
from ..threads import search_threads
from .matches import NORMALS, QuadraticTargets, pull, tukey
from .schedule import NOISE_WIDTH
from .stretches import Field, gradient_operator

# Lengths are in sizes. Each round: how wide rotations and stretches are smoothed, the distance to the data that costs
# as much as a unit deviation from the smooth field, and the largest distance of a match. Wide first, so that folds
# and tangential errors of the coarse registration vanish; then as fine as noise allows.
ROUNDS = ((0.02, 0.007, 0.02), *3 * ((0.015, 0.004, 0.015),))
SLIDE = 0.05                     # pull of the data along the surface, as a share of that across it
STAY = 0.003                     # pull to the start where there are no data, against the pull of data
MARK = 0.0002                    # weight of a landmark, as a share of the surface: clicks are off by millimetres


@dataclass(frozen=True, eq=False)
class FinalFit:
    """The fitted surface: vertices (N, 3), metres, and which of them, seen (N,), had data."""

    vertices: np.ndarray
    seen: np.ndarray
    noise: float                 # metres, standard deviation of the scan across its surface
    strain: float                # root mean square over the area of the logarithm of the stretches
    iterations: int              # rounds and repairs
    moved: float                 # metres, of the mean vertex in the last round


def final_fit(template: Mesh, start: np.ndarray, target: Target,
              landmarks: tuple[np.ndarray, np.ndarray] | None = None, noise_width: float = NOISE_WIDTH) -> FinalFit:
    """Fit a template that already lies near a scan, vertices (N, 3), to its surface.

    Landmarks are vertices (L,) of the template and points (L, 3) of the scan. The noise of the scan is averaged over a
    neighbourhood of `noise_width` sizes.
    """
    surface = _SurfaceFit(template, start, target, landmarks, noise_width)
    x, before, stiff = start, start, np.ones(len(template.faces))
    # measure, smooth and solve; each round starts from the result of the last
    for smoothing, tension, reach in ROUNDS:
        x, before = surface.lay_out(x, surface.fields(x, smoothing)[1], tension, reach, stiff), x
    # repairs: around folds and needles the smooth field gets four times the weight each time, at most twelve times
    for repairs in range(13):
        measured, smooth = surface.fields(x, smoothing)
        n = template.face_normals[..., None]
        inverted = np.einsum("fdk,fdk->f", measured.R @ n, smooth.R @ n) < 0
        relative = measured.gradient @ np.linalg.inv(smooth.gradient)
        stretches = np.maximum(np.linalg.eigvalsh(relative.transpose(0, 2, 1) @ relative), 1e-12)       # their squares
        # a needle is stretched or squeezed four times more than the smooth field around it says
        needles = (stretches[:, 2] > 4**2) | (stretches[:, 0] < 1 / 4**2)
        if repairs == 12 or not (inverted | needles).any():
            break
        near = np.zeros(len(x))
        near[template.faces[inverted | needles]] = 1
        stiff = np.where(near[template.faces].any(axis=1), 4 * stiff, stiff)
        x, before = surface.lay_out(x, smooth, tension, reach, stiff), x
    # report RMS log-stretch over the area
    strain = float(np.sqrt(np.average((measured.log_S**2).sum(axis=(1, 2)) / 3, weights=surface.triangles.areas)))
    return FinalFit(x, surface.data(x, reach)[1], surface.scan.noise, strain, len(ROUNDS) + repairs,
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


def smooth_scan(target: Target, width: float) -> SmoothedScan:
    """Denoise a scan: fit a quadratic surface around every point, with Gaussian weights of `width` metres."""
    P, n = target.points, target.normals
    apart, near = cKDTree(P).query(P, min(40, len(P)), workers=search_threads(len(P)))
    # two thousand points at a time: their neighbours fit into the cache
    blocks = (slice(first, first + 2000) for first in range(0, len(P), 2000))
    fitted = [_fit_surfaces(P[at], n[at], P[near[at]], n[near[at]], apart[at], width) for at in blocks]
    points, normals, rest = (np.concatenate(part) for part in zip(*fitted, strict=True))
    # the fourth neighbour is steadier than the first where views overlap
    spacing = np.median(apart[:, min(4, apart.shape[1] - 1)])
    return SmoothedScan(points, normals, target.border, float(np.sqrt(np.median(rest))), float(spacing))


def _fit_surfaces(P: np.ndarray, n: np.ndarray, near: np.ndarray, near_n: np.ndarray, apart: np.ndarray,
                  width: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Move points and normals (m, 3) to the quadratic surface through their neighbours (m, k, 3).

    Returns points, normals, and the mean squared residual (m,), square metres, of each fit.
    """
    # near neighbours that face the same way count most
    w = np.exp(-0.5 * (apart / width) ** 2) * np.maximum(np.matmul(near_n, n[..., None])[..., 0], 0)
    # local axes at every point: two tangents and the normal; u, v in the plane, h the height above it
    side = np.cross(n, np.eye(3)[np.argmin(np.abs(n), axis=1)])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    axes = np.stack([side, np.cross(n, side), n], axis=1)
    u, v, h = np.moveaxis(np.matmul((near - P[:, None]) / width, axes.transpose(0, 2, 1)), 2, 0)
    # weighted least squares for h = c0 + c1 u + c2 v + c3 u² + c4 uv + c5 v²
    basis = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)
    weighed = basis * w[:, None]
    normal = np.matmul(weighed, basis.transpose(0, 2, 1))
    # ridge on slopes and curvatures: with few points, near borders, the fit falls back to a plane
    normal += np.diag([1e-9, 1e-2, 1e-2, 0.3, 0.3, 0.3])
    fit = np.linalg.solve(normal, np.matmul(weighed, h[..., None]))
    # the fitted height moves the point, the slopes tilt the normal, the residual is noise
    rest = np.matmul(fit.transpose(0, 2, 1), basis)[:, 0] - h
    normals = n - fit[:, 1] * axes[:, 0] - fit[:, 2] * axes[:, 1]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    square = width**2 * np.sum(w * rest**2, axis=1) / np.maximum(w.sum(axis=1), 1e-12)
    return P + width * np.clip(fit[:, 0], -1, 1) * n, normals, square


class _SurfaceFit:
    """What the rounds of the final fit share: template, start, denoised scan, and pulls to start and landmarks."""

    def __init__(self, template: Mesh, start: np.ndarray, target: Target,
                 landmarks: tuple[np.ndarray, np.ndarray] | None, noise_width: float) -> None:
        size, N = float(np.sqrt(template.face_areas.sum())), len(start)
        self.template = template
        self.start = start
        self.size = size
        self.triangles = gradient_operator(template)
        # degenerate triangles get a thousandth of the mean area, so that no equation vanishes
        self.areas = np.maximum(template.vertex_areas, 1e-3 * template.vertex_areas.mean())
        target = orient_by_mesh(target, template.with_vertices(start), NORMALS * size)
        self.scan = smooth_scan(target, noise_width * size)
        # a pull to the start of 1e-9 keeps the equations regular without moving anything
        self.held = pull(N, np.arange(N), start, 1e-9 * self.areas)
        if landmarks is not None:
            self.held += pull(N, *landmarks, np.full(len(landmarks[0]), MARK * size**2))

    def fields(self, x: np.ndarray, length: float) -> tuple[Field, Field]:
        """Measure the field of rotations and stretches, and smooth it robustly over a length, in sizes."""
        measured = self.triangles.measure(x)
        weights = np.ones(len(self.template.faces))
        # reweighted twice: triangles off the smooth field by more than about 0.5 count little
        for _ in range(2):
            smooth = self.triangles.smooth(measured, length * self.size, weights)
            off = np.linalg.norm(measured.gradient - smooth.gradient, axis=(1, 2))
            weights = 1 / (1 + (off / 0.5) ** 2) ** 2
        return measured, smooth

    def data(self, x: np.ndarray, reach: float) -> tuple[QuadraticTargets, np.ndarray]:
        """Return pulls to the tangent planes of the nearest denoised points, and which vertices (N,) have data."""
        reach, scan, body = reach * self.size, self.scan, self.template.with_vertices(x)
        found = OrientedPoints(scan.points, scan.normals, NORMALS * self.size).match(x, body.vertex_normals, reach)
        # a border point counts only for vertices beside it, not for vertices beyond the edge of the hole
        beside = np.linalg.norm(np.cross(scan.normals[found.index], x - scan.points[found.index]), axis=1)
        seen = found.valid & (~scan.border[found.index] | (beside <= scan.spacing))
        v = np.flatnonzero(seen)
        p = found.index[v]
        weights = self.areas[v] * tukey(found.distances[v], reach)
        return pull(len(x), v, scan.points[p], weights, scan.normals[p], SLIDE), seen

    def lay_out(self, x: np.ndarray, smooth: Field, tension: float, reach: float, stiff: np.ndarray) -> np.ndarray:
        """Solve for the vertices (N, 3) that best agree with the smooth gradients, the data and the landmarks."""
        wanted, seen = self.data(x, reach)
        # without data, smoothing would straighten a bent limb: there a weak pull keeps the start
        wanted = wanted + self.held + pull(len(x), np.arange(len(x)), self.start, STAY * ~seen * self.areas)
        weights = (tension * self.size)**2 * self.triangles.areas * stiff
        # Poisson-type system K x + A x = force; preconditioned by K plus the largest eigenvalue of each block A
        K = self.triangles.stiffness(weights)
        across = np.linalg.eigvalsh(wanted.A)[:, 2]
        nearly = Factored(csc_array(K + diags_array(across)))
        force = self.triangles.force(weights, smooth.gradient) + wanted.b
        force -= K @ x + np.einsum("nij,nj->ni", wanted.A, x)
        return x + conjugate_gradients(lambda d: K @ d + np.einsum("nij,nj->ni", wanted.A, d), force, nearly.solve)
