"""Path lengths over a template or a scan with holes: they identify a point on the body in every pose."""
from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from ..geometry.farthest_points import thin


def descriptors(lengths: np.ndarray, size: float) -> np.ndarray:
    """Turn path lengths (n, L) into descriptors: logarithms, because near landmarks locate a point more precisely.

    They are divided by the root of L, so that their Euclidean distance is an RMS over landmarks. The 0.1 keeps lengths
    below a tenth of the size from dominating.
    """
    return np.log(lengths / size + 0.1) / np.sqrt(lengths.shape[1])


def path_lengths(points: np.ndarray, normals: np.ndarray, sources: np.ndarray, cell: float, oriented: bool = True
                 ) -> np.ndarray:
    """Compute the lengths (n, L), metres, of the shortest paths from sources (L, 3) to all points, across holes too.

    The points are thinned to `cell` metres. With outward normals (`oriented`) paths do not jump between skins that
    touch. Small remote pieces are reached in a straight line from the nearest point of the rest.
    """
    keep = thin(points, cell)
    p, n = points[keep], normals[keep]
    # link the ten nearest neighbours whose normals agree, at most three spacings apart: points may be sparser than
    # cells
    length, near = cKDTree(p).query(p, min(11, len(p)))
    i, j = np.repeat(np.arange(len(p)), near.shape[1]), near.ravel()
    good = (length.ravel() <= 3 * max(cell, float(np.median(length[:, 1])))) & (j != i)
    i, j, length = i[good], j[good], length.ravel()[good]
    agree = np.einsum("nd,nd->n", n[i], n[j])
    good = (agree if oriented else np.abs(agree)) > 0
    graph = csr_array(coo_array((length[good], (i[good], j[good])), shape=(len(p), len(p))))
    # bridge holes: join pieces with more than 0.3% of the points to the rest where they are nearest, largest first
    count, label = connected_components(graph, directed=False)
    size = np.bincount(label, minlength=count)
    joined = label == size.argmax()
    bridges: list[np.ndarray] = []
    for k in np.argsort(-size):
        if size[k] < 0.003 * len(p) or k == size.argmax():
            continue
        piece, inside = np.flatnonzero(label == k), np.flatnonzero(joined)
        length, to = cKDTree(p[inside]).query(p[piece])
        # over the nearest fiftieth of their points, so that a path may cross anywhere along the gap
        best = np.argsort(length)[:max(len(piece) // 50, 3)]
        bridges.append(np.stack([length[best], piece[best], inside[to[best]]]))
        joined[piece] = True
    if bridges:
        length, i, j = np.concatenate(bridges, axis=1)
        graph = csr_array(graph + coo_array((length, (i.astype(int), j.astype(int))), shape=graph.shape))
    # shortest paths over the joined points; every input point adds the way to its nearest one
    rest = np.flatnonzero(joined)
    tree = cKDTree(p[rest])
    apart, at = tree.query(sources)
    lengths = dijkstra(graph, directed=False, indices=rest[at]).T[rest] + apart
    apart, nearest = tree.query(points)
    return lengths[nearest] + apart[:, None]
