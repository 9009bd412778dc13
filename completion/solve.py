"""The two solvers of completion: unknowns of the body by Levenberg-Marquardt, the free surface by one factor."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csc_array, csr_array

from scanprep.geometry import sparse
from scanprep.geometry.mesh import Mesh

from .energy import Residual

Energy = Callable[[np.ndarray], Sequence[Residual]]


@dataclass(frozen=True)
class MinimiseConfig:
    """Settings of Levenberg-Marquardt.

    Attributes
    ----------
    iterations : int
        Most steps taken.
    damping : float
        First factor on the diagonal of the normal matrix.
    tolerance : float
        Stop when a step lowers the energy by less than this fraction.
    """

    iterations: int = 30
    damping: float = 1e-3
    tolerance: float = 1e-5


@dataclass(frozen=True, eq=False)
class Minimum:
    """Where a batch of minimisations ended.

    Attributes
    ----------
    x : (B, P) float
    energy : (B,) float
    converged : (B,) bool
    iterations : int
    """

    x: np.ndarray
    energy: np.ndarray
    converged: np.ndarray
    iterations: int


def minimise(energy: Energy, start: np.ndarray, config: MinimiseConfig | None = None) -> Minimum:
    """Levenberg-Marquardt on a batch of independent problems, each with its own damping.

    Parameters
    ----------
    energy : x (B, P) -> residuals with leading dimension B
    start : (B, P) float
    """
    config = config or MinimiseConfig()
    x = np.array(start, dtype=np.float64)
    cost, gradient, hessian = normal_equations(energy(x))
    damping = np.full(len(x), config.damping)
    converged = np.zeros(len(x), dtype=bool)
    done = 0
    while done < config.iterations and not converged.all():
        done += 1
        diagonal = np.einsum("bpp->bp", hessian)
        ridge = damping[:, None] * diagonal + 1e-9 * diagonal.max(axis=1, keepdims=True)
        step = -np.linalg.solve(hessian + ridge[:, :, None] * np.eye(x.shape[1]), gradient[..., None])[..., 0]
        step[converged] = 0
        tried = normal_equations(energy(x + step))
        better = (tried[0] < cost) & ~converged
        settled = np.abs(cost - tried[0]) <= config.tolerance * np.maximum(cost, 1e-300)
        converged |= settled | (damping > 1e8)
        x[better] += step[better]
        for old, new in zip((cost, gradient, hessian), tried, strict=True):
            old[better] = new[better]
        damping = np.where(better, np.maximum(damping / 5, 1e-9), damping * 8)
    return Minimum(x, cost, converged, done)


def normal_equations(residuals: Sequence[Residual]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Energy (B,), half its gradient (B, P) and the Gauss-Newton matrix (B, P, P) of a sum of residuals."""
    first = residuals[0].jacobian
    cost = np.zeros(len(first))
    gradient = np.zeros((len(first), first.shape[-1]))
    hessian = np.zeros((len(first), first.shape[-1], first.shape[-1]))
    for term in residuals:
        transposed = np.swapaxes(term.jacobian, -1, -2)
        cost += term.energy
        gradient += (transposed @ term.values[..., None])[..., 0]
        hessian += transposed @ term.jacobian
    return cost, gradient, hessian


class FreeSurface:
    """The surface that follows data, and where there are none keeps to the shape the model predicts.

    The model's own energy E_H has its minimum at the predicted vertices, and it is quadratic with the
    matrix L = GᵀG of the triangulation, so E_H[Y] = E_H[Ŷ] + tr (Y - Ŷ)ᵀ L (Y - Ŷ) holds exactly: neither
    R, S nor Q are needed again.

    Parameters
    ----------
    mesh : Mesh
        The triangulation.
    """

    def __init__(self, mesh: Mesh) -> None:
        self.count = len(mesh.vertices)
        self.matrix = edge_matrix(mesh.faces, self.count)

    def solve(self, predicted: np.ndarray, weights: csr_array, targets: np.ndarray, data_weight: np.ndarray
              ) -> np.ndarray:
        """Vertices (N, 3) that minimise E_H[Y] + w_Z Σ |y_l - z_l|².

        Parameters
        ----------
        predicted : (N, 3) float, metres
            The model's vertices Ŷ, the minimum of E_H.
        weights : (L, N) sparse
            The points y_l = weights @ Y on the surface, by barycentric coordinates.
        targets : (L, 3) float, metres
            Where they were measured, z_l.
        data_weight : (L,) float
            w_Z for each.

        [SCAPE] Eq. 10
        """
        if not len(targets):
            return predicted
        measured = csc_array(weights.T * data_weight[None, :])
        tiny = 1e-9 * coo_array((np.ones(self.count), (np.arange(self.count),) * 2))
        solve = sparse.factor(csc_array(self.matrix + measured @ weights + tiny))
        return predicted + solve(measured @ (targets - weights @ predicted))


def edge_matrix(faces: np.ndarray, count: int) -> csc_array:
    """L = GᵀG (N, N), where G takes the vertices to the two edges of every triangle from its first vertex.

    [SCAPE] Eq. 2
    """
    rows = np.repeat(np.arange(2 * len(faces)), 2)
    columns = faces[:, [1, 0, 2, 0]].ravel()
    G = csr_array((np.tile([1.0, -1.0], 2 * len(faces)), (rows, columns)), shape=(2 * len(faces), count))
    return csc_array(G.T @ G)
