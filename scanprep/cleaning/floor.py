"""Find the floor under a scanned body, and separate it from the soles."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

WIDEST = 0.03              # metres: half-width of the band around a first guess
STEEPEST = 0.9             # cosine of the angle between a floor's normal and the direction that is up, 26 degrees
HIGHEST = 0.6              # metres: a pedestal is lower than the legs of somebody whose seat could be taken for its top
SIGMAS = 3.5               # points within so many standard deviations are on the floor: 99.95% of Gaussian noise


@dataclass(frozen=True)
class Plane:
    """A plane measured with noise; its normal points to the body."""

    normal: np.ndarray          # (3,) unit, towards the body
    offset: float               # `normal @ x` of points x on the plane, metres
    noise: float                # standard deviation of the measured points, metres

    @property
    def thickness(self) -> float:
        """Points within this distance, metres, count as on the plane."""
        return SIGMAS * self.noise

    def height(self, points: np.ndarray) -> np.ndarray:
        """Return signed distances (n,), metres, of points (n, 3); positive in front of the plane."""
        return np.asarray(points @ self.normal - self.offset)

    def flat(self, points: np.ndarray) -> np.ndarray:
        """Return coordinates (n, 2), metres, of points in the plane."""
        u = np.cross(self.normal, np.eye(3)[np.abs(self.normal).argmin()])
        u /= np.linalg.norm(u)
        return points @ np.stack([u, np.cross(self.normal, u)], axis=1)

    def flip(self) -> Plane:
        """Return the plane with the opposite normal."""
        return Plane(-self.normal, -self.offset, self.noise)


def find_plane(points: np.ndarray, min_area: float, rng: np.random.Generator, up: np.ndarray | None = None,
               kept: Sequence[Plane] = ()) -> Plane | None:
    """Find the largest plane with nearly all points (n, 3) on it or on one side; None below `min_area` m².

    Behind it there may be the pedestal whose top it is. Candidates are tangent planes at random points; the best one is
    refined on ever closer points. With the direction `up` (3,) given, only floors are found; none is one of the
    planes that were `kept`.
    """
    sample = points[rng.permutation(len(points))[:10_000]]
    tree = cKDTree(sample)
    best, best_area = None, min_area
    most_below = 0.01  # share of points that may lie behind a floor: specks and reflections
    for seed in rng.choice(len(sample), min(150, len(sample)), replace=False):
        # tangent plane of the neighbourhood; the side with more points is the front
        near = sample[tree.query_ball_point(sample[seed], 2 * WIDEST)]
        if len(near) < 6:
            continue
        plane = _fit(near)
        height = plane.height(sample)
        if np.mean(height < -WIDEST) > np.mean(height > WIDEST):
            plane, height = plane.flip(), -height
        if up is not None and plane.normal @ up < STEEPEST:
            continue
        if any(plane.normal @ other.normal > STEEPEST and abs(plane.offset - other.offset) < WIDEST for other in kept):
            continue
        if np.mean(height < -WIDEST) > most_below and not _is_pedestal(plane, sample):
            continue
        # measured area, in cells of 3 cm
        area = _area_of_cells(plane.flat(sample[np.abs(height) < WIDEST / 2]), WIDEST)
        if area > best_area:
            best, best_area = plane, area
    if best is None:
        return None
    noise = local_noise(points, rng)
    # in the wide band soles may hide a small floor, in the narrow one the candidate may not be level enough
    for band in WIDEST, min(WIDEST, max(4 * best.noise, 4 * noise)):
        plane = _refine(best, points, band)
        height = plane.height(points)
        on_it = np.abs(height) <= plane.thickness
        if (plane.noise <= 2 * noise                         # curved surface such as a back is no floor
                and (np.mean(height < -WIDEST / 2) <= most_below or _is_pedestal(plane, points))
                and _area_of_cells(plane.flat(points[on_it]), WIDEST) >= min_area):
            return plane
    return None


def _is_pedestal(plane: Plane, points: np.ndarray) -> bool:
    """Test whether the points (n, 3) behind a plane are a pedestal: below its own outline, and not as high as a leg."""
    height, flat = plane.height(points), plane.flat(points)
    below, top = height < -WIDEST, flat[np.abs(height) < WIDEST / 2]
    if not len(top) or not below.any() or height.min() < -HIGHEST:
        return False
    # the sides are at the rim; the top may be hidden by the feet
    outside = ~inside_outline(flat[below], top, bridge=WIDEST)
    outside[outside] = cKDTree(top).query(flat[below][outside])[0] > 2 * WIDEST
    return bool(outside.mean() < 0.02)                                       # 2%: specks and reflections


def local_noise(points: np.ndarray, rng: np.random.Generator) -> float:
    """Estimate the noise of points (n, 3), metres: median deviation from planes through their nearest neighbours."""
    near = min(16, len(points))
    index = cKDTree(points).query(points[rng.choice(len(points), min(500, len(points)), replace=False)], near)[1]
    patch = points[index.reshape(-1, near)]
    spread = np.linalg.svd(patch - patch.mean(axis=1, keepdims=True), compute_uv=False)[:, 2]
    return max(float(np.median(spread)) / max(near - 3, 1) ** 0.5, 1e-4)


def floor_points(points: np.ndarray, plane: Plane, body: np.ndarray) -> np.ndarray:
    """Find points (n,) bool on a floor outside the footprint of the body (m, 3), and points below the floor."""
    band = plane.thickness
    height = plane.height(points)
    on_it = np.abs(height) <= band
    above = plane.height(body)
    low = plane.flat(body[(above > band) & (above < band + 0.03)])         # the lowest 3 cm: its footprint
    on_it[on_it] = ~inside_outline(plane.flat(points[on_it]), low, bridge=0.015)
    return np.asarray(on_it | (height < -band))


def inside_outline(points: np.ndarray, outline: np.ndarray, bridge: float) -> np.ndarray:
    """Find points (n,) bool, of (n, 2), on or inside the closed curves that other points (m, 2) trace.

    Gaps up to `bridge` metres are closed.
    """
    if not len(outline) or not len(points):
        return np.zeros(len(points), dtype=bool)
    # draw the outline into a grid, close gaps by dilation, fill it, and erode it back
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
    """Compute the area, square metres, of the cells of width `cell`, metres, that contain points (n, 2)."""
    place = np.floor((flat - flat.min(axis=0, initial=np.inf)) / cell).astype(np.int64)
    return len(np.unique(place[:, 0] * (place[:, 1].max(initial=0) + 1) + place[:, 1])) * cell**2


def _fit(points: np.ndarray) -> Plane:
    """Fit a plane to points (n, 3) by least squares."""
    centre = points.mean(axis=0)
    spread, axes = np.linalg.eigh(np.cov(points.T, bias=True))
    return Plane(axes[:, 0], float(axes[:, 0] @ centre), float(np.sqrt(max(spread[0], 0.0))))


def _refine(plane: Plane, points: np.ndarray, band: float) -> Plane:
    """Refine a plane on ever closer points, at first within `band` metres; feet hardly count in its noise."""
    for _ in range(8):
        height = plane.height(points)
        near = points[np.abs(height) < band]
        fitted = _fit(near)
        if fitted.normal @ plane.normal < 0:
            fitted = fitted.flip()
        # standard deviation from the median; keep points within three of them
        noise = 1.4826 * float(np.median(np.abs(fitted.height(near))))
        plane = Plane(fitted.normal, fitted.offset, max(noise, 1e-5))
        band = min(band, max(3 * plane.noise, 1e-4))
    return plane
