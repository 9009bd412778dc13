"""The collapses of fast-simplification, without those that break the surface."""
from __future__ import annotations

import numpy as np

from ..geometry.mesh import Mesh
from ..repair.manifold import corner_fans
from .quadrics import lowest, sum_at, surface_quadrics

HOLD = 3e-4                          # weight of the distance to vertices beside that to planes


def fast_collapses(mesh: Mesh, faces: int) -> Mesh:
    """Fewer triangles by the collapses that fast-simplification finds, in their order.

    Its collapses are not tested for what they do to the topology. The ones that leave the surface non-manifold are
    taken back, last ones first, so that some triangles more than wanted may be left.

    [QEM] pair contraction
    """
    import fast_simplification

    vertices, triangles = np.array(mesh.vertices), np.array(mesh.faces)         # it wants to write
    collapses = fast_simplification.simplify(vertices, triangles, target_count=faces, return_collapses=True)[2]
    centre = mesh.vertices.mean(axis=0)
    quadrics, areas = (x[:, 0] for x in surface_quadrics((mesh.vertices - centre)[:, None], mesh.faces, HOLD))
    undone = np.zeros(len(collapses), dtype=bool)
    while True:
        kept, number = np.unique(_owners(len(mesh.vertices), collapses[~undone]), return_inverse=True)
        corners = number[mesh.faces]
        whole = (corners != np.roll(corners, 1, axis=1)).all(axis=1)
        left = Mesh(lowest(sum_at(number[:, None], quadrics, len(kept))) + centre, corners[whole])
        bad = _broken(left, sum_at(number[:, None], areas, len(kept)))
        last = np.full(len(kept), -1)
        rows = np.flatnonzero(~undone)
        last[number[collapses[rows, 0]]] = rows                   # in order: the last one written stays
        latest = last[bad]
        if not (latest >= 0).any():
            return left
        undone[latest[latest >= 0]] = True


def _owners(count: int, collapses: np.ndarray) -> np.ndarray:
    """(count,) the vertex that each one ends in, by collapses (n, 2) of the second into the first."""
    owner = np.arange(count)
    owner[collapses[:, 1]] = collapses[:, 0]
    while True:
        further = owner[owner]
        if np.array_equal(further, owner):
            return owner
        owner = further


def _broken(left: Mesh, areas: np.ndarray) -> np.ndarray:
    """(n,) bool: vertices where the surface is not manifold, is gone, or is turned over.

    `areas` (n, 3) are the area vectors of what the vertices stand for.
    """
    bad = np.ones(len(left.vertices), dtype=bool)
    bad[left.faces] = False
    half = np.sort(left.faces * len(bad) + np.roll(left.faces, -1, axis=1), axis=None)
    twice = half[1:][half[1:] == half[:-1]]
    bad[twice // len(bad)] = bad[twice % len(bad)] = True
    bad[left.edges[left.edge_use > 2]] = True
    corners = np.sort(left.faces, axis=1)
    order = np.lexsort(corners.T)
    bad[corners[order[1:]][(corners[order[1:]] == corners[order[:-1]]).all(axis=1)]] = True
    fan = np.unique(np.stack([left.faces.ravel(), corner_fans(left).ravel()]), axis=1)[0]
    bad[np.bincount(fan, minlength=len(bad)) > 1] = True
    meant = areas / np.maximum(np.linalg.norm(areas, axis=1, keepdims=True), 1e-300)
    turned = np.einsum("fd,fd->f", left.face_normals, meant[left.faces].sum(axis=1)) < 0
    bad[left.faces[turned]] = True
    return bad
