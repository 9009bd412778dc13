"""Find and repair inverted triangles: those that face against their surroundings."""
from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, csc_array, diags_array

from ..geometry import rotations
from ..geometry.mesh import Mesh
from ..geometry.sparse import factor


def without_inverted(template: Mesh, x: np.ndarray) -> np.ndarray:
    """Repair inverted triangles of vertices (N, 3), with wider patches as long as fewer remain."""
    x = unfold(template, x)
    remaining = int(find_inverted_triangles(template, x).sum())
    # wider patches are kept only if they leave fewer inverted triangles
    for rings in ((2,), (2, 3), (3, 4)):
        if not remaining:
            break
        trial = unfold(template, x, rings=rings)
        count = int(find_inverted_triangles(template, trial).sum())
        if count < remaining:
            x, remaining = trial, count
    return x


def vertex_rotations(template: Mesh, x: np.ndarray) -> np.ndarray:
    """Estimate the rotation (N, 3, 3) around each vertex, from the template to vertices (N, 3).

    It is averaged over four rings of neighbours, so that a single folded triangle hardly changes it.
    """
    a, b = template.edges.T
    # sum of outer products of edges now and at rest; its nearest rotation is the Procrustes solution
    outer = np.einsum("ei,ej->eij", x[b] - x[a], template.vertices[b] - template.vertices[a]).reshape(-1, 9)
    M = np.zeros((len(x), 9))
    for end in (a, b):
        np.add.at(M, end, outer)
    # average over the neighbours, ring by ring
    A = template.vertex_adjacency
    spread = diags_array(1 / (1 + np.asarray(A.sum(axis=1)).ravel())) @ (A + diags_array(np.ones(len(x))))
    for _ in range(4):
        M = spread @ M
    return rotations.project(M.reshape(-1, 3, 3))


def find_inverted_triangles(template: Mesh, x: np.ndarray, linear: np.ndarray | None = None) -> np.ndarray:
    """Find triangles (F,) bool whose normal points against the rotation of their surroundings.

    `linear` (N, 3, 3) is the rotation around every vertex, by default by `vertex_rotations`.
    """
    linear = vertex_rotations(template, x) if linear is None else linear
    wanted = np.matmul(linear[template.faces].sum(axis=1), template.face_normals[..., None])[..., 0]
    return np.einsum("fd,fd->f", template.with_vertices(x).face_normals, wanted) < 0


def unfold(template: Mesh, x: np.ndarray, rings: tuple[int, ...] = (1, 1, 2)) -> np.ndarray:
    """Re-solve small patches around inverted triangles: each edge as its surroundings rotated it.

    The patches stay small. Where skin really folds, triangles stay inverted, and wide patches would leave the data.
    """
    linear = vertex_rotations(template, x)
    a, b = template.edges.T
    rest = template.vertices[b] - template.vertices[a]
    wanted = np.matmul(0.5 * (linear[a] + linear[b]), rest[..., None])[..., 0]
    for reach in rings:
        bad = find_inverted_triangles(template, x, linear)
        if not bad.any():
            break
        # the vertices of inverted triangles and `reach` rings around them may move
        patch = np.zeros(len(x))
        patch[template.faces[bad]] = 1
        for _ in range(reach):
            patch = (patch + template.vertex_adjacency @ patch > 0).astype(float)
        x = _solve_edges(x, patch > 0, template.edges, wanted)
    return x


def _solve_edges(x: np.ndarray, free: np.ndarray, edges: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Move the free vertices so that their edges come nearest to the wanted ones, in the least-squares sense."""
    if free.all():
        return x
    near = free[edges].any(axis=1)
    e = np.arange(int(near.sum()))
    a, b = edges[near].T
    # D takes vertices to edge vectors; the fixed vertices go to the right-hand side
    D = csc_array(coo_array((np.r_[np.full(len(e), -1.0), np.ones(len(e))], (np.r_[e, e], np.r_[a, b])),
                            shape=(len(e), len(x))))
    inside, outside = D[:, np.flatnonzero(free)], D[:, np.flatnonzero(~free)]
    x = x.copy()
    x[free] = factor(csc_array(inside.T @ inside))(inside.T @ (wanted[near] - outside @ x[~free]))
    return x
