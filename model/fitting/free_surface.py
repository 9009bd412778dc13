"""Free surface: follows the scan where there are data, and keeps the model's shape where there are none."""
from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, csc_array, csr_array

from scanprep.geometry import sparse
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface

from .scan import ScanPoints
from .scan_fit import MIN_COSINE

NEAR, ROUNDS = 0.03, 4              # metres: largest distance of a match; rounds of matching


class FreeSurface:
    """Surface that follows data, and keeps the predicted shape elsewhere.

    The energy E_H has its minimum at the predicted vertices Ŷ. It is quadratic with the matrix L = GᵀG of the
    triangulation, so E_H[Y] = E_H[Ŷ] + tr (Y - Ŷ)ᵀ L (Y - Ŷ) holds exactly, and R, S and Q are not needed again.
    """

    def __init__(self, mesh: Mesh) -> None:
        self.count = len(mesh.vertices)
        self.matrix = edge_matrix(mesh.faces, self.count)

    def solve(self, predicted: np.ndarray, weights: csr_array, targets: np.ndarray, data_weight: np.ndarray
              ) -> np.ndarray:
        """Compute the vertices Y (N, 3), metres, that minimise E_H[Y] + w_Z Σ |y_l - z_l|².

        Parameters
        ----------
        predicted : (N, 3) float, metres
            The model's vertices Ŷ, the minimum of E_H.
        weights : (L, N) sparse
            Each row takes the vertices to a point y_l of the surface.
        targets : (L, 3) float, metres
            Measured points z_l.
        data_weight : (L,) float
            w_Z of each point.

        [SCAPE] Eq. 10
        """
        if not len(targets):
            return predicted
        # normal equations of the offset Y - Ŷ; the tiny diagonal fixes components of the mesh without data
        measured = csc_array(weights.T * data_weight[None, :])
        tiny = 1e-9 * coo_array((np.ones(self.count), (np.arange(self.count),) * 2))
        solve = sparse.factor(csc_array(self.matrix + measured @ weights + tiny))
        return predicted + solve(measured @ (targets - weights @ predicted))


def edge_matrix(faces: np.ndarray, count: int) -> csc_array:
    """Build L = GᵀG (N, N), where G takes the vertices to the two edges of every triangle from its first vertex.

    [SCAPE] Eq. 2
    """
    rows = np.repeat(np.arange(2 * len(faces)), 2)
    columns = faces[:, [1, 0, 2, 0]].ravel()
    G = csr_array((np.tile([1.0, -1.0], 2 * len(faces)), (rows, columns)), shape=(2 * len(faces), count))
    return csc_array(G.T @ G)


def free_surface(predicted: Mesh, cloud: ScanPoints, surface_weight: float = 1.0
                 ) -> tuple[Mesh, np.ndarray, np.ndarray, float]:
    """Return the completed mesh, its observed vertices (N,), the used scan points (n,) and their RMS distance, metres.

    `surface_weight` is w_Z: how strongly each measured point attracts the surface.

    [SCAPE] Eq. 10
    """
    solver = FreeSurface(predicted)
    mesh = predicted
    # closest points on the surface so far, if they are near and face the same way, then a new surface
    for _ in range(ROUNDS):
        closest = Surface(mesh).closest(cloud.points)
        agree = np.einsum("nd,nd->n", mesh.face_normals[closest.faces], cloud.normals) > MIN_COSINE
        used = agree & (closest.distances < NEAR)
        weights = _rows(predicted, closest.faces[used], closest.bary[used])
        mesh = predicted.with_vertices(solver.solve(predicted.vertices, weights, cloud.points[used],
                                                    np.full(used.sum(), surface_weight)))
    # a vertex was observed when a used point lies on one of its triangles
    seen = np.zeros(len(predicted.vertices), dtype=bool)
    seen[predicted.faces[closest.faces[used]]] = True
    return mesh, seen, used, distance_to(mesh, cloud.some(used))


def distance_to(mesh: Mesh, cloud: ScanPoints) -> float:
    """Compute the root mean square distance of a scanned surface to a mesh, metres; NaN without points."""
    if not len(cloud.points):
        return np.nan
    return float(np.sqrt(np.average(Surface(mesh).closest(cloud.points).distances**2, weights=cloud.areas)))


def _rows(mesh: Mesh, faces: np.ndarray, bary: np.ndarray) -> csr_array:
    """Build the sparse matrix (L, N) that takes vertices to points on triangles."""
    rows = np.repeat(np.arange(len(faces)), 3)
    return csr_array((bary.ravel(), (rows, mesh.faces[faces].ravel())), shape=(len(faces), len(mesh.vertices)))
