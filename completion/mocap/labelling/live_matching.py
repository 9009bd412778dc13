"""Match the points of one frame with predicted markers and their uncertainty."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .assignment import certainty
from .body_search import assign_columns

# Misses of the prediction by body and last offset on three recordings: at 120 Hz 0.9 to 1.8 mm at the median and 7 to
# 15 mm at the 99th percentile; at 30 Hz 3 to 8 and 29 to 84 mm.
SEEN_SD = 0.004                      # metres: standard deviation of a point from its offset, beside the filter's own
ALONE = 9.0                          # cost of a marker without a point: 4.2 deviations of a marker that was just seen
TRIED = 8                            # shifts of groups that are tried, the likeliest first


@dataclass(frozen=True, eq=False)
class Expected:
    """Predicted markers.

    Attributes
    ----------
    places : (L, 3) float, metres
    precision : (L, 3, 3) float, 1/m²
        Inverse covariances of the places.
    """

    places: np.ndarray
    precision: np.ndarray

    def half_squares(self, points: np.ndarray) -> np.ndarray:
        """Compute half the squared deviations (L, N) of points (N, 3) from each predicted marker."""
        apart = points - self.places[:, None]
        return 0.5 * ((apart @ self.precision) * apart).sum(axis=-1)

    def vagueness(self, most: float) -> np.ndarray:
        """Compute the cost (L,) of the uncertainty of each marker, relative to one that was just seen."""
        return np.minimum(-0.5 * np.log(np.linalg.det(self.precision * SEEN_SD**2)), most)


def intersect(first: Expected, second: Expected, rows: np.ndarray) -> Expected:
    """Combine two predictions for some rows (n,), those of `second`, whose errors may be correlated.

    This is covariance intersection with equal weights: it is never overconfident, even if both have the same error.
    """
    places, precision = first.places.copy(), first.precision.copy()
    A, B = first.precision[rows], second.precision
    pulls = A @ first.places[rows][..., None] + B @ second.places[..., None]
    precision[rows] = 0.5 * (A + B)
    places[rows] = np.linalg.solve(A + B, pulls)[..., 0]
    return Expected(places, precision)


def match(expected: Expected, points: np.ndarray, strict: bool) -> tuple[np.ndarray, np.ndarray]:
    """Match points with predicted markers; return the point (L,) of each, -1 without, and its confidence (L,), 0 to 1.

    Parameters
    ----------
    expected : Expected
        Predicted markers.
    points : (N, 3) float, metres
        Points of the frame.
    strict : bool
        Markers with a very uncertain prediction get no point.

    Examples
    --------
    >>> seen = Expected(np.eye(3), np.tile(np.eye(3) / 0.01**2, (3, 1, 1)))
    >>> match(seen, np.array([[0, 1, 0.01], [9, 9, 9], [1, 0, 0]]), strict=True)[0].tolist()
    [2, 0, -1]
    """
    cost = np.minimum(expected.half_squares(points), 2 * ALONE)
    cost += expected.vagueness(np.inf if strict else 0.5 * ALONE)[:, None]
    chosen, _ = assign_columns(cost, ALONE)
    return chosen, certainty(cost, chosen, ALONE)


def shift_groups(expected: Expected, slopes: np.ndarray, covariance: np.ndarray, spread: np.ndarray,
                 points: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Correct matches (L,) in which a group of neighbouring markers was shifted by one.

    A foot that is faster than predicted has its heel where the ankle was predicted, and so on. Each label is plausible
    by itself, but one marker and one point are left over. Such a group is moved so that one marker gets the free point,
    and matched again. The new matches stay if all deviations together, with a common cause, are less.

    Parameters
    ----------
    expected : Expected
        Predicted markers.
    slopes : (L, P, 3) float
        Derivatives of the places by the unknowns of the body.
    covariance : (P, P) float
        Of these unknowns.
    spread : (L,) float, m²
        Variance of each marker in addition.
    points : (N, 3) float, metres
        Points of the frame.
    chosen : (L,) int
        Matches without this correction.
    """
    free = find_unmatched(len(points), chosen)
    # 1.0: least gain in cost
    best, most = chosen, 1.0
    if (chosen >= 0).all() or not len(free):
        return chosen
    off = expected.half_squares(points[free])
    order = np.argsort(off, axis=None)[:TRIED]
    # 16: largest half squared deviation of a common shift
    for marker, j in zip(*np.unravel_index(order[off.ravel()[order] < 16.0], off.shape), strict=True):
        shift = points[free[j]] - expected.places[marker]
        # 0.25 m: neighbouring markers, of a foot, a hand or a head
        group = np.flatnonzero(((expected.places - expected.places[marker])**2).sum(axis=1) < 0.25**2)
        if (chosen[group] >= 0).all():
            continue
        # points without a marker outside the group, relative to the shifted group
        pool = find_unmatched(len(points), np.delete(chosen, group))
        apart = expected.places[group][:, None] + shift - points[pool]
        # 2 cm: standard deviation after the common shift
        moved, _ = assign_columns(np.minimum((apart**2).sum(axis=-1) / (2 * 0.02**2), 2 * ALONE), ALONE)
        moved = np.where(moved >= 0, pool[moved], -1)
        if (moved == chosen[group]).all():
            continue
        before, after = (_joint_cost(expected.places[group], slopes[group], covariance, spread[group], points, of)
                         for of in (chosen[group], moved))
        if before - after > most:
            best, most = chosen.copy(), before - after
            best[group] = moved
    return best


def find_unmatched(count: int, chosen: np.ndarray) -> np.ndarray:
    """Return the points (n,), of `count`, that no marker has in matches (L,)."""
    free = np.ones(count, dtype=bool)
    free[chosen[chosen >= 0]] = False
    return np.flatnonzero(free)


def _joint_cost(places: np.ndarray, slopes: np.ndarray, covariance: np.ndarray, spread: np.ndarray, points: np.ndarray,
                chosen: np.ndarray) -> float:
    """Compute the joint cost of matches (n,), in which correlated deviations by the pose count once."""
    rows = np.flatnonzero(chosen >= 0)
    alone = ALONE * (len(chosen) - len(rows))
    if not len(rows):
        return alone
    # residuals r with covariance S = AᵀCA + spread: half r S⁻¹ r plus half log det S
    r = (points[chosen[rows]] - places[rows]).reshape(-1)
    A = slopes[rows].swapaxes(0, 1).reshape(len(covariance), -1)
    S = A.T @ covariance @ A + np.diag(np.repeat(spread[rows], 3))
    return float(0.5 * r @ np.linalg.solve(S, r) + 0.5 * np.linalg.slogdet(S / SEEN_SD**2)[1]) + alone
