"""Scans that are finer than any work needs, thinned before it, so that it ends within minutes and gigabytes."""
from __future__ import annotations

import warnings

import numpy as np
from scipy.spatial import cKDTree

from .mesh import Mesh
from .places import distinct_rows
from .sparse import label_components

MOST = 1_000_000         # triangles of a person about 1.8 mm long; what has less than twice as many is left as it is


def thin_scan(scan: Mesh, name: str = "scan", most: int = MOST) -> Mesh:
    """A scan with at most about `most` triangles, with a UserWarning, where it had more than twice as many.

    The vertices in each cell of a grid become one, their mean. `of_file` says which one each of the file has become, so
    files of vertex numbers go on to mean the same places. A manifold surface stays one, unless that takes more
    triangles than `most`.

    Parameters
    ----------
    scan : Mesh
        In any unit; the very same comes back where it is not larger.
    name : str
        What the warning calls it: its file, or the argument.
    most : int
    """
    if len(scan.faces) <= 2 * most:
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
    new, faces = _cut_up(np.unique(key, return_inverse=True)[1].reshape(-1), scan, most)
    size = np.bincount(new)
    points = low + _means(scan.vertices - low, new, size)
    colors = None if scan.colors is None else _means(scan.colors, new, size)
    # Of a pleat nothing is left: its vertices become the nearest that are.
    used, numbered = np.unique(faces, return_inverse=True)
    row = np.full(len(size), -1)
    row[used] = np.arange(len(used))
    gone = np.flatnonzero(row < 0)
    row[gone] = cKDTree(points[used]).query(points[gone])[1]
    new = row[new]
    warnings.warn(f"{name}: thinned from {len(scan.faces)} to {len(faces)} triangles before any work", stacklevel=2)
    return Mesh(points[used], numbered.reshape(-1, 3), None if colors is None else colors[used],
                new if scan.of_file is None else np.where(scan.of_file < 0, -1, new[scan.of_file]))


def _cut_up(new: np.ndarray, scan: Mesh, most: int) -> tuple[np.ndarray, np.ndarray]:
    """The new vertex of each vertex (N,), and the triangles (F, 3) of the new ones.

    Where they would make no manifold surface, two sheets share a cell, or one that is folded. There the cells are cut
    into the pieces that the edges inside of them join, and where that is not enough into the vertices of the scan.
    """
    asked = np.ones(new.max() + 1, dtype=bool)              # new vertices that may be bad: all, then those beside cuts
    first = True
    while True:
        corners = new[scan.faces]
        a, b, c = corners.T
        faces = _without_pleats(corners[(a != b) & (b != c) & (c != a)])
        near = Mesh(np.zeros((len(asked), 3)), faces[asked[faces].any(axis=1)])
        bad = np.zeros(len(asked), dtype=bool)
        bad[near.non_manifold_vertices] = True
        bad &= asked & (np.bincount(new) > 1)
        if not bad.any() or len(faces) > most:              # cuts end: vertices of the scan cannot be cut
            return new, faces
        members = np.flatnonzero(bad[new])
        piece = _join(new, members, scan.faces) if first else np.arange(len(members))
        touched = np.unique(corners[bad[corners].any(axis=1)])
        old = np.r_[np.flatnonzero(~bad), np.full(piece.max() + 1, -1)]     # numbers before, of what is left, then cut
        new[members] = len(bad) + piece
        new = np.unique(new, return_inverse=True)[1].reshape(-1)
        asked, first = (old < 0) | np.isin(old, touched), False


def _join(new: np.ndarray, members: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(M,) the piece of each of the vertices `members` (M,): edges join those that have become the same one."""
    row = np.full(len(new), -1)
    row[members] = np.arange(len(members))
    a, b = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    inner = (row[a] >= 0) & (new[a] == new[b])
    return label_components(row[a[inner]], row[b[inner]], len(members))


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
