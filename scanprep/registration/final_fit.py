"""The last pass of a registration: the surface follows the scan below its noise, evenly stretched and without folds.

Rounds of three steps: measure how every triangle has rotated and stretched; smooth that field, so that folds and
needles, which differ from their surroundings, vanish from it; lay the triangles out as the smooth field says while
the data draw the surface across, but not along itself. Growth that varies smoothly costs nothing, so other people
are as welcome as other poses, and where there are no data the template continues as its surroundings rotated it.
"""
from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array, csc_array, diags_array
from scipy.spatial import cKDTree

from ..geometry import rotations
from ..geometry.mesh import Mesh
from ..geometry.sparse import Factored, conjugate_gradients, factor
from ..geometry.surface import OrientedPoints
from ..geometry.target import Target, orient
from ..threads import search_threads
from .matches import NORMALS, Pull, pull
from .schedule import FinalFitConfig, FinalFitRound

AT_ONCE = 2000                # points around which surfaces are fitted at once: their neighbours fit into the cache


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
        x, before = _laid_out(given, x, _fields(given, x, stage), stage, stiff), x
    repairs, fields = 0, _fields(given, x, stage)
    quality = _quality(given, fields)
    while repairs < 12 and (bad := quality.inverted | quality.needles).any():
        near = np.zeros(len(x))
        near[template.faces[bad]] = 1
        stiff = np.where(near[template.faces].any(axis=1), 4 * stiff, stiff)
        x, before = _laid_out(given, x, fields, stage, stiff), x
        repairs, fields = repairs + 1, _fields(given, x, stage)
        quality = _quality(given, fields)
    return FinalFit(x, _data(given, x, stage.reach)[1], given.scan.noise, quality.strain, quality.roughness,
                    int(quality.inverted.sum()), int(quality.needles.sum()), len(given.config.rounds) + repairs,
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
    some = (slice(first, first + AT_ONCE) for first in range(0, len(P), AT_ONCE))
    fitted = [_fitted_surfaces(P[at], n[at], P[near[at]], n[near[at]], apart[at], width) for at in some]
    points, normals, rest = (np.concatenate(part) for part in zip(*fitted, strict=True))
    spacing = np.median(apart[:, min(4, apart.shape[1] - 1)])
    return SmoothedScan(points, normals, target.border, float(np.sqrt(np.median(rest))), float(spacing))


def _fitted_surfaces(P: np.ndarray, n: np.ndarray, near: np.ndarray, near_n: np.ndarray, apart: np.ndarray,
                     width: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points and normals (m, 3) moved to the quadratic surface through their neighbours (m, k, 3).

    And the mean square (m,), square metres, of what lies beside these surfaces.
    """
    w = np.exp(-0.5 * (apart / width) ** 2) * np.maximum(np.matmul(near_n, n[..., None])[..., 0], 0)
    side = np.cross(n, np.eye(3)[np.argmin(np.abs(n), axis=1)])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    axes = np.stack([side, np.cross(n, side), n], axis=1)
    u, v, h = np.moveaxis(np.matmul((near - P[:, None]) / width, axes.transpose(0, 2, 1)), 2, 0)
    basis = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)
    weighed = basis * w[:, None]
    normal = np.matmul(weighed, basis.transpose(0, 2, 1))
    # Few points say little about curvature: near borders the fit falls back to a plane.
    normal += np.diag([1e-9, 1e-2, 1e-2, 0.3, 0.3, 0.3])
    fit = np.linalg.solve(normal, np.matmul(weighed, h[..., None]))
    rest = np.matmul(fit.transpose(0, 2, 1), basis)[:, 0] - h
    normals = n - fit[:, 1] * axes[:, 0] - fit[:, 2] * axes[:, 1]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    square = width**2 * np.sum(w * rest**2, axis=1) / np.maximum(w.sum(axis=1), 1e-12)
    return P + width * np.clip(fit[:, 0], -1, 1) * n, normals, square


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
    target = orient(target, template.with_vertices(start), NORMALS * size)
    scan = smoothed_scan(target, config.noise_width * size)
    held = pull(N, np.arange(N), start, 1e-9 * areas)
    if landmarks is not None:
        held += pull(N, *landmarks, np.full(len(landmarks[0]), config.landmarks * size**2))
    return _Given(template, start, config, size, triangles_of(template), areas, scan, held)


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


def _laid_out(given: _Given, x: np.ndarray, fields: tuple[Field, Field], stage: FinalFitRound, stiff: np.ndarray
              ) -> np.ndarray:
    """Vertices that come nearest to the smooth field of gradients and to what the data want of them."""
    wanted, seen = _data(given, x, stage.reach)
    # Rounds of smoothing would straighten a limb that nothing holds: there the start is all that is known.
    wanted = wanted + given.held + pull(len(x), np.arange(len(x)), given.start,
                                        given.config.stay * ~seen * given.areas)
    weights = (stage.tension * given.size)**2 * given.triangles.areas * stiff
    K = given.triangles.stiffness(weights)
    across = np.linalg.eigvalsh(wanted.A)[:, 2]
    nearly = Factored(csc_array(K + diags_array(across)))
    force = given.triangles.force(weights, fields[1].gradient) + wanted.b
    force -= K @ x + np.einsum("nij,nj->ni", wanted.A, x)
    return x + conjugate_gradients(lambda d: K @ d + np.einsum("nij,nj->ni", wanted.A, d), force, nearly.solve)


class _Quality(NamedTuple):
    """Triangles (F,) bool that face against their surroundings and needles, and the strains of `FinalFit`."""

    inverted: np.ndarray
    needles: np.ndarray
    strain: float
    roughness: float


def _quality(given: _Given, fields: tuple[Field, Field]) -> _Quality:
    measured, smooth = fields
    n = given.template.face_normals[..., None]
    inverted = np.einsum("fdk,fdk->f", measured.R @ n, smooth.R @ n) < 0
    relative = measured.gradient @ np.linalg.inv(smooth.gradient)
    squared = np.maximum(np.linalg.eigvalsh(relative.transpose(0, 2, 1) @ relative), 1e-12)    # of the stretches
    strain, roughness = (float(np.sqrt(np.average(square, weights=given.triangles.areas)))
                         for square in ((measured.log_S**2).sum(axis=(1, 2)) / 3,
                                        (0.25 * np.log(squared)**2).mean(axis=1)))
    return _Quality(inverted, (squared[:, 2] > 4**2) | (squared[:, 0] < 1 / 4**2), strain, roughness)


@dataclass(frozen=True, eq=False)
class Field:
    """The rotation R and the stretch S (F, 3, 3) of every triangle, and the logarithm of S; its gradient is `R S`.

    S is symmetric, in the template's axes; along the normal it is the mean stretch within the triangle.
    """

    R: np.ndarray
    S: np.ndarray
    log_S: np.ndarray

    @cached_property
    def gradient(self) -> np.ndarray:
        """(F, 3, 3)"""
        return self.R @ self.S


@lru_cache(maxsize=4)                # a folder of scans shares one template
def triangles_of(template: Mesh) -> Triangles:
    """The triangles of a template, made ready once."""
    return Triangles(template)


class Triangles:
    """The triangles of a template at rest, ready to measure gradients and to lay wanted ones out."""

    def __init__(self, template: Mesh) -> None:
        c, faces = template.corners, template.faces
        self.mesh = template
        self.areas = np.maximum(template.face_areas, 1e-3 * template.face_areas.mean())
        n = template.face_normals
        e = np.stack([c[:, 2] - c[:, 1], c[:, 0] - c[:, 2], c[:, 1] - c[:, 0]], axis=1)
        self.hats = np.cross(n[:, None], e) / (2 * self.areas)[:, None, None]
        u = e[:, 2] / np.maximum(np.linalg.norm(e[:, 2], axis=1, keepdims=True), 1e-300)
        self.frames = np.stack([u, np.cross(n, u), n], axis=1)
        self._collect = csc_array(coo_array((np.full(faces.size, 1 / 3), (faces.ravel(), np.arange(faces.size) // 3)),
                                            shape=(len(template.vertices), len(faces))))
        self._smoothing: dict[float, Factored] = {}

    def measured(self, x: np.ndarray) -> Field:
        """The rotations and stretches of vertices (N, 3)."""
        flat = np.matmul(x[self.mesh.faces].transpose(0, 2, 1), self._hats_in_plane)
        C = np.matmul(flat.transpose(0, 2, 1), flat)
        area = np.sqrt(np.maximum(C[:, 0, 0] * C[:, 1, 1] - C[:, 0, 1] ** 2, 1e-12))
        trace = np.sqrt(C[:, 0, 0] + C[:, 1, 1] + 2 * area)
        U = (C + area[:, None, None] * np.eye(2)) / trace[:, None, None]
        inverse = (np.eye(2) * trace[:, None, None] - U) / area[:, None, None]
        rotated = np.empty((len(U), 3, 3))
        rotated[:, :, :2] = flat @ inverse
        rotated[:, :, 2] = self.mesh.with_vertices(x).face_normals
        full, logarithm = np.zeros((2, len(U), 3, 3))
        full[:, :2, :2], full[:, 2, 2] = U, np.sqrt(area)
        logarithm[:, :2, :2], logarithm[:, 2, 2] = _log_in_plane(U), 0.5 * np.log(area)
        B = self.frames
        back = B.transpose(0, 2, 1)
        return Field(rotated @ B, back @ full @ B, back @ logarithm @ B)

    def smoothed(self, field: Field, length: float, weights: np.ndarray) -> Field:
        """The field that varies little over `length` (metres), where triangles count by weights (F,).

        A mean over the surroundings: what the triangles say is spread, and so are the weights by which it is divided.
        """
        w = np.maximum(weights, 1e-6) * self.areas
        entries = np.concatenate([field.R.reshape(-1, 9), field.log_S.reshape(-1, 9), np.ones((len(w), 1))], axis=1)
        spread = self._smoother(length).solve(self._collect @ (w[:, None] * entries))
        of_faces = (spread[:, :18] / spread[:, 18:])[self.mesh.faces].mean(axis=1)
        logarithm = of_faces[:, 9:].reshape(-1, 3, 3)
        return Field(rotations.project(of_faces[:, :9].reshape(-1, 3, 3)), _exp_symmetric(logarithm), logarithm)

    def _smoother(self, length: float) -> Factored:
        """What spreads over a length: the same matrix whatever the weights, factored once."""
        if length not in self._smoothing:
            mass = self._collect @ self.areas
            self._smoothing[length] = Factored(csc_array(diags_array(mass) + length**2 * self.stiffness(self.areas)))
        return self._smoothing[length]

    @cached_property
    def _hats_in_plane(self) -> np.ndarray:
        """(F, 3, 2) the gradients of the corners' hats in the triangle's own axes."""
        return np.matmul(self.hats, self.frames[:, :2].transpose(0, 2, 1))

    def stiffness(self, weights: np.ndarray) -> csc_array:
        """(N, N) with `x·Kx = Σ w |∇x|²` for weights (F,), square metres."""
        faces, N = self.mesh.faces, len(self.mesh.vertices)
        local = weights[:, None, None] * np.matmul(self.hats, self.hats.transpose(0, 2, 1))
        rows, columns = np.repeat(faces, 3, axis=1).ravel(), np.tile(faces, (1, 3)).ravel()
        return csc_array(coo_array((local.ravel(), (rows, columns)), shape=(N, N)))

    def force(self, weights: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        """(N, 3) right-hand side that asks for gradients (F, 3, 3) with weights (F,)."""
        local = weights[:, None, None] * np.matmul(self.hats, gradient.transpose(0, 2, 1))
        out = np.empty((len(self.mesh.vertices), 3))
        for d in range(3):
            out[:, d] = np.bincount(self.mesh.faces.ravel(), local[:, :, d].ravel(), len(out))
        return out


def _log_in_plane(U: np.ndarray) -> np.ndarray:
    """The logarithms (n, 2, 2) of symmetric positive matrices: of their eigenvalues m ± d."""
    m, half = 0.5 * (U[:, 0, 0] + U[:, 1, 1]), 0.5 * (U[:, 0, 0] - U[:, 1, 1])
    d = np.hypot(half, U[:, 0, 1])
    low, high = np.log(np.maximum(m - d, 1e-3)), np.log(np.maximum(m + d, 1e-3))
    slope = np.where(d > 1e-9 * m, 0.5 * (high - low) / np.maximum(d, 1e-300), 1 / m)
    return slope[:, None, None] * U + (0.5 * (low + high) - slope * m)[:, None, None] * np.eye(2)


def _exp_symmetric(E: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh(0.5 * (E + E.transpose(0, 2, 1)))
    return (vectors * np.exp(values)[:, None]) @ vectors.transpose(0, 2, 1)


def without_inverted(template: Mesh, x: np.ndarray) -> np.ndarray:
    """Vertices (N, 3) where patches around inverted triangles were laid anew, wider ones while that leaves fewer."""
    x = unfold(template, x)
    left = int(inverted_triangles(template, x).sum())
    for rings in ((2,), (2, 3), (3, 4)):
        if not left:
            break
        trial = unfold(template, x, rings=rings)
        count = int(inverted_triangles(template, trial).sum())
        if count < left:
            x, left = trial, count
    return x


def vertex_rotations(template: Mesh, x: np.ndarray, rings: int = 4) -> np.ndarray:
    """Rotations (N, 3, 3) of the surroundings of each vertex from the template to vertices (N, 3).

    The surroundings reach so many rings far: a folded triangle must not sway them.
    """
    a, b = template.edges.T
    outer = np.einsum("ei,ej->eij", x[b] - x[a], template.vertices[b] - template.vertices[a]).reshape(-1, 9)
    M = np.zeros((len(x), 9))
    for end in (a, b):
        np.add.at(M, end, outer)
    A = template.vertex_adjacency
    spread = diags_array(1 / (1 + np.asarray(A.sum(axis=1)).ravel())) @ (A + diags_array(np.ones(len(x))))
    for _ in range(rings):
        M = spread @ M
    return rotations.project(M.reshape(-1, 3, 3))


def inverted_triangles(template: Mesh, x: np.ndarray, linear: np.ndarray | None = None) -> np.ndarray:
    """(F,) bool: triangles of vertices (N, 3) that face away from where their surroundings were rotated to.

    `linear` (N, 3, 3) is the rotation around every vertex, by default that of its surroundings.
    """
    linear = vertex_rotations(template, x) if linear is None else linear
    wanted = np.matmul(linear[template.faces].sum(axis=1), template.face_normals[..., None])[..., 0]
    return np.einsum("fd,fd->f", template.with_vertices(x).face_normals, wanted) < 0


def unfold(template: Mesh, x: np.ndarray, linear: np.ndarray | None = None, rings: tuple[int, ...] = (1, 1, 2)
           ) -> np.ndarray:
    """Vertices (N, 3) with small patches around inverted triangles laid anew, each edge as its surroundings rotated it.

    The patches stay small: where skin truly folds triangles stay inverted, and laying wide patches there would leave
    the data.
    """
    linear = vertex_rotations(template, x) if linear is None else linear
    a, b = template.edges.T
    rest = template.vertices[b] - template.vertices[a]
    wanted = np.matmul(0.5 * (linear[a] + linear[b]), rest[..., None])[..., 0]
    for reach in rings:
        bad = inverted_triangles(template, x, linear)
        if not bad.any():
            break
        patch = np.zeros(len(x))
        patch[template.faces[bad]] = 1
        for _ in range(reach):
            patch = (patch + template.vertex_adjacency @ patch > 0).astype(float)
        x = _laid(x, patch > 0, template.edges, wanted)
    return x


def _laid(x: np.ndarray, free: np.ndarray, edges: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Vertices (N, 3) where those that are free have moved so that their edges are nearest to the wanted ones."""
    if free.all():
        return x
    near = free[edges].any(axis=1)
    e = np.arange(int(near.sum()))
    a, b = edges[near].T
    D = csc_array(coo_array((np.r_[np.full(len(e), -1.0), np.ones(len(e))], (np.r_[e, e], np.r_[a, b])),
                            shape=(len(e), len(x))))
    inside, outside = D[:, np.flatnonzero(free)], D[:, np.flatnonzero(~free)]
    x = x.copy()
    x[free] = factor(csc_array(inside.T @ inside))(inside.T @ (wanted[near] - outside @ x[~free]))
    return x
