"""Tracks: join points of successive frames that are the same marker, as far as their motion tells."""
from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

# Four recordings at 120 Hz: constant velocity misses by 0.6 mm at the median, 9 mm at the 99th percentile, 18 mm at the
# 99.9th. The nearest other marker is at least 25 mm away, 55 mm at the first percentile.
ACCELERATION = 100.0                 # m/s²: largest acceleration since the last observation
SPEED = 5.0                          # m/s: largest speed of a marker that was seen once
BRIDGE = 0.1                         # seconds out of sight after which a track ends


def link_points(points: np.ndarray, rate: float) -> np.ndarray:
    """Join points of successive frames to tracks: where constant velocity predicts them, if nothing else is near.

    A track ends rather than take a point that another track may claim; the body joins the pieces later. Where columns
    are tracks already, as camera systems write them, a point in the same column is preferred.

    Parameters
    ----------
    points : (T, C, 3) float, metres
        NaN where a column has no point. The order of columns need not mean anything.
    rate : float, frames per second
        Of the points.

    Returns
    -------
    (T, C) int
        Track of each point, counted from 0; -1 where there is no point.

    Examples
    --------
    >>> walk = np.linspace(0, 1, 50)[:, None, None] * [1.0, 0, 0] + [[0, 0, 0], [0, 1, 0]]
    >>> walk[1::2] = walk[1::2, ::-1]                                   # columns exchanged in every other frame
    >>> link_points(walk, 100.0)[:3].tolist()
    [[0, 1], [1, 0], [0, 1]]
    """
    T, C = points.shape[:2]
    tracks, count = np.full((T, C), -1), 0
    steady = has_tracks(points, rate)
    # for every live track: last position, velocity, frame, column, number, and count of observations
    last, velocity = np.zeros((0, 3)), np.zeros((0, 3))
    when, column, number, age = (np.zeros(0, dtype=int) for _ in range(4))
    noise = 0.010  # metres: miss that is always allowed
    margin = 0.004  # metres by which any other candidate has to be farther away
    for t in range(T):
        live = (t - when) / rate <= max(BRIDGE, 1.5 / rate)
        last, velocity, when, column, number, age = (
            a[live] for a in (last, velocity, when, column, number, age))
        seen = np.flatnonzero(np.isfinite(points[t, :, 0]))
        p, passed = points[t, seen], (t - when) / rate
        source = np.full(len(seen), -1)                                 # the live track that each point continues

        # assign points to predictions within a gate, and keep only matches without a rival
        if len(number) and len(seen):
            apart = np.linalg.norm((last + velocity * passed[:, None])[:, None] - p, axis=2)
            gate = np.where(age > 1, noise + 0.5 * ACCELERATION * passed**2, noise + SPEED * passed)
            # 8 cm: largest miss
            gate = np.minimum(gate, 0.08)
            same = steady & (column[:, None] == seen)
            # the same column is believed at twice the distance, whoever else is near
            cost = np.minimum(apart / gate[:, None] * np.where(same, 0.5, 1.0), 1.0)
            rows, columns = linear_sum_assignment(cost)
            taken = cost[rows, columns] < 1
            rows, columns = rows[taken], columns[taken]
            others = apart.copy()
            others[rows, columns] = np.inf
            rival = np.minimum(others[rows].min(axis=1), others[:, columns].min(axis=0))
            # 1.5: factor by which any other candidate has to be farther away
            sure = (rival > 1.5 * apart[rows, columns] + margin) | same[rows, columns]
            source[columns[sure]] = rows[sure]

        # update the tracks of matched points, and begin a track for each other point
        old = source >= 0
        tracks[t, seen[old]] = number[source[old]]
        tracks[t, seen[~old]] = count + np.arange((~old).sum())
        count += int((~old).sum())
        moved, aged = np.zeros_like(p), np.ones(len(p), dtype=int)
        steps = (p[old] - last[source[old]]) / passed[source[old], None]
        share = np.where(age[source[old]] < 3, 1.0, 0.75)[:, None]      # of the newest step in the velocity
        moved[old] = share * steps + (1 - share) * velocity[source[old]]
        aged[old] = age[source[old]] + 1
        rest = np.setdiff1d(np.arange(len(number)), source[old])
        last, velocity = np.concatenate([p, last[rest]]), np.concatenate([moved, velocity[rest]])
        when, column = np.r_[np.full(len(p), t), when[rest]], np.r_[seen, column[rest]]
        number, age = np.r_[tracks[t, seen], number[rest]], np.r_[aged, age[rest]]
    return tracks


def has_tracks(points: np.ndarray, rate: float) -> bool:
    """Tell whether columns of points (T, C, 3) are tracks, not shuffled in every frame, by their median speed."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=2)
    known = steps[np.isfinite(steps)]
    return bool(len(known)) and bool(np.median(known) < SPEED / rate)


def mean_along_tracks(values: np.ndarray, tracks: np.ndarray, half: int) -> np.ndarray:
    """Average values (T, C, L) along tracks (T, C), over `half` observations to either side."""
    T, C, L = values.shape
    order = np.argsort(tracks.ravel(), kind="stable")
    order = order[tracks.ravel()[order] >= 0]
    number = tracks.ravel()[order]
    # differences of running sums, within the range of each track
    begins = np.flatnonzero(np.r_[True, np.diff(number) > 0])[:len(number)]
    ends = np.r_[begins[1:], len(number)]
    first, last = (np.repeat(of, ends - begins) for of in (begins, ends))
    summed = np.concatenate([np.zeros((1, L)), np.cumsum(values.reshape(-1, L)[order], axis=0)])
    at = np.arange(len(number))
    low, high = np.maximum(at - half, first), np.minimum(at + half + 1, last)
    means = values.reshape(-1, L).copy()
    means[order] = (summed[high] - summed[low]) / (high - low)[:, None]
    return means.reshape(T, C, L)
