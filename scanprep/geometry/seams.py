"""Close seams: borders along which a file repeats vertices, for flat shading or texture charts."""
from __future__ import annotations

import numpy as np

from .sparse import label_components


def seams_closed(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray | None:
    """Find the merged vertex (N,) int of each vertex when the seams of a mesh are closed; None without any seam.

    A seam is where two borders run through exactly the same positions. Nothing else is merged, so other touching
    vertices stay, and the remaining vertices keep their order.
    """
    ends = _border(faces, len(vertices))
    if not len(ends):
        return None
    place = np.full(len(vertices), -1)
    used = np.unique(ends)
    rows = np.ascontiguousarray(vertices[used] + 0.0, dtype=np.float64)           # + 0.0: minus zero is zero
    place[used] = np.unique(rows.view(np.dtype((np.void, 24))).ravel(), return_inverse=True)[1]
    # border edges with equal positions at both ends are two sides of a seam
    ends = np.where((place[ends[:, 0]] > place[ends[:, 1]])[:, None], ends[:, ::-1], ends)
    ends = ends[place[ends[:, 0]] < place[ends[:, 1]]]
    key = place[ends[:, 0]] * len(vertices) + place[ends[:, 1]]
    order = np.argsort(key, kind="stable")
    again = np.flatnonzero(np.diff(key[order]) == 0)
    if not len(again):
        return None
    a, b = ends[order[again]].ravel(), ends[order[again + 1]].ravel()
    label = label_components(a, b, len(vertices))
    first = np.unique(label, return_index=True)[1]
    return np.argsort(np.argsort(first))[label]


def _border(faces: np.ndarray, count: int) -> np.ndarray:
    """Return the edges (B, 2) with one triangle only."""
    half = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    key = half.min(axis=1) * count + half.max(axis=1)
    order = np.argsort(key)
    new = np.r_[True, np.diff(key[order]) != 0, True]
    return half[order[new[1:] & new[:-1]]]


def mean_of_merged(values: np.ndarray, vertex_of: np.ndarray) -> np.ndarray:
    """Average values (N, k) over merged vertices (n, k); `vertex_of` (N,) as from `seams_closed`."""
    total = np.zeros((vertex_of.max() + 1, values.shape[1]))
    np.add.at(total, vertex_of, values)
    return total / np.bincount(vertex_of)[:, None]
