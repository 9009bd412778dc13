"""The floor under a scanned body, found and taken off without the soles."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

WIDEST = 0.03              # metres: farthest distance of the points that a first guess is fitted to
SIGMAS = 3.5               # standard deviations from a floor within which points are on it


@dataclass(frozen=True)
class Plane:
    """A plane with what was measured on it in front."""

    normal: np.ndarray          # (3,) unit, towards the body
    offset: float               # of points x on the plane, `normal @ x`, metres
    noise: float                # standard deviation of the points that were measured on it, metres

    @property
    def thickness(self) -> float:
        """Points within this distance, metres, are on it."""
        return SIGMAS * self.noise

    def height(self, points: np.ndarray) -> np.ndarray:
        """Distances (n,) of points (n, 3) in front of the plane, metres."""
        return np.asarray(points @ self.normal - self.offset)

    def flat(self, points: np.ndarray) -> np.ndarray:
        """Coordinates (n, 2) of points along the plane, metres."""
        u = np.cross(self.normal, np.eye(3)[np.abs(self.normal).argmin()])
        u /= np.linalg.norm(u)
        return points @ np.stack([u, np.cross(self.normal, u)], axis=1)

    def flip(self) -> Plane:
        """The same plane from behind."""
        return Plane(-self.normal, -self.offset, self.noise)


def find_plane(points: np.ndarray, min_area: float, rng: np.random.Generator) -> Plane | None:
    """The largest plane that has nearly all points (n, 3) on it or on one side of it; None below `min_area` m².

    Guesses go through single points along the normal of their neighbourhood; the best is fitted to ever closer points.
    """
    few = points[rng.permutation(len(points))[:10_000]]
    tree = cKDTree(few)
    best, best_area = None, min_area
    most_below = 0.01  # share of all points that may lie behind a floor
    for seed in rng.choice(len(few), min(150, len(few)), replace=False):
        near = few[tree.query_ball_point(few[seed], 2 * WIDEST)]
        if len(near) < 6:
            continue
        plane = _fit(near)
        height = plane.height(few)
        if np.mean(height < -WIDEST) > np.mean(height > WIDEST):
            plane, height = plane.flip(), -height
        if np.mean(height < -WIDEST) > most_below:
            continue
        area = _area_of_cells(plane.flat(few[np.abs(height) < WIDEST / 2]), WIDEST)
        if area > best_area:
            best, best_area = plane, area
    if best is None:
        return None
    plane = _refine(best, points)
    height = plane.height(points)
    on_it = np.abs(height) <= plane.thickness
    if (plane.noise > 2 * local_noise(points, rng)           # a back is nearly flat, but only nearly
            or np.mean(height < -WIDEST / 2) > most_below
            or _area_of_cells(plane.flat(points[on_it]), WIDEST) < min_area):
        return None
    return plane


def local_noise(points: np.ndarray, rng: np.random.Generator) -> float:
    """Standard deviation, metres, of points (n, 3) from planes through their nearest neighbours: the median."""
    near = min(16, len(points))
    index = cKDTree(points).query(points[rng.choice(len(points), min(500, len(points)), replace=False)], near)[1]
    patch = points[index.reshape(-1, near)]
    spread = np.linalg.svd(patch - patch.mean(axis=1, keepdims=True), compute_uv=False)[:, 2]
    return max(float(np.median(spread)) / max(near - 3, 1) ** 0.5, 1e-4)


def floor_points(points: np.ndarray, plane: Plane, body: np.ndarray) -> np.ndarray:
    """(n,) bool: points (n, 3) on a floor outside the footprint of the body (m, 3), and those under it."""
    band = plane.thickness
    height = plane.height(points)
    on_it = np.abs(height) <= band
    above = plane.height(body)
    low = plane.flat(body[(above > band) & (above < band + 0.03)])         # what shows where it stands
    on_it[on_it] = ~inside_outline(plane.flat(points[on_it]), low, bridge=0.015)
    return np.asarray(on_it | (height < -band))


def inside_outline(points: np.ndarray, outline: np.ndarray, bridge: float) -> np.ndarray:
    """(n,) bool: points (n, 2) on or inside the closed curves that other points (m, 2) trace.

    Gaps up to `bridge` metres are closed.
    """
    if not len(outline) or not len(points):
        return np.zeros(len(points), dtype=bool)
    cell = bridge / 3
    start = outline.min(axis=0) - 3 * bridge
    place = ((outline - start) / cell).astype(int)
    drawn = np.zeros(place.max(axis=0) + 10, dtype=bool)
    drawn[tuple(place.T)] = True
    reach = np.hypot(*np.mgrid[-3:4, -3:4]) <= 3
    filled = ndimage.binary_fill_holes(ndimage.binary_dilation(drawn, reach))
    filled = ndimage.binary_erosion(filled, reach) | drawn
    at = np.floor((points - start) / cell).astype(int)
    known = ((at >= 0) & (at < filled.shape)).all(axis=1)
    inside = np.zeros(len(points), dtype=bool)
    inside[known] = filled[tuple(at[known].T)]
    return inside


def _area_of_cells(flat: np.ndarray, cell: float) -> float:
    """Square metres of the cells, `cell` metres wide, that have one of the points (n, 2)."""
    place = np.floor((flat - flat.min(axis=0, initial=np.inf)) / cell).astype(np.int64)
    return len(np.unique(place[:, 0] * (place[:, 1].max(initial=0) + 1) + place[:, 1])) * cell**2


def _fit(points: np.ndarray) -> Plane:
    centre = points.mean(axis=0)
    spread, axes = np.linalg.eigh(np.cov(points.T, bias=True))
    return Plane(axes[:, 0], float(axes[:, 0] @ centre), float(np.sqrt(max(spread[0], 0.0))))


def _refine(plane: Plane, points: np.ndarray) -> Plane:
    """Fitted to points that are closer every time, the noise by the median so that feet do not count."""
    band = WIDEST
    for _ in range(8):
        height = plane.height(points)
        near = points[np.abs(height) < band]
        fitted = _fit(near)
        if fitted.normal @ plane.normal < 0:
            fitted = fitted.flip()
        noise = 1.4826 * float(np.median(np.abs(fitted.height(near))))
        plane = Plane(fitted.normal, fitted.offset, max(noise, 1e-5))
        band = min(band, max(3 * plane.noise, 1e-4))
    return plane
