"""Tracks: points of successive frames that are the same marker, as far as their motion tells."""
from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

# At 120 Hz the markers of four recordings miss constant velocity by 0.6 mm at the median, 9 mm at the 99th percentile
# and 18 mm at the 99.9th; other markers are 25 mm away at least, 55 mm at the first percentile.
ACCELERATION = 100.0                 # m/s²; what it may miss besides, over the time since the last observation
SPEED = 5.0                          # m/s of a marker that was seen once, whose velocity is not known
BRIDGE = 0.1                         # seconds out of sight after which a track has ended


def link_points(points: np.ndarray, rate: float) -> np.ndarray:
    """Join points of successive frames to tracks: each is where constant velocity has it, and nothing else is near.

    A track ends rather than take a point that another track may claim: pieces are joined later, by the body. Where
    columns are tracks already, as a camera system writes them, a point that goes on in its own column is preferred.

    Parameters
    ----------
    points : (T, C, 3) float, metres
        NaN where a column has no point. The order of columns need not mean anything.
    rate : float, frames per second

    Returns
    -------
    (T, C) int
        The track of each point, counted from 0; -1 where there is no point.

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
    # of every live track: last position, velocity, frame and column of it, number, and observations so far
    last, velocity = np.zeros((0, 3)), np.zeros((0, 3))
    when, column, number, age = (np.zeros(0, dtype=int) for _ in range(4))
    noise = 0.010  # metres that a prediction may miss at any rate
    margin = 0.004  # and metres besides
    for t in range(T):
        live = (t - when) / rate <= max(BRIDGE, 1.5 / rate)
        last, velocity, when, column, number, age = (
            a[live] for a in (last, velocity, when, column, number, age))
        seen = np.flatnonzero(np.isfinite(points[t, :, 0]))
        p, passed = points[t, seen], (t - when) / rate
        source = np.full(len(seen), -1)                                 # the live track that each point continues

        if len(number) and len(seen):
            apart = np.linalg.norm((last + velocity * passed[:, None])[:, None] - p, axis=2)
            gate = np.where(age > 1, noise + 0.5 * ACCELERATION * passed**2, noise + SPEED * passed)
            # metres that a prediction may miss at most
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
            # times the distance that any other candidate has to be away
            sure = (rival > 1.5 * apart[rows, columns] + margin) | same[rows, columns]
            source[columns[sure]] = rows[sure]

        # points that continue a track update it, others begin one
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
    """Whether columns of points (T, C, 3) follow one marker each for a while, and are not shuffled in every frame."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=2)
    known = steps[np.isfinite(steps)]
    return bool(len(known)) and bool(np.median(known) < SPEED / rate)


def mean_along_tracks(values: np.ndarray, tracks: np.ndarray, half: int) -> np.ndarray:
    """Means (T, C, L) of values (T, C, L) over the observations of a track (T, C), `half` of them to either side."""
    T, C, L = values.shape
    order = np.argsort(tracks.ravel(), kind="stable")
    order = order[tracks.ravel()[order] >= 0]
    number = tracks.ravel()[order]
    begins = np.flatnonzero(np.r_[True, np.diff(number) > 0])[:len(number)]
    ends = np.r_[begins[1:], len(number)]
    first, last = (np.repeat(of, ends - begins) for of in (begins, ends))
    summed = np.concatenate([np.zeros((1, L)), np.cumsum(values.reshape(-1, L)[order], axis=0)])
    at = np.arange(len(number))
    low, high = np.maximum(at - half, first), np.minimum(at + half + 1, last)
    means = values.reshape(-1, L).copy()
    means[order] = (summed[high] - summed[low]) / (high - low)[:, None]
    return means.reshape(T, C, L)
