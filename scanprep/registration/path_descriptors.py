"""Where a point lies, told by its paths to the landmarks: the same in every pose, so it needs no start."""
from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from ..geometry.farthest_points import thin
from ..geometry.mesh import Mesh
from ..geometry.target import Target


def describe_both(template: Mesh, target: Target, anchors: tuple[np.ndarray, np.ndarray], cell: float, size: float
                  ) -> tuple[np.ndarray, np.ndarray]:
    """Descriptors (N, L) of the template's vertices and (n, L) of the scan's points by their paths to the anchors.

    Both surfaces are thinned to the same spacing, `cell` metres, and linked by the same rule, so that what a path along
    links is longer than the true one is the same on both.
    """
    vertices, points = anchors
    mine = path_lengths(template.vertices, template.vertex_normals, template.vertices[vertices], cell)
    theirs = path_lengths(target.points, target.normals, points, cell, target.oriented)
    return descriptors(mine, size), descriptors(theirs, size)


def descriptors(lengths: np.ndarray, size: float) -> np.ndarray:
    """Lengths (n, L) to compare: near landmarks tell more precisely than far ones, so logarithms.

    Divided by the root of their number: the distance of two descriptors is the root mean square over landmarks.
    """
    return np.log(lengths / size + 0.1) / np.sqrt(lengths.shape[1])


def path_lengths(points: np.ndarray, normals: np.ndarray, sources: np.ndarray, cell: float, oriented: bool = True
                 ) -> np.ndarray:
    """Lengths (n, L), metres, of the shortest paths from sources (L, 3) to all points of a surface, holes bridged.

    Where the normals point outward, `oriented`, paths do not jump between skins that touch. Small pieces far from
    everything take the way to the nearest point of the rest as the crow flies.
    """
    keep = thin(points, cell)
    p, n = points[keep], normals[keep]
    graph, joined = _bridged(p, _links(p, n, cell, oriented))
    tree = cKDTree(p[joined])
    near, at = tree.query(sources)
    lengths = dijkstra(graph, directed=False, indices=joined[at]).T[joined] + near
    apart, nearest = tree.query(points)
    return lengths[nearest] + apart[:, None]


def _links(p: np.ndarray, n: np.ndarray, cell: float, oriented: bool, neighbours: int = 10) -> csr_array:
    """Links between near points whose normals agree."""
    length, j = cKDTree(p).query(p, min(neighbours + 1, len(p)))
    coarse = 3 * max(cell, float(np.median(length[:, 1])))         # the points may lie wider than the cells
    i = np.repeat(np.arange(len(p)), j.shape[1])
    j, length = j.ravel(), length.ravel()
    good = (length <= coarse) & (j != i)
    i, j, length = i[good], j[good], length[good]
    agree = np.einsum("nd,nd->n", n[i], n[j])
    good = (agree if oriented else np.abs(agree)) > 0
    return csr_array(coo_array((length[good], (i[good], j[good])), shape=(len(p), len(p))))


def _bridged(p: np.ndarray, graph: csr_array, smallest: float = 0.003) -> tuple[csr_array, np.ndarray]:
    """The graph with its larger pieces joined to the largest where they are nearest; the points that belong to it."""
    count, label = connected_components(graph, directed=False)
    size = np.bincount(label, minlength=count)
    joined = label == size.argmax()
    extra: list[tuple[int, int, float]] = []
    waiting = [k for k in np.argsort(-size) if size[k] >= smallest * len(p) and k != size.argmax()]
    for k in waiting:
        piece = np.flatnonzero(label == k)
        inside = np.flatnonzero(joined)
        length, to = cKDTree(p[inside]).query(p[piece])
        for q in np.argsort(length)[:max(len(piece) // 50, 3)]:
            extra.append((int(piece[q]), int(inside[to[q]]), float(length[q])))
        joined[piece] = True
    if not extra:
        return graph, np.flatnonzero(joined)
    i, j, length = (np.array(column) for column in zip(*extra, strict=True))
    bridges = coo_array((length, (i.astype(int), j.astype(int))), shape=graph.shape)
    return csr_array(graph + bridges), np.flatnonzero(joined)
