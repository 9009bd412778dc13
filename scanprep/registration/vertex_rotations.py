"""How a surface has turned around each vertex, whatever moved it."""
from __future__ import annotations

import numpy as np
from scipy.sparse import diags_array

from ..geometry import rotations
from ..geometry.mesh import Mesh


def turns(template: Mesh, x: np.ndarray, rings: int = 4) -> np.ndarray:
    """The rotation of the surroundings of each vertex from template to vertices `x`.

    Parameters
    ----------
    template : Mesh
    x : (N, 3) float, metres
    rings : int
        How far the surroundings reach; a folded triangle must not sway them.

    Returns
    -------
    (N, 3, 3) float
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
