"""Thin very fine scans first, so that later stages need only minutes and gigabytes."""
from __future__ import annotations

import warnings

import numpy as np
from scipy.spatial import cKDTree

from .mesh import Mesh
from .places import distinct_rows
from .sparse import label_components

MOST = 1_000_000         # triangles: 1.8 mm edges on a person; up to twice as many are kept


def thin_scan(scan: Mesh, name: str = "scan", most: int = MOST) -> Mesh:
    """Thin a scan with more than twice `most` triangles to about `most`, with a UserWarning.

    The vertices in each grid cell are merged into their mean. `of_file` maps the vertex numbers of the file, so files
    with vertex numbers stay valid. A manifold surface stays manifold, unless that needs more than `most` triangles.

    Parameters
    ----------
    scan : Mesh
        In any unit; the same object is returned if it is not larger.
    name : str
        Name of the scan in the warning: its file, or the argument.
    most : int
        Number of triangles to reach.

    Returns
    -------
    Mesh
    """
    if len(scan.faces) <= 2 * most:
        return scan
    # cell size: a surface of area A meets about 3/2 A / cell² cells, and has two triangles per vertex
    sample = scan.faces[:: max(1, len(scan.faces) // 100_000)]
    a, b, c = np.moveaxis(scan.vertices[sample], 1, 0)
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
    # vertices of folds that vanished become the nearest remaining ones
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
    """Return the new vertex of each vertex (N,), and the new triangles (F, 3), split where they are not manifold.

    There two sheets, or a folded one, share a cell. Such cells are split into the pieces connected by edges inside, and
    if that is not enough into the vertices of the scan.
    """
    asked = np.ones(new.max() + 1, dtype=bool)              # new vertices to check: all, then those beside splits
    first = True
    while True:
        corners = new[scan.faces]
        a, b, c = corners.T
        faces = _without_pleats(corners[(a != b) & (b != c) & (c != a)])
        near = Mesh(np.zeros((len(asked), 3)), faces[asked[faces].any(axis=1)])
        bad = np.zeros(len(asked), dtype=bool)
        bad[near.non_manifold_vertices] = True
        bad &= asked & (np.bincount(new) > 1)
        if not bad.any() or len(faces) > most:              # ends, as single vertices cannot be split
            return new, faces
        members = np.flatnonzero(bad[new])
        piece = _join(new, members, scan.faces) if first else np.arange(len(members))
        touched = np.unique(corners[bad[corners].any(axis=1)])
        old = np.r_[np.flatnonzero(~bad), np.full(piece.max() + 1, -1)]     # previous numbers; -1 for split ones
        new[members] = len(bad) + piece
        new = np.unique(new, return_inverse=True)[1].reshape(-1)
        asked, first = (old < 0) | np.isin(old, touched), False


def _join(new: np.ndarray, members: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Label pieces (M,) of the vertices `members` (M,): edges join those with the same new vertex."""
    row = np.full(len(new), -1)
    row[members] = np.arange(len(members))
    a, b = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    inner = (row[a] >= 0) & (new[a] == new[b])
    return label_components(row[a[inner]], row[b[inner]], len(members))


def _without_pleats(faces: np.ndarray) -> np.ndarray:
    """Keep equal triangles (F, 3) once, with the orientation of most; none if they cancel in pairs.

    Noise folds a fine surface. Dropped pairs have no border of their own, so no hole opens.
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
    """Average values (N, 3) over groups (N,) int into (n, 3)."""
    return np.stack([np.bincount(group, column) / size for column in values.T], axis=1)
