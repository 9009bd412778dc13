"""Lengths of paths over a scan with holes or a template: what tells where a point lies, the same in every pose."""
from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from ..geometry.farthest_points import thin


def descriptors(lengths: np.ndarray, size: float) -> np.ndarray:
    """Lengths (n, L) to compare: near landmarks tell more precisely than far ones, so logarithms.

    Divided by the root of their number: the distance of two descriptors is the root mean square over landmarks.
    """
    return np.log(lengths / size + 0.1) / np.sqrt(lengths.shape[1])


def path_lengths(points: np.ndarray, normals: np.ndarray, sources: np.ndarray, cell: float, oriented: bool = True
                 ) -> np.ndarray:
    """Lengths (n, L), metres, of the shortest paths from sources (L, 3) to all points of a surface, holes bridged.

    The points are thinned to `cell` metres. Where the normals point outward, `oriented`, paths do not jump between
    skins that touch. Small pieces far from everything take the way to the nearest point of the rest as the crow flies.
    """
    keep = thin(points, cell)
    p, n = points[keep], normals[keep]
    # links between the ten nearest whose normals agree; the points may lie wider than the cells
    length, near = cKDTree(p).query(p, min(11, len(p)))
    i, j = np.repeat(np.arange(len(p)), near.shape[1]), near.ravel()
    good = (length.ravel() <= 3 * max(cell, float(np.median(length[:, 1])))) & (j != i)
    i, j, length = i[good], j[good], length.ravel()[good]
    agree = np.einsum("nd,nd->n", n[i], n[j])
    good = (agree if oriented else np.abs(agree)) > 0
    graph = csr_array(coo_array((length[good], (i[good], j[good])), shape=(len(p), len(p))))
    # pieces of more than three thousandths are joined, the largest first, to what there is, where they are nearest
    count, label = connected_components(graph, directed=False)
    size = np.bincount(label, minlength=count)
    joined = label == size.argmax()
    bridges: list[np.ndarray] = []
    for k in np.argsort(-size):
        if size[k] < 0.003 * len(p) or k == size.argmax():
            continue
        piece, inside = np.flatnonzero(label == k), np.flatnonzero(joined)
        length, to = cKDTree(p[inside]).query(p[piece])
        best = np.argsort(length)[:max(len(piece) // 50, 3)]
        bridges.append(np.stack([length[best], piece[best], inside[to[best]]]))
        joined[piece] = True
    if bridges:
        length, i, j = np.concatenate(bridges, axis=1)
        graph = csr_array(graph + coo_array((length, (i.astype(int), j.astype(int))), shape=graph.shape))
    rest = np.flatnonzero(joined)
    tree = cKDTree(p[rest])
    apart, at = tree.query(sources)
    lengths = dijkstra(graph, directed=False, indices=rest[at]).T[rest] + apart
    apart, nearest = tree.query(points)
    return lengths[nearest] + apart[:, None]
