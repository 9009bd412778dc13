"""Masks: files that mark points of a scan as clothing or hair."""
from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from scanprep.geometry import storage
from scanprep.geometry.files import read_points


def read_mask(path: str | Path, points: np.ndarray, unit: str | None = None) -> np.ndarray:
    """Read which points of a scan a file marks.

    Parameters
    ----------
    path : path
        `.json` with the numbers of the marked points, as `mask.json` has them. Or a mesh or point cloud (PLY, PCD, OBJ,
        GLB) of the scan in which marked points have a colour that is not grey: paint clothing in a colour over white,
        in MeshLab or Blender.
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
    if path.suffix.lower() != ".json":
        return _find_painted(path, points, unit)
    numbers, out = storage.read_json(path, "numbers of points"), np.zeros(len(points), dtype=bool)
    if not isinstance(numbers, list):
        raise ValueError(f"{path}: expected a list of numbers of points, found {type(numbers).__name__}")
    for i, number in enumerate(numbers):
        if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number < len(points):
            raise ValueError(f"{path}: element {i}: expected a point of 0..{len(points) - 1}, found {number!r}")
        out[number] = True
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
