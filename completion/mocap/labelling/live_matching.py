"""Points of one frame matched with markers that are expected somewhere, and how well that is known."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .body_search import assign_columns

# Where the body that is expected carries the last offset of its point, a marker is 0.9 to 1.8 mm off at 120 Hz at the
# median and 7 to 15 mm at the 99th percentile, on three recordings; at 30 Hz 3 to 8 and 29 to 84 mm.
SEEN_SD = 0.004                      # metres that a point strays from its offset, besides what the filter does not know
# cost of a marker without a point, and of each that is given up: 4.2 deviations of a marker that was just seen
ALONE = 9.0
TRIED = 8                            # shifts, the likeliest first


@dataclass(frozen=True, eq=False)
class Expected:
    """Where markers are expected.

    Attributes
    ----------
    places : (L, 3) float, metres
    precision : (L, 3, 3) float, 1/m²
        Inverse covariances of the places.
    """

    places: np.ndarray
    precision: np.ndarray

    def half_squares(self, points: np.ndarray) -> np.ndarray:
        """Half the squared deviations (L, N) of points (N, 3) from where each marker is expected."""
        apart = points - self.places[:, None]
        return 0.5 * ((apart @ self.precision) * apart).sum(axis=-1)

    def vagueness(self, most: float) -> np.ndarray:
        """What it costs (L,) that a marker may be anywhere in a volume, beside one that was just seen."""
        return np.minimum(-0.5 * np.log(np.linalg.det(self.precision * SEEN_SD**2)), most)


def intersect(first: Expected, second: Expected, rows: np.ndarray) -> Expected:
    """Two predictions joined for some rows (n,) that `second` is of, as if their errors may be the same.

    Covariance intersection with equal weights: never more certain than both together would be if one repeated the
    other.
    """
    places, precision = first.places.copy(), first.precision.copy()
    A, B = first.precision[rows], second.precision
    pulls = A @ first.places[rows][..., None] + B @ second.places[..., None]
    precision[rows] = 0.5 * (A + B)
    places[rows] = np.linalg.solve(A + B, pulls)[..., 0]
    return Expected(places, precision)


def match(expected: Expected, points: np.ndarray, strict: bool) -> tuple[np.ndarray, np.ndarray]:
    """The point (L,) of each marker, -1 without one, and how sure that is (L,), of 0 to 1.

    Parameters
    ----------
    expected : Expected
    points : (N, 3) float, metres
    strict : bool
        Markers of which hardly anything is known get no point.

    Examples
    --------
    >>> seen = Expected(np.eye(3), np.tile(np.eye(3) / 0.01**2, (3, 1, 1)))
    >>> match(seen, np.array([[0, 1, 0.01], [9, 9, 9], [1, 0, 0]]), strict=True)[0].tolist()
    [2, 0, -1]
    """
    cost = np.minimum(expected.half_squares(points), 2 * ALONE)
    cost += expected.vagueness(np.inf if strict else 0.5 * ALONE)[:, None]
    chosen, _ = assign_columns(cost, ALONE)
    return chosen, certainty(cost, chosen)


def certainty(cost: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """How sure (L,) the point of each marker is, of 0 to 1, beside the next best of costs (L, N); 0 without a point."""
    rows, sure = np.flatnonzero(chosen >= 0), np.zeros(len(cost))
    if len(rows):
        here, others = cost[rows, chosen[rows]], cost.copy()
        others[rows, chosen[rows]] = np.inf
        rival = np.minimum(np.minimum(others[:, chosen[rows]].min(axis=0), others[rows].min(axis=1)), ALONE)
        sure[rows] = 1 / (1 + np.exp(np.clip(here - rival, -50.0, 50.0)))
    return sure


def shift_groups(expected: Expected, slopes: np.ndarray, covariance: np.ndarray, spread: np.ndarray,
                 points: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Matches (L,) where markers side by side may all have been taken for their neighbours.

    A foot that is faster than expected has its heel where the ankle was to be, and so on: each label is likely by
    itself, one marker and one point are left over. Groups with such a marker are moved so that one of them gets the
    point, and matched anew; they stay so where all deviations together, with their common cause, are less.

    Parameters
    ----------
    expected : Expected
    slopes : (L, P, 3) float
        Derivatives of the places by the unknowns of the body.
    covariance : (P, P) float
        Of these unknowns.
    spread : (L,) float, m²
        Variance of each marker besides.
    points : (N, 3) float, metres
    chosen : (L,) int
        Matches of each by itself.
    """
    free = find_unmatched(len(points), chosen)
    # cost that this has to save
    best, most = chosen, 1.0
    if (chosen >= 0).all() or not len(free):
        return chosen
    off = expected.half_squares(points[free])
    order = np.argsort(off, axis=None)[:TRIED]
    # half squared deviations by which markers side by side may be off together
    for marker, j in zip(*np.unravel_index(order[off.ravel()[order] < 16.0], off.shape), strict=True):
        shift = points[free[j]] - expected.places[marker]
        # metres within which markers are side by side: those of a foot, a hand, a head
        group = np.flatnonzero(((expected.places - expected.places[marker])**2).sum(axis=1) < 0.25**2)
        if (chosen[group] >= 0).all():
            continue
        # points that no other marker has, after the shift
        pool = find_unmatched(len(points), np.delete(chosen, group))
        apart = expected.places[group][:, None] + shift - points[pool]
        # metres, how well they lie on points after they were moved together
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
    """Which (n,) of so many points no marker has in matches (L,)."""
    free = np.ones(count, dtype=bool)
    free[chosen[chosen >= 0]] = False
    return np.flatnonzero(free)


def _joint_cost(places: np.ndarray, slopes: np.ndarray, covariance: np.ndarray, spread: np.ndarray, points: np.ndarray,
                chosen: np.ndarray) -> float:
    """What matches (n,) of some markers cost together: deviations that have one cause count once."""
    rows = np.flatnonzero(chosen >= 0)
    alone = ALONE * (len(chosen) - len(rows))
    if not len(rows):
        return alone
    r = (points[chosen[rows]] - places[rows]).reshape(-1)
    A = slopes[rows].swapaxes(0, 1).reshape(len(covariance), -1)
    S = A.T @ covariance @ A + np.diag(np.repeat(spread[rows], 3))
    return float(0.5 * r @ np.linalg.solve(S, r) + 0.5 * np.linalg.slogdet(S / SEEN_SD**2)[1]) + alone
