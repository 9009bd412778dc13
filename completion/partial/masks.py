"""Masks: files that mark points of a scan as clothing or hair."""
from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from scanprep.geometry import storage
from scanprep.geometry.files import read_points


def read_mask(path: str | Path, points: np.ndarray, unit: str | None = None) -> np.ndarray:
    """Read which points of a scan a file marks.

    Parameters
    ----------
    path : path
        `.npy` or `.json` with one true, false, 1 or 0 for each point, or with the numbers of the marked points. Or a
        mesh or point cloud (PLY, PCD, OBJ, GLB) of the scan in which marked points have a colour that is not grey:
        paint clothing in a colour over white, in MeshLab or Blender.
    points : (n, 3) float, metres
        Of the scan, one view after the other.
    unit : 'm', 'mm', 'cm' or 'in', optional
        Of a mesh or point cloud.

    Returns
    -------
    (n,) bool
        True for marked points.

    Raises
    ------
    ValueError
        A file that is missing or holds something else; the message names the file and the element.
    """
    path = Path(path)
    ending = path.suffix.lower()
    if ending == ".npy":
        return _read_marked(path, storage.load_array(path), len(points))
    if ending == ".json":
        found = storage.read_json(path, "booleans or numbers of points")
        if not isinstance(found, list):
            raise ValueError(f"{path}: expected a list of booleans or of numbers of points, "
                             f"found {type(found).__name__}")
        return _read_marked(path, _plain(path, found), len(points))
    return _find_painted(path, points, unit)


def _plain(path: Path, values: Sequence[Any]) -> np.ndarray:
    """Convert booleans, or whole numbers, to an array of one type."""
    if values and all(isinstance(value, bool) for value in values):
        return np.array(values, dtype=bool)
    for i, value in enumerate(values):
        if isinstance(value, bool) or not isinstance(value, int):
            raise ValueError(f"{path}: element {i}: expected the number of a point, or true or false for every one, "
                             f"found {value!r}")
    with storage.taking_apart(path, "numbers of points"):
        return np.array(values, dtype=np.int64)


def _read_marked(path: Path, values: np.ndarray, count: int) -> np.ndarray:
    """Return marked points (count,) from one value per point, or from the numbers of marked points."""
    if values.ndim != 1:
        raise ValueError(f"{path}: expected one row of values, found an array of shape {values.shape}")
    if values.dtype == bool or (len(values) == count and len(values) > 2 and set(np.unique(values)) <= {0, 1}):
        if len(values) != count:
            raise ValueError(f"{path}: expected {count} values, one for each point of the scan, "
                             f"found {len(values)}")
        return values.astype(bool)
    if len(values) and not np.issubdtype(values.dtype, np.integer):
        raise ValueError(f"{path}: expected booleans or numbers of points, found values of type {values.dtype}")
    # the other form: numbers of points
    bad = np.flatnonzero((values < 0) | (values >= count))
    if len(bad):
        raise ValueError(f"{path}: element {bad[0]}: expected a point of 0..{count - 1}, found {values[bad[0]]}")
    out = np.zeros(count, dtype=bool)
    out[values.astype(np.int64)] = True
    return out


def _find_painted(path: Path, points: np.ndarray, unit: str | None) -> np.ndarray:
    """Find the points (n,) of a scan nearest to the coloured ones of a file."""
    cloud = read_points(path, unit)
    if cloud.colors is None:
        raise ValueError(f"{path}: expected colours, those of clothing other than grey; found none")
    # 0.1: least difference between two channels of a colour that is not grey
    coloured = np.ptp(cloud.colors, axis=1) > 0.1
    # 0.06% of the scan's extent, 1 mm on a person: largest distance of a painted point from its scan point
    limit = 6e-4 * float(np.ptp(points, axis=0).max())
    if len(cloud.points) == len(points) and np.allclose(cloud.points, points, rtol=0, atol=limit):
        return coloured
    far, nearest = cKDTree(points).query(cloud.points[coloured])
    unmatched = np.flatnonzero(far > limit)
    if len(unmatched):
        which = np.flatnonzero(coloured)[unmatched[0]]
        raise ValueError(f"{path}: point {which}: expected the points of the scan, this one is "
                         f"{1000 * far[unmatched[0]]:.1f} mm from the nearest of them")
    out = np.zeros(len(points), dtype=bool)
    out[nearest] = True
    return out
