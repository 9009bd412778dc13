"""Triangles that face against their surroundings, and how they are laid anew."""
from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, csc_array, diags_array

from ..geometry import rotations
from ..geometry.mesh import Mesh
from ..geometry.sparse import factor


def without_inverted(template: Mesh, x: np.ndarray) -> np.ndarray:
    """Vertices (N, 3) where patches around inverted triangles were laid anew, wider ones while that leaves fewer."""
    x = unfold(template, x)
    left = int(find_inverted_triangles(template, x).sum())
    for rings in ((2,), (2, 3), (3, 4)):
        if not left:
            break
        trial = unfold(template, x, rings=rings)
        count = int(find_inverted_triangles(template, trial).sum())
        if count < left:
            x, left = trial, count
    return x


def vertex_rotations(template: Mesh, x: np.ndarray, rings: int = 4) -> np.ndarray:
    """Rotations (N, 3, 3) of the surroundings of each vertex from the template to vertices (N, 3).

    The surroundings reach so many rings far: a folded triangle must not sway them.
    """
    a, b = template.edges.T
    outer = np.einsum("ei,ej->eij", x[b] - x[a], template.vertices[b] - template.vertices[a]).reshape(-1, 9)
    M = np.zeros((len(x), 9))
    for end in (a, b):
        np.add.at(M, end, outer)
    A = template.vertex_adjacency
    spread = diags_array(1 / (1 + np.asarray(A.sum(axis=1)).ravel())) @ (A + diags_array(np.ones(len(x))))
    for _ in range(rings):
        M = spread @ M
    return rotations.project(M.reshape(-1, 3, 3))


def find_inverted_triangles(template: Mesh, x: np.ndarray, linear: np.ndarray | None = None) -> np.ndarray:
    """(F,) bool: triangles of vertices (N, 3) that face away from where their surroundings were rotated to.

    `linear` (N, 3, 3) is the rotation around every vertex, by default that of its surroundings.
    """
    linear = vertex_rotations(template, x) if linear is None else linear
    wanted = np.matmul(linear[template.faces].sum(axis=1), template.face_normals[..., None])[..., 0]
    return np.einsum("fd,fd->f", template.with_vertices(x).face_normals, wanted) < 0


def unfold(template: Mesh, x: np.ndarray, linear: np.ndarray | None = None, rings: tuple[int, ...] = (1, 1, 2)
           ) -> np.ndarray:
    """Vertices (N, 3) with small patches around inverted triangles laid anew, each edge as its surroundings rotated it.

    The patches stay small: where skin truly folds triangles stay inverted, and laying wide patches there would leave
    the data.
    """
    linear = vertex_rotations(template, x) if linear is None else linear
    a, b = template.edges.T
    rest = template.vertices[b] - template.vertices[a]
    wanted = np.matmul(0.5 * (linear[a] + linear[b]), rest[..., None])[..., 0]
    for reach in rings:
        bad = find_inverted_triangles(template, x, linear)
        if not bad.any():
            break
        patch = np.zeros(len(x))
        patch[template.faces[bad]] = 1
        for _ in range(reach):
            patch = (patch + template.vertex_adjacency @ patch > 0).astype(float)
        x = _laid(x, patch > 0, template.edges, wanted)
    return x


def _laid(x: np.ndarray, free: np.ndarray, edges: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Vertices (N, 3) where those that are free have moved so that their edges are nearest to the wanted ones."""
    if free.all():
        return x
    near = free[edges].any(axis=1)
    e = np.arange(int(near.sum()))
    a, b = edges[near].T
    D = csc_array(coo_array((np.r_[np.full(len(e), -1.0), np.ones(len(e))], (np.r_[e, e], np.r_[a, b])),
                            shape=(len(e), len(x))))
    inside, outside = D[:, np.flatnonzero(free)], D[:, np.flatnonzero(~free)]
    x = x.copy()
    x[free] = factor(csc_array(inside.T @ inside))(inside.T @ (wanted[near] - outside @ x[~free]))
    return x
