"""Potentials of correlated correspondence: unary ones for a point and its image, pairwise ones for two points.

A residual is divided by its width: the error that costs one.
"""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

ANGLES = 3.0                   # total weight of the sines of angles between directions to seeds, as three distances
MOST_EDGE = 9.0 * 2.5 + 4.0    # largest cost of an edge: length, two leans and a bend at 3² each, directions at 2²


@dataclass(frozen=True, eq=False)
class SurfaceFeatures:
    """Features of points (n, 3) of a surface relative to the seeds; the template's are scaled to metres of the scan.

    `angles` holds for every pair of seeds the sine of the angle between the directions away from them, about the
    normal. A reflection changes its sign; bending does not.
    """

    points: np.ndarray
    normals: np.ndarray
    to_seeds: np.ndarray         # (n, S) metres along the surface; NaN where unreachable
    angles: np.ndarray           # (n, S(S-1)/2)
    sure: np.ndarray             # (n, S) trust in the path to each seed, 1 where it crosses no gap

    def __getitem__(self, index: np.ndarray) -> SurfaceFeatures:
        return SurfaceFeatures(self.points[index], self.normals[index], self.to_seeds[index], self.angles[index],
                               self.sure[index])

    def __len__(self) -> int:
        return len(self.points)


def distance_profile(points: np.ndarray, normals: np.ndarray, distances: np.ndarray, at: np.ndarray, radius: float,
                     sure: np.ndarray) -> SurfaceFeatures:
    """Compute the features of points `at` (n,) of a surface (m, 3), from `distances` (S, m) to the seeds.

    Directions are averaged over neighbourhoods of `radius` metres.
    """
    to_seeds = np.where(np.isfinite(distances[:, at]), distances[:, at], np.nan).T
    gradient = gradients(points, normals, distances, at, radius)
    a, b = np.triu_indices(len(distances), 1)
    angles = np.einsum("pnd,nd->np", np.cross(gradient[a], gradient[b]), normals[at])
    return SurfaceFeatures(points[at], normals[at], to_seeds, angles, sure)


def gradients(points: np.ndarray, normals: np.ndarray, values: np.ndarray, at: np.ndarray, radius: float
              ) -> np.ndarray:
    """Estimate gradient directions (S, n, 3) of values (S, m) along the surface, of length one at most."""
    near_distance, near = cKDTree(points).query(points[at], min(48, len(points)),
                                                distance_upper_bound=radius)
    valid = np.isfinite(near_distance)
    near = np.where(valid, near, at[:, None])
    n = normals[at]
    valid &= np.einsum("nkd,nd->nk", normals[near], n) > 0.3
    # arms in the tangent plane, to neighbours within the radius that face the same way
    arm = points[near] - points[at][:, None]
    arm -= np.einsum("nkd,nd->nk", arm, n)[..., None] * n[:, None]
    arm *= valid[..., None]
    with np.errstate(invalid="ignore"):
        rise = values[:, near] - values[:, at][..., None]
    rise = np.where(np.isfinite(rise) & (np.abs(rise) < 1.5 * radius), rise, 0.0)      # a jump is no slope
    # least-squares slope; the normal and a small ridge keep the system regular
    H = np.einsum("nki,nkj->nij", arm, arm) + radius**2 * n[:, :, None] * n[:, None, :]
    H += 1e-6 * radius**2 * np.eye(3)
    slope = np.linalg.solve(H[None], np.einsum("nkd,snk->snd", arm, rise)[..., None])[..., 0]
    return slope / np.maximum(np.linalg.norm(slope, axis=2, keepdims=True), 0.5)


def robust(r: np.ndarray, limit: float) -> np.ndarray:
    """Compute a robust square: r² for small residuals, at most limit²."""
    squared = r * r
    return squared / (1 + squared / limit**2)


def place_energy(scan: SurfaceFeatures, template: SurfaceFeatures, size: float) -> np.ndarray:
    """Compute the unary energy (n, m) of every template point as the image of every scan point.

    [CC] geodesic potentials, as unary evidence
    """
    energy = np.zeros((len(scan), len(template)))
    known = np.zeros_like(energy)
    for x, y, w in zip(scan.to_seeds.T, template.to_seeds.T, scan.sure.T, strict=True):
        # width: 10% because bending changes path lengths, plus 1.4% of the size (2 cm) for errors of clicks near a seed
        width = 0.014 * size + 0.10 * np.minimum(x[:, None], y[None])
        r = robust((x[:, None] - y[None]) / width * w[:, None], 2.0)
        energy += np.nan_to_num(r)
        known += np.isfinite(r)
    energy *= scan.to_seeds.shape[1] / np.maximum(known, 1)           # unreachable seeds count like the mean
    # angles between directions tell left from right; a sine may be off by 0.4
    a, b = np.triu_indices(scan.to_seeds.shape[1], 1)
    both = (scan.sure[:, a] * scan.sure[:, b]).T
    for x, y, w in zip(scan.angles.T, template.angles.T, both, strict=True):
        energy += ANGLES / len(a) * w[:, None] * robust((x[:, None] - y[None]) / 0.4, 2.0)
    return energy


def most_place_energy(seeds: int) -> float:
    """Return the largest unary energy: every robust square is at most 2²."""
    return 4.0 * (seeds + ANGLES)


def edge_energy(scan: SurfaceFeatures, template: SurfaceFeatures, edges: np.ndarray, domains: np.ndarray,
                size: float) -> np.ndarray:
    """Compute the pairwise energy (E, K, K) of every edge (E, 2) of the scan, for all images in domains (n, K).

    An edge of the scan is compared with the edge between the images: its length, its angles to the normals at both
    ends, the angle between the normals, and its direction. The direction is described by how much nearer to every seed
    it leads, which needs no estimate of rotation.

    [CC] deformation potential
    """
    out = np.empty((len(edges), domains.shape[1], domains.shape[1]), dtype=np.float32)
    # properties of the scan's edges: length, leans against both normals, bend between the normals, gains to the seeds
    along = scan.points[edges[:, 1]] - scan.points[edges[:, 0]]
    length = np.maximum(np.linalg.norm(along, axis=1), 1e-9)
    at_i, at_j = (np.einsum("ed,ed->e", scan.normals[edges[:, side]], along / length[:, None]) for side in (0, 1))
    bend = np.einsum("ed,ed->e", scan.normals[edges[:, 0]], scan.normals[edges[:, 1]])
    nearer = scan.to_seeds[edges[:, 1]] - scan.to_seeds[edges[:, 0]]
    x, n, d = (np.asarray(a, dtype=np.float32) for a in (template.points, template.normals, template.to_seeds))
    for e, (i, j) in enumerate(edges):
        k, l = domains[i], domains[j]
        # the same of the template, for all pairs of images; widths: 8% of the length, 0.25 of a lean, 0.375 of a bend
        apart = x[l][None] - x[k][:, None]
        far = np.sqrt(np.einsum("kld,kld->kl", apart, apart)) + 1e-9
        energy = robust((far - length[e]) / (0.006 * size + 0.08 * length[e]), 3.0)
        lean_k = np.einsum("kld,kd->kl", apart, n[k]) / far
        lean_l = np.einsum("kld,ld->kl", apart, n[l]) / far
        energy += 0.5 * robust((lean_k - at_i[e]) / 0.25, 3.0)
        energy += 0.5 * robust((lean_l - at_j[e]) / 0.25, 3.0)
        energy += 0.5 * robust((n[k] @ n[l].T - bend[e]) / 0.375, 3.0)
        # direction: change of the distance to each reachable seed, within 0.3 of the edge's length
        w = np.where(np.isfinite(nearer[e]), np.minimum(scan.sure[i], scan.sure[j]), 0.0)
        if w.any():
            seen = np.flatnonzero(w)
            at_k, at_l = d[k][:, seen].T[:, :, None], d[l][:, seen].T[:, None]
            r = (at_l - at_k - nearer[e, seen].astype(np.float32)[:, None, None]) / np.float32(0.3 * length[e])
            energy += np.tensordot((w[seen] / w.sum()).astype(np.float32), robust(r, 2.0), 1)
        out[e] = energy
    return out
