"""Distinct points: find repeated ones, and the spacing of distinct ones."""
from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ..threads import search_threads
from .farthest_points import thin
from .mesh import Mesh

NEIGHBOURS = 16                      # points, itself included, whose disc tells the area that a point stands for


def distinct_rows(rows: np.ndarray) -> np.ndarray | None:
    """Find for each row (n, 3) the first equal row (n,) int; None if all rows are distinct."""
    rows = np.ascontiguousarray(rows)
    if rows.dtype.kind == "f":
        rows = rows + 0.0                    # -0.0 becomes 0.0
    # one hash per row sorts many times faster than rows; hash collisions are detected below
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
    """Return the indices of points (n, 3) that repeat no earlier one, ascending."""
    of = distinct_rows(points)
    return np.arange(len(points)) if of is None else np.flatnonzero(of == np.arange(len(of)))


def point_areas(scan: Mesh | np.ndarray) -> np.ndarray:
    """Compute the surface area that each point of a scan stands for, so that shares do not depend on its density.

    Parameters
    ----------
    scan : Mesh or (n, 3) float
        A vertex of a mesh stands for a third of its triangles, a bare point for its share of the disc to its
        neighbours.

    Returns
    -------
    (n,) float
        Areas in the square of the scan's unit.

    Examples
    --------
    >>> x, y = np.meshgrid(np.concatenate([np.arange(0.0, 10), np.arange(10, 20, 0.5)]), np.arange(20.0))
    >>> areas = point_areas(np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3))
    >>> round(float(areas[x.ravel() < 10].sum() / areas.sum()), 1)                # a third of the points
    0.5
    """
    if isinstance(scan, Mesh) and len(scan.faces):
        return scan.vertex_areas
    points = scan.vertices if isinstance(scan, Mesh) else scan
    apart, _ = cKDTree(points).query(points, min(NEIGHBOURS, len(points)), workers=search_threads(len(points)))
    return areas_by_neighbours(apart)


def areas_by_neighbours(apart: np.ndarray) -> np.ndarray:
    """Compute the area (n,) that each point stands for, from the distances (n, k) to its neighbours, itself first."""
    areas = np.pi * apart[:, -1]**2 / max(1, apart.shape[1] - 1)
    # stray points far from all others stand for no surface: at most nine times the median, three times the spacing
    return np.minimum(areas, 9 * np.median(areas))


def spacing(points: np.ndarray) -> float:
    """Estimate the spacing of points: the median distance, metres, to the nearest distinct point.

    Repeated points, or nearly repeated ones where views overlap, count as one.

    Parameters
    ----------
    points : (n, 3) float, metres
        Points of a surface.

    Returns
    -------
    float, metres
        0 for fewer than two distinct points.

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
    # extent of nine points in ten: depth cameras put missing points 65 m away, which would need a cell each
    inner = float(np.ptp(np.quantile(points, (0.05, 0.95), axis=0), axis=0).max())
    extent = inner if 0 < inner < extent / 2 else extent                # a few points are far away
    # ask one point per cell, 80 along the longest side, so that dense parts do not dominate
    sample = points[thin(points, extent / 80)]
    # eight neighbours show the local density
    apart = cKDTree(points).query(sample, min(9, len(points)), workers=search_threads(len(sample)))[0][:, 1:]
    # points within a tenth of the eighth neighbour's distance are repeated
    other = apart > 0.1 * apart[:, -1:]
    return float(np.median(apart[np.arange(len(apart)), other.argmax(axis=1)]))
