"""Vertices from triangle edges: the sparse solve, against which the fast path is tested."""
from __future__ import annotations

from functools import cached_property

import numpy as np
from scipy.sparse import coo_array, csc_array

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.sparse import Factored
from scanprep.skeleton.tree import Skeleton


class StitchingSystem:
    """The least-squares fit of vertices to edges, factored once for a triangulation of one component.

    Edges do not determine the place of the body. The root's joint (the centroid of the vertices of part 0) is put in
    the origin, and callers add the place.

    [SCAPE] Eq. 2
    """

    def __init__(self, template: Mesh, skeleton: Skeleton) -> None:
        self.faces = template.faces
        self.n_vertices = len(template.vertices)
        self.root_weights = np.zeros(self.n_vertices)
        ring, weights = skeleton.joint_weights(template, 0)
        self.root_weights[ring] = weights

    @cached_property
    def edge_operator(self) -> csc_array:
        """(2F, N) sparse: `edge_operator @ vertices` are the edges, two rows a triangle."""
        return edge_operator(self.faces, self.n_vertices)

    @cached_property
    def _factored(self) -> Factored:
        # The right-hand sides sum to zero over the vertices, so holding vertex 0 leaves the fit unchanged.
        anchor = coo_array(([1.0], ([0], [0])), shape=(self.n_vertices, self.n_vertices))
        return Factored(csc_array(self.edge_operator.T @ self.edge_operator + anchor))

    def solve(self, rhs: np.ndarray) -> np.ndarray:
        """Solve the normal equations for `edge_operatorᵀ edges` (N, k); the root's joint is put in the origin."""
        y = self._factored.solve(rhs)
        return y - self.root_weights @ y

    def solve_adjoint(self, pick: np.ndarray) -> np.ndarray:
        """Apply the adjoint of `solve` to (N, k): `solve_adjoint(pick).T @ rhs == pick.T @ solve(rhs)`.

        This holds for right sides that sum to zero, as those of edges do.
        """
        return self._factored.solve(pick - np.outer(self.root_weights, pick.sum(axis=0)))

    def stitch(self, edges: np.ndarray) -> np.ndarray:
        """Find the vertices (..., N, 3) whose edges come closest to (..., F, 2, 3) in the least-squares sense.

        [SCAPE] Eq. 2, Eq. 9
        """
        # all bodies and all three coordinates are columns of one right side
        leading = edges.shape[:-3]
        columns = np.moveaxis(edges.reshape(-1, 2 * len(self.faces), 3), 0, 1)
        rhs = self.edge_operator.T @ columns.reshape(2 * len(self.faces), -1)
        y = self.solve(rhs).reshape(self.n_vertices, -1, 3)
        return np.moveaxis(y, 1, 0).reshape(*leading, self.n_vertices, 3)


def edge_operator(faces: np.ndarray, n_vertices: int) -> csc_array:
    """Build the sparse matrix (2F, N) that gives the two edges of every triangle (F, 3) from vertices (N, 3)."""
    row = np.arange(2 * len(faces))
    one = np.ones(len(row))
    end, start = faces[:, 1:].ravel(), np.repeat(faces[:, 0], 2)
    return csc_array(coo_array((np.r_[one, -one], (np.r_[row, row], np.r_[end, start])),
                               shape=(len(row), n_vertices)))
