"""Find frames in which several people stand apart, and the points of each."""
from __future__ import annotations

import numpy as np
from scipy.cluster.vq import kmeans2

STARTS = 5                           # most frames that are returned
TRIED = 60                           # frames that are tested


def separate_people(points: np.ndarray, people: int) -> tuple[np.ndarray, list[list[np.ndarray]]]:
    """Find frames (n,) in which people stand farthest apart on the ground, and the points of each person there.

    The ground is the coordinate plane in which the points form the clearest groups.

    Parameters
    ----------
    points : (T, C, 3) float, metres
        NaN where a column has no point.
    people : int
        Number of people.

    Raises
    ------
    ValueError
        No frame in which they fall apart into groups of ten points.
    """
    best = list[tuple[float, int, list[np.ndarray]]]()
    fewest = 10  # least points of a person
    for t in np.unique(np.linspace(0, len(points) - 1, TRIED).astype(int)):
        seen = points[t, np.isfinite(points[t, :, 0])]
        for up in range(3):
            flat = np.delete(seen, up, axis=1)
            centres, group = kmeans2(flat, people, seed=0, minit="++")
            groups = [seen[group == k] for k in range(people)]
            if min(map(len, groups)) < fewest:
                continue
            # distance of the centres over the mean distance of points from theirs
            between = min(np.linalg.norm(centres[i] - centres[j]) for i in range(people) for j in range(i))
            within = max(np.linalg.norm(flat - centres[group], axis=1).mean(), 1e-6)
            best.append((float(between / within), int(t), groups))
    if not best:
        raise ValueError(f"points: no frame in which {people} people with at least {fewest} points each stand apart")
    best.sort(key=lambda one: -one[0])
    chosen: dict[int, list[np.ndarray]] = {}
    for _, t, groups in best:
        chosen.setdefault(t, groups)
        if len(chosen) == STARTS:
            break
    return np.array(list(chosen)), list(chosen.values())
