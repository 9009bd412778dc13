"""What correlated correspondence knows of a place on a surface, the same on template and scan."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree


@dataclass(frozen=True, eq=False)
class Places:
    """Points of a surface seen from the seeds.

    Attributes
    ----------
    points, normals : (n, 3) float
        Metres of the scan: those of a template are scaled to its size.
    to_seeds : (n, S) float, metres
        Along the surface; NaN where no way leads.
    turns : (n, S(S-1)/2) float
        For every pair of seeds the sine of the angle from the direction away from the first to that away from
        the second, about the normal: reflections change its sign, bending does not.
    sure : (n, S) float
        How much the way to each seed is to be trusted, 1 for a way that needs no bridge between pieces.
    """

    points: np.ndarray
    normals: np.ndarray
    to_seeds: np.ndarray
    turns: np.ndarray
    sure: np.ndarray

    def __getitem__(self, index: np.ndarray) -> Places:
        """Some of the places."""
        return Places(self.points[index], self.normals[index], self.to_seeds[index], self.turns[index],
                      self.sure[index])

    def __len__(self) -> int:
        return len(self.points)


def turns_between(points: np.ndarray, normals: np.ndarray, distances: np.ndarray, at: np.ndarray,
                  radius: float) -> np.ndarray:
    """Sines of the angles between the directions away from the seeds, (n, S(S-1)/2).

    Parameters
    ----------
    points, normals : (m, 3) float
        The whole surface.
    distances : (S, m) float, metres
        From every seed.
    at : (n,) int
        Where the sines are wanted.
    radius : float, metres
        Of the neighbourhood that gives the directions.
    """
    gradient = gradients(points, normals, distances, at, radius)
    a, b = np.triu_indices(len(distances), 1)
    return np.einsum("pnd,nd->np", np.cross(gradient[a], gradient[b]), normals[at])


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
