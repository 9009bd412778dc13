"""Choose points spread over a set: by farthest point sampling, one per grid cell, or evenly by index."""
from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike


def farthest_points(points: np.ndarray, count: int, start: ArrayLike | None = None,
                    distances: Callable[[int, float], np.ndarray] | None = None, least: float = 0.0) -> np.ndarray:
    """Choose `count` points (n, d) by farthest point sampling; return their indices in the order of choice.

    `start`, one or several indices, are chosen first; by default the point farthest from the centroid.
    `distances(i, limit)` returns the distance (n,) of all points from point i, where values beyond the limit may be any
    larger number. By default it is the squared Euclidean distance. Fewer points are chosen if all others are within
    `least` of the chosen ones.
    """
    if start is None:
        start = int(np.argmax(np.linalg.norm(points - points.mean(axis=0), axis=1)))
    chosen = [int(i) for i in np.atleast_1d(start)]
    nearest = np.full(len(points), np.inf)
    for i in chosen:
        np.minimum(nearest, _apart(points, i, np.inf, distances), out=nearest)
    while len(chosen) < min(count, len(points)):
        nearest[chosen] = -1.0                       # never twice, even if all distances are zero
        far = int(np.argmax(nearest))
        if nearest[far] <= least:
            break
        chosen.append(far)
        if len(chosen) < count:
            np.minimum(nearest, _apart(points, far, float(nearest[far]), distances), out=nearest)
    return np.array(chosen[:count], dtype=np.int64)


def _apart(points: np.ndarray, i: int, limit: float, distances: Callable[[int, float], np.ndarray] | None
           ) -> np.ndarray:
    """Return the distances (n,) of all points from point i."""
    return ((points - points[i]) ** 2).sum(axis=1) if distances is None else distances(i, limit)


def spread_indices(total: int, count: int) -> np.ndarray:
    """Return up to `count` of 0..total-1, evenly spaced and including both ends."""
    return np.unique(np.linspace(0, total - 1, min(count, total)).round().astype(int))


def thin(points: np.ndarray, cell: float) -> np.ndarray:
    """Choose one point per occupied cubic cell (metres); return their indices, ascending."""
    key = np.floor((points - points.min(axis=0)) / cell).astype(np.int64)
    key = (key[:, 0] * (key[:, 1].max() + 1) + key[:, 1]) * (key[:, 2].max() + 1) + key[:, 2]
    return np.sort(np.unique(key, return_index=True)[1])
