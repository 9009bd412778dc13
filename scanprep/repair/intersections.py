"""Find intersecting triangles of one mesh."""
from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ..geometry.mesh import Mesh


def intersecting_faces(mesh: Mesh, among: np.ndarray | None = None) -> np.ndarray:
    """Find pairs (n, 2), lower number first, of triangles that cross or are folded onto each other.

    Triangles that only touch, in shared vertices, edges or elsewhere, do not count. At least one of each pair is
    `among` the given ones, (n,) int or (F,) bool; by default all.
    """
    rows = np.arange(len(mesh.faces)) if among is None else np.arange(len(mesh.faces))[among]
    pairs = _near(mesh, rows)
    if not len(pairs):
        return pairs
    f, g = mesh.faces[pairs[:, 0]], mesh.faces[pairs[:, 1]]
    same = f[:, :, None] == g[:, None]                                    # (n, 3, 3)
    shared = same.any(axis=2).sum(axis=1)
    # two triangles cross if a side of one passes through the other
    crossing = np.zeros(len(pairs), dtype=bool)
    for one, other, known in ((f, g, same.any(axis=2)), (g, f, same.any(axis=1))):
        for p, q in ((0, 1), (1, 2), (2, 0)):
            free = ~known[:, p] & ~known[:, q] & (shared < 2)             # a side at a shared vertex only touches
            crossing[free] |= _pierces(mesh.vertices[one[free, p]], mesh.vertices[one[free, q]],
                                       mesh.vertices[other[free]])
    # neighbours with opposite normals are folded onto each other; equal corners are duplicates
    normals = mesh.face_normals
    fold = np.einsum("nd,nd->n", normals[pairs[:, 0]], normals[pairs[:, 1]]) < -1 + 1e-6
    return pairs[crossing | (fold & (shared == 2)) | (shared == 3)]


def _near(mesh: Mesh, rows: np.ndarray) -> np.ndarray:
    """Find pairs (n, 2) of triangles, one of them in `rows`, whose bounding boxes overlap."""
    low, high = mesh.corners.min(axis=1), mesh.corners.max(axis=1)
    middle, reach = (low + high) / 2, np.linalg.norm(high - low, axis=1) / 2
    large = reach > 4 * np.median(reach)                # a few long triangles would widen every search
    pair_lists = []
    for candidates in (np.flatnonzero(~large), np.flatnonzero(large)):
        if len(candidates) and len(rows):
            tree = cKDTree(middle[candidates])
            lists = tree.query_ball_point(middle[rows], reach[rows] + reach[candidates].max())
            pair_lists.append(np.stack([np.repeat(rows, [len(x) for x in lists]),
                                        candidates[np.concatenate(lists).astype(np.int64)]], axis=1))
    pairs = np.sort(np.concatenate(pair_lists), axis=1) if pair_lists else np.empty((0, 2), dtype=np.int64)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    pairs = pairs[((low[pairs[:, 0]] <= high[pairs[:, 1]]) & (low[pairs[:, 1]] <= high[pairs[:, 0]])).all(axis=1)]
    _, first = np.unique(pairs[:, 0] * max(len(mesh.faces), 1) + pairs[:, 1], return_index=True)
    return pairs[first]


def _pierces(p: np.ndarray, q: np.ndarray, triangle: np.ndarray) -> np.ndarray:
    """Test whether segments p q (n, 3) pass through triangles (n, 3, 3)."""
    a, b, c = triangle.transpose(1, 0, 2)
    apart = _orient(a, b, c, p) * _orient(a, b, c, q) < 0
    u, v, w = _orient(p, q, a, b), _orient(p, q, b, c), _orient(p, q, c, a)
    return apart & (((u >= 0) & (v >= 0) & (w >= 0)) | ((u <= 0) & (v <= 0) & (w <= 0)))


def _orient(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Return signed volumes (n,): the sign says on which side of the plane a b c the point d lies."""
    return np.asarray(np.einsum("nd,nd->n", np.cross(b - a, c - a), d - a))
