"""Points spread over a set: each next one is the farthest from all before it."""
from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike


def farthest_points(points: np.ndarray, count: int, start: ArrayLike | None = None,
                    distances: Callable[[int, float], np.ndarray] | None = None, least: float = 0.0) -> np.ndarray:
    """Indices (count,) of points (n, d) far from each other, in the order in which they were chosen.

    Parameters
    ----------
    points : (n, d) float
        Whatever can be compared by `distances`, by default positions.
    count : int
        Fewer are chosen where all others are no farther than `least` from those chosen.
    start : int or several, optional
        Points that are chosen beforehand; by default the one farthest from the middle.
    distances : callable, optional
        `distances(i, limit)` is the distance (n,) of all points from point i; what is beyond the limit may be larger.
        By default the square of the straight distance.
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
