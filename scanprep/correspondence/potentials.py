"""Potentials of correlated correspondence: what speaks for one image, and for two images together.

The width of a residual is the error that costs one.
"""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

ANGLES = 3.0                   # weight of all sines between directions to seeds together
MOST_EDGE = 9.0 * 2.5 + 4.0    # no edge can cost more: length, two leans and a bend at 3² each, directions at 2²


@dataclass(frozen=True, eq=False)
class SurfaceFeatures:
    """Points and normals (n, 3) of a surface seen from the seeds, in metres of the scan for the template too.

    `angles` are, for every pair of seeds, the sine of the angle from the direction away from the first to that away
    from the second, about the normal: reflections change its sign, bending does not.
    """

    points: np.ndarray
    normals: np.ndarray
    to_seeds: np.ndarray         # (n, S) metres along the surface; NaN where no way leads
    angles: np.ndarray           # (n, S(S-1)/2)
    sure: np.ndarray             # (n, S) how sure the way to each seed is, 1 where it needs no bridge between pieces

    def __getitem__(self, index: np.ndarray) -> SurfaceFeatures:
        return SurfaceFeatures(self.points[index], self.normals[index], self.to_seeds[index], self.angles[index],
                               self.sure[index])

    def __len__(self) -> int:
        return len(self.points)


def distance_profile(points: np.ndarray, normals: np.ndarray, distances: np.ndarray, at: np.ndarray, radius: float,
                     sure: np.ndarray) -> SurfaceFeatures:
    """Some points `at` (n,) of a surface (m, 3) as seen from the seeds, from which `distances` (S, m) are.

    Directions are averaged over neighbourhoods of `radius` metres.
    """
    to_seeds = np.where(np.isfinite(distances[:, at]), distances[:, at], np.nan).T
    gradient = gradients(points, normals, distances, at, radius)
    a, b = np.triu_indices(len(distances), 1)
    angles = np.einsum("pnd,nd->np", np.cross(gradient[a], gradient[b]), normals[at])
    return SurfaceFeatures(points[at], normals[at], to_seeds, angles, sure)


def gradients(points: np.ndarray, normals: np.ndarray, values: np.ndarray, at: np.ndarray, radius: float,
              neighbours: int = 48) -> np.ndarray:
    """Directions (S, n, 3) in which values (S, m) grow along the surface, of length one at most."""
    near_distance, near = cKDTree(points).query(points[at], min(neighbours, len(points)),
                                                distance_upper_bound=radius)
    found = np.isfinite(near_distance)
    near = np.where(found, near, at[:, None])
    n = normals[at]
    found &= np.einsum("nkd,nd->nk", normals[near], n) > 0.3
    arm = points[near] - points[at][:, None]
    arm -= np.einsum("nkd,nd->nk", arm, n)[..., None] * n[:, None]
    arm *= found[..., None]
    with np.errstate(invalid="ignore"):
        rise = values[:, near] - values[:, at][..., None]
    rise = np.where(np.isfinite(rise) & (np.abs(rise) < 1.5 * radius), rise, 0.0)      # no jump counts
    H = np.einsum("nki,nkj->nij", arm, arm) + radius**2 * n[:, :, None] * n[:, None, :]
    H += 1e-6 * radius**2 * np.eye(3)
    slope = np.linalg.solve(H[None], np.einsum("nkd,snk->snd", arm, rise)[..., None])[..., 0]
    return slope / np.maximum(np.linalg.norm(slope, axis=2, keepdims=True), 0.5)


def robust(r: np.ndarray, limit: float) -> np.ndarray:
    """r² for small residuals, limit² for any large one."""
    squared = r * r
    return squared / (1 + squared / limit**2)


def place_energy(scan: SurfaceFeatures, template: SurfaceFeatures, size: float) -> np.ndarray:
    """Energy (n, m) of every place of the template as the image of every place of the scan.

    [CC] geodesic potentials, as evidence for single places
    """
    energy = np.zeros((len(scan), len(template)))
    known = np.zeros_like(energy)
    for x, y, w in zip(scan.to_seeds.T, template.to_seeds.T, scan.sure.T, strict=True):
        # bending lengthens and shortens paths by a share; beside a seed a click is off by so much
        width = 0.014 * size + 0.10 * np.minimum(x[:, None], y[None])
        r = robust((x[:, None] - y[None]) / width * w[:, None], 2.0)
        energy += np.nan_to_num(r)
        known += np.isfinite(r)
    energy *= scan.to_seeds.shape[1] / np.maximum(known, 1)
    a, b = np.triu_indices(scan.to_seeds.shape[1], 1)
    both = (scan.sure[:, a] * scan.sure[:, b]).T
    for x, y, w in zip(scan.angles.T, template.angles.T, both, strict=True):
        energy += ANGLES / len(a) * w[:, None] * robust((x[:, None] - y[None]) / 0.4, 2.0)
    return energy


def most_place_energy(seeds: int) -> float:
    """No place can cost more."""
    return 4.0 * (seeds + ANGLES)


def edge_energy(scan: SurfaceFeatures, template: SurfaceFeatures, edges: np.ndarray, domains: np.ndarray,
                size: float) -> np.ndarray:
    """Energy (E, K, K) of the images of the two ends of every edge (E, 2) of the scan, within domains (n, K).

    The edge between two points of the scan against the edge between their images: its length, its angles to the
    normals at both ends and the angle between these, and its direction, told by how much nearer to every seed it
    leads. The last is a local frame that needs no estimate of the rotation.

    [CC] deformation potential
    """
    out = np.empty((len(edges), domains.shape[1], domains.shape[1]), dtype=np.float32)
    along = scan.points[edges[:, 1]] - scan.points[edges[:, 0]]
    length = np.maximum(np.linalg.norm(along, axis=1), 1e-9)
    at_i, at_j = (np.einsum("ed,ed->e", scan.normals[edges[:, side]], along / length[:, None]) for side in (0, 1))
    bend = np.einsum("ed,ed->e", scan.normals[edges[:, 0]], scan.normals[edges[:, 1]])
    nearer = scan.to_seeds[edges[:, 1]] - scan.to_seeds[edges[:, 0]]
    x, n, d = (np.asarray(a, dtype=np.float32) for a in (template.points, template.normals, template.to_seeds))
    for e, (i, j) in enumerate(edges):
        k, l = domains[i], domains[j]
        apart = x[l][None] - x[k][:, None]
        far = np.sqrt(np.einsum("kld,kld->kl", apart, apart)) + 1e-9
        energy = robust((far - length[e]) / (0.006 * size + 0.08 * length[e]), 3.0)
        lean_k = np.einsum("kld,kd->kl", apart, n[k]) / far
        lean_l = np.einsum("kld,ld->kl", apart, n[l]) / far
        energy += 0.5 * robust((lean_k - at_i[e]) / 0.25, 3.0)
        energy += 0.5 * robust((lean_l - at_j[e]) / 0.25, 3.0)
        energy += 0.5 * robust((n[k] @ n[l].T - bend[e]) / 0.375, 3.0)
        w = np.where(np.isfinite(nearer[e]), np.minimum(scan.sure[i], scan.sure[j]), 0.0)
        if w.any():
            seen = np.flatnonzero(w)
            at_k, at_l = d[k][:, seen].T[:, :, None], d[l][:, seen].T[:, None]
            r = (at_l - at_k - nearer[e, seen].astype(np.float32)[:, None, None]) / np.float32(0.3 * length[e])
            energy += np.tensordot((w[seen] / w.sum()).astype(np.float32), robust(r, 2.0), 1)
        out[e] = energy
    return out
