"""Scans that are finer than any work needs, thinned before it, so that it ends within minutes and gigabytes."""
from __future__ import annotations

import warnings

import numpy as np

from .mesh import Mesh
from .places import distinct_rows

MOST = 2_000_000         # triangles of a person about 1.3 mm long: finer than any scanner's noise


def thin_scan(scan: Mesh, name: str = "scan", most: int = MOST) -> Mesh:
    """A scan with at most about `most` triangles, with a UserWarning where it had more.

    The vertices in each cell of a grid become one, their mean. `of_file` says which one each of the file has become, so
    files of vertex numbers go on to mean the same places. The surface need not stay manifold.

    Parameters
    ----------
    scan : Mesh
        In any unit; the very same comes back where it is not larger.
    name : str
        What the warning calls it: its file, or the argument.
    most : int
    """
    if len(scan.faces) <= most:
        return scan
    # A grid cuts a surface in about 3/2 as many cells as its area has squares; there is a vertex to two triangles.
    some = scan.faces[:: max(1, len(scan.faces) // 100_000)]
    a, b, c = np.moveaxis(scan.vertices[some], 1, 0)
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).mean() * len(scan.faces)
    cell = float(np.sqrt(3 * area / most))
    low = scan.vertices.min(axis=0)
    counts = np.floor(np.ptp(scan.vertices, axis=0) / cell).astype(np.int64) + 1
    key = np.zeros(len(scan.vertices), dtype=np.int64)
    for axis in range(3):
        key = key * counts[axis] + ((scan.vertices[:, axis] - low[axis]) / cell).astype(np.int64)
    new = np.unique(key, return_inverse=True)[1].reshape(-1)
    size = np.bincount(new)
    faces = new[scan.faces]
    faces = _without_pleats(faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)])
    warnings.warn(f"{name}: thinned from {len(scan.faces)} to {len(faces)} triangles before any work", stacklevel=2)
    return Mesh(low + _means(scan.vertices - low, new, size), faces,
                None if scan.colors is None else _means(scan.colors, new, size),
                new if scan.of_file is None else new[scan.of_file])


def _without_pleats(faces: np.ndarray) -> np.ndarray:
    """Triangles (F, 3) once each, the way that most of the equal ones face; none of an even number.

    Noise lays a surface in pleats. What is dropped has no border of its own, so no hole opens.
    """
    group = distinct_rows(np.sort(faces, axis=1))
    if group is None:
        return faces
    a, b, c = faces.T
    side = np.where((a > b) ^ (b > c) ^ (a > c), -1, 1)
    total = np.bincount(group, side, len(faces))[group]
    agree = np.flatnonzero((side * total > 0) & (total % 2 == 1))
    return np.asarray(faces[agree[np.unique(group[agree], return_index=True)[1]]])


def _means(values: np.ndarray, group: np.ndarray, size: np.ndarray) -> np.ndarray:
    """(n, 3) the mean of the values (N, 3) of each group, (N,) int."""
    return np.stack([np.bincount(group, column) / size for column in values.T], axis=1)
