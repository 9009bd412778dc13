"""Deformation gradients: the 3×3 matrices that carry the template's triangles into each instance."""
from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import coo_array, csc_array

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.sparse import Factored


def edges(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Compute the two edges (..., F, 2, 3) of every triangle from its first vertex.

    [SCAPE] Eq. 1
    """
    first = vertices[..., faces[:, 0], :]
    return np.stack([vertices[..., faces[:, 1], :] - first, vertices[..., faces[:, 2], :] - first], axis=-2)


@dataclass(frozen=True, eq=False)
class GradientSystem:
    """The least-squares systems of Eq. 5 and Eq. 8 over the triangles of one template.

    Each row of a gradient has three unknowns a triangle, and the three rows share one matrix. With `parts` (F,),
    neighbours in different parts are not smoothed. w_s is the smoothness times the mean edge length in metres; 0.001 is
    the paper's.

    [SCAPE] Eq. 5
    """

    PULL = 1e-4                          # pull towards I, as a share of w_s: only decides what the edges leave open

    template: Mesh
    smoothness: float = 0.001
    parts: np.ndarray | None = None

    @property
    def w_s(self) -> float:
        """Weight of the smoothness, in square metres like the data term."""
        return self.smoothness * self.template.mean_edge

    @cached_property
    def laplacian(self) -> csc_array:
        """(F, F) graph Laplacian of neighbouring triangles, times w_s, with the pull towards I on its diagonal."""
        pairs = self.template.face_pairs
        if self.parts is not None:
            pairs = pairs[self.parts[pairs[:, 0]] == self.parts[pairs[:, 1]]]
        F = len(self.template.faces)
        a, b = pairs.T
        degree = np.bincount(pairs.ravel(), minlength=F) + self.PULL
        off = coo_array((-np.ones(2 * len(a)), (np.r_[a, b], np.r_[b, a])), shape=(F, F))
        diagonal = coo_array((degree, (np.arange(F), np.arange(F))), shape=(F, F))
        return csc_array(off + diagonal) * self.w_s

    def matrix(self, blocks: np.ndarray) -> csc_array:
        """Assemble the normal matrix (3F, 3F) for data blocks `Σ_j e_j e_jᵀ` (F, 3, 3) of the edges before Q or S."""
        F = len(blocks)
        k = np.arange(F)
        # data: one dense 3×3 block for every triangle on the diagonal
        row = (3 * k[:, None, None] + np.arange(3)[:, None]) + np.zeros((1, 1, 3), int)
        column = (3 * k[:, None, None] + np.arange(3)[None, :]) + np.zeros((1, 3, 1), int)
        smooth = coo_array(self.laplacian)
        # smoothness: the Laplacian couples equal columns c of neighbouring gradients
        r = [row.ravel()] + [3 * smooth.row + c for c in range(3)]
        s = [column.ravel()] + [3 * smooth.col + c for c in range(3)]
        v = [blocks.ravel()] + [smooth.data] * 3
        return csc_array(coo_array((np.concatenate(v), (np.concatenate(r), np.concatenate(s))),
                                   shape=(3 * F, 3 * F)))

    @cached_property
    def of_template(self) -> Factored:
        """The factored system of Eq. 5; it serves every pose, since Q acts on the template's edges."""
        v_hat = edges(self.template.vertices, self.template.faces)
        return Factored(self.matrix(np.swapaxes(v_hat, -1, -2) @ v_hat))

    def right_side(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Compute the right side `Σ_j e_j v_jᵀ` (..., F, 3, 3) of edges (..., F, 2, 3) before, after, and the pull."""
        return np.swapaxes(before, -1, -2) @ after + self.PULL * self.w_s * np.eye(3)


def pose_gradients(system: GradientSystem, local: np.ndarray) -> np.ndarray:
    """Fit Q (M, F, 3, 3) of every triangle to edges (M, F, 2, 3) in the frames of the parts, metres.

    [SCAPE] Eq. 5
    """
    v_hat = edges(system.template.vertices, system.template.faces)
    M, F = local.shape[:2]
    Q = np.empty((M, F, 3, 3))
    # as many instances as the solver takes columns, three columns each
    step = Factored.LIMIT // 3
    for start in range(0, M, step):
        rhs = system.right_side(v_hat, local[start:start + step])        # (m, F, column, row)
        x = system.of_template.solve(rhs.transpose(1, 2, 0, 3).reshape(3 * F, -1))
        Q[start:start + step] = x.reshape(F, 3, -1, 3).transpose(2, 0, 3, 1)
    return Q


def shape_gradients(system: GradientSystem, posed: np.ndarray, local: np.ndarray) -> np.ndarray:
    """Fit S (F, 3, 3) of one person to edges.

    `local` (F, 2, 3) are the edges in the frames of the parts, `posed` (F, 2, 3) the edges `Q v̂`, metres. For n scans
    of one person together both are (F, 2n, 3).

    [SCAPE] Eq. 8
    """
    return ShapeSolver(system, posed)(local)


class ShapeSolver:
    """Eq. 8 for one person, factored once: the matrix holds the person's own `Q v̂`, as for `shape_gradients`.

    [SCAPE] Eq. 8
    """

    # Conjugate gradients do not pay. Preconditioned with one factor for all, carried over to each person by Q, and
    # with twelve people at once, they take 9 steps and two thirds of the time to agree to 1e-11 where people stand in
    # about one pose, but 45 steps in mixed poses, and more time than factoring. Of that, cholespy's search for an order
    # of elimination is three quarters, for every person anew; SuperLU in a given order takes 0.43 s against 0.56.

    def __init__(self, system: GradientSystem, posed: np.ndarray) -> None:
        self.system, self.posed = system, posed
        self._factored = Factored(system.matrix(np.swapaxes(posed, -1, -2) @ posed))

    def __call__(self, local: np.ndarray) -> np.ndarray:
        """Fit S (F, 3, 3) to edges `local`, as for `shape_gradients`."""
        x = self._factored.solve(self.system.right_side(self.posed, local).reshape(-1, 3))
        return np.swapaxes(x.reshape(-1, 3, 3), -1, -2)
