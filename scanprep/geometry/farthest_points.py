"""Points spread over a set: each the farthest from all before it, one in each cell of a grid, or evenly by number."""
from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike


def farthest_points(points: np.ndarray, count: int, start: ArrayLike | None = None,
                    distances: Callable[[int, float], np.ndarray] | None = None, least: float = 0.0) -> np.ndarray:
    """Indices (count,) of points (n, d) far from each other, in the order in which they were chosen.

    `start`, one or several, are chosen beforehand; by default the one farthest from the middle. `distances(i, limit)`
    tells the distance (n,) of all points from point i, beyond the limit it may be larger; by default it is the square
    of the straight one. Fewer are chosen where all others are no farther than `least` from those chosen.
    """
    if start is None:
        start = int(np.argmax(np.linalg.norm(points - points.mean(axis=0), axis=1)))
    chosen = [int(i) for i in np.atleast_1d(start)]
    nearest = np.full(len(points), np.inf)
    for i in chosen:
        np.minimum(nearest, _apart(points, i, np.inf, distances), out=nearest)
    while len(chosen) < min(count, len(points)):
        nearest[chosen] = -1.0                       # never twice, even where all are at distance zero
        far = int(np.argmax(nearest))
        if nearest[far] <= least:
            break
        chosen.append(far)
        if len(chosen) < count:
            np.minimum(nearest, _apart(points, far, float(nearest[far]), distances), out=nearest)
    return np.array(chosen[:count], dtype=np.int64)


def _apart(points: np.ndarray, i: int, limit: float, distances: Callable[[int, float], np.ndarray] | None
           ) -> np.ndarray:
    return ((points - points[i]) ** 2).sum(axis=1) if distances is None else distances(i, limit)


def spread_indices(total: int, count: int) -> np.ndarray:
    """Up to `count` of 0..total-1, evenly spaced and with both ends."""
    return np.unique(np.linspace(0, total - 1, min(count, total)).round().astype(int))


def thin(points: np.ndarray, cell: float) -> np.ndarray:
    """Indices of one point for each cubic cell (metres) that holds any: even density, and less work."""
    key = np.floor((points - points.min(axis=0)) / cell).astype(np.int64)
    key = (key[:, 0] * (key[:, 1].max() + 1) + key[:, 1]) * (key[:, 2].max() + 1) + key[:, 2]
    return np.sort(np.unique(key, return_index=True)[1])
