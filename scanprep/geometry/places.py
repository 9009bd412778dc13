"""Distinct places of points: how they repeat, and how far the distinct ones lie apart."""
from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ..threads import search_threads
from .farthest_points import thin


def distinct_rows(rows: np.ndarray) -> np.ndarray | None:
    """The first row that each row (n, 3) is equal to, (n,) int; None where all rows are distinct."""
    rows = np.ascontiguousarray(rows)
    if rows.dtype.kind == "f":
        rows = rows + 0.0                    # minus zero is zero
    # One number for each row sorts many times faster than the rows; rows that share one by chance are told apart.
    bits = rows.view(np.uint64)
    key = np.zeros(len(rows), dtype=np.uint64)
    for column in bits.T:
        key = (key ^ column) * np.uint64(0x9E3779B97F4A7C15)
        key ^= key >> np.uint64(29)
    _, first, group = np.unique(key, return_index=True, return_inverse=True)
    of = first[group.reshape(-1)]
    if not np.array_equal(bits[of], bits):
        _, first, group = np.unique(rows, axis=0, return_index=True, return_inverse=True)
        of = first[group.reshape(-1)]
    return None if len(first) == len(rows) else of


def distinct_places(points: np.ndarray) -> np.ndarray:
    """Numbers of the points (n, 3) that repeat no earlier one, ascending."""
    of = distinct_rows(points)
    return np.arange(len(points)) if of is None else np.flatnonzero(of == np.arange(len(of)))


def spacing(points: np.ndarray) -> float:
    """Median distance, metres, to the nearest distinct place, over the whole surface evenly.

    Points that are repeated, or all but so where views overlap, are one place.

    Parameters
    ----------
    points : (n, 3) float, metres

    Returns
    -------
    float, metres
        0 for fewer than two places.

    Examples
    --------
    >>> line = np.arange(100.0)[:, None] * [1, 0, 0]
    >>> spacing(line), spacing(np.repeat(line, 3, axis=0))
    (1.0, 1.0)
    """
    points = points[distinct_places(points)]
    if len(points) < 2:
        return 0.0
    extent = float(np.ptp(points, axis=0).max())
    # nine points in ten; a depth camera puts those that it did not see 65 m away, a cell for each
    inner = float(np.ptp(np.quantile(points, (0.05, 0.95), axis=0), axis=0).max())
    extent = inner if 0 < inner < extent / 2 else extent                # a few points lie far off the rest
    # along the longest side: one point of each cell is asked, so that no dense part rules
    some = points[thin(points, extent / 80)]
    # neighbours that tell how dense the points are
    apart = cKDTree(points).query(some, min(9, len(points)), workers=search_threads(len(some)))[0][:, 1:]
    # of the distance to the last of them, within which two points are one place
    other = apart > 0.1 * apart[:, -1:]
    return float(np.median(apart[np.arange(len(apart)), other.argmax(axis=1)]))
