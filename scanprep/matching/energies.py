"""The energy terms of a registration: each function returns one term with its Gauss-Newton parts.

A node of the graph has seven unknowns: a left rotation (radians), a change of log-scale and a translation
(metres). All energies are areas times squared lengths, so their balance does not depend on how finely template,
graph or scan are divided.
"""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import bsr_array, coo_array, csc_array, csr_array

from ..geometry import rotations
from ..geometry.sparse import factor
from .graph import DeformationGraph, NodeMotion, arms

UNKNOWNS = 7


@dataclass(frozen=True, eq=False)
class Pull:
    """A quadratic energy of each vertex, `Σ xᵀ A x - 2 b·x + c`: what matches and landmarks want.

    Attributes
    ----------
    A : (N, 3, 3) float, square metres
    b : (N, 3) float, cubic metres
    c : float
    """

    A: np.ndarray
    b: np.ndarray
    c: float

    def __add__(self, other: Pull) -> Pull:
        return Pull(self.A + other.A, self.b + other.b, self.c + other.c)

    def energy(self, x: np.ndarray) -> float:
        """The energy of vertices (N, 3)."""
        return float(np.einsum("ni,nij,nj->", x, self.A, x, optimize=True) - 2 * np.sum(self.b * x) + self.c)


def pull(count: int, vertices: np.ndarray, targets: np.ndarray, weights: np.ndarray,
         normals: np.ndarray | None = None, slide: float = 1.0) -> Pull:
    """Vertices drawn to target points, with less force along the surface than across it.

    Parameters
    ----------
    count : int
        Number of vertices of the template, N.
    vertices : (n,) int
        A vertex may have several targets.
    targets : (n, 3) float, metres
    weights : (n,) float, square metres
    normals : (n, 3) float, optional
        Of the targets.
    slide : float
        Force along the surface, as a share of that across it.
    """
    A = np.broadcast_to(np.eye(3), (len(vertices), 3, 3))
    if normals is not None:
        A = slide * A + (1 - slide) * normals[:, :, None] * normals[:, None, :]
    A = weights[:, None, None] * A
    b = np.einsum("nij,nj->ni", A, targets)
    gather = csr_array(coo_array((np.ones(len(vertices)), (vertices, np.arange(len(vertices)))),
                                 shape=(count, len(vertices))))
    return Pull((gather @ A.reshape(-1, 9)).reshape(-1, 3, 3), gather @ b, float(np.sum(b * targets)))


class NodePattern:
    """Where the normal matrix of a graph has blocks, and which block every vertex and edge adds to."""

    def __init__(self, graph: DeformationGraph) -> None:
        M, K = len(graph.node_vertices), graph.carriers.shape[1]
        i, j = graph.edges.T
        of_vertices = (graph.carriers[:, :, None] * M + graph.carriers[:, None, :]).reshape(-1)
        of_edges = np.concatenate([i * M + i, i * M + j, j * M + i, j * M + j])
        keys, where = np.unique(np.concatenate([of_vertices, of_edges, np.arange(M) * (M + 1)]),
                                return_inverse=True)
        self.shape = (M, K)
        self.rows, self.columns = keys // M, keys % M
        self._indptr = np.searchsorted(self.rows, np.arange(M + 1))
        self.vertex_slots = where[:len(of_vertices)].reshape(-1, K * K)
        self.edge_slots = where[len(of_vertices):len(of_vertices) + len(of_edges)].reshape(4, -1)

    def gather(self, slots: np.ndarray, blocks: np.ndarray) -> np.ndarray:
        """Sum blocks (n, 7, 7) into their slots (n,)."""
        n = len(slots)
        add = csr_array(coo_array((np.ones(n), (slots, np.arange(n))), shape=(len(self.rows), n)))
        return (add @ blocks.reshape(n, -1)).reshape(-1, UNKNOWNS, UNKNOWNS)

    def matrix(self, blocks: np.ndarray) -> csc_array:
        """The sparse symmetric matrix of all blocks."""
        size = self.shape[0] * UNKNOWNS
        return csc_array(bsr_array((blocks, self.columns, self._indptr), shape=(size, size)))


@dataclass(frozen=True, eq=False)
class Parts:
    """One energy term at one state: half its gradient, its Gauss-Newton matrix in blocks, its value."""

    blocks: np.ndarray
    gradient: np.ndarray
    value: float


def data_term(graph: DeformationGraph, pattern: NodePattern, motion: NodeMotion, wanted: Pull) -> Parts:
    """What matches and landmarks ask of the nodes that carry the vertices."""
    active = np.flatnonzero(np.einsum("nii->n", wanted.A) > 0)
    y, w, carriers = arms(graph, motion)[active], graph.weights[active], graph.carriers[active]
    x = np.einsum("nk,nkd->nd", w, motion.positions[carriers] + y)
    J = np.empty((*y.shape[:2], 3, UNKNOWNS))
    J[..., :3], J[..., 3] = -rotations.hat(y), y
    J[..., 4:] = np.eye(3)
    J *= w[:, :, None, None]
    n, K = w.shape
    flat = J.transpose(0, 2, 1, 3).reshape(n, 3, K * UNKNOWNS)
    force = np.einsum("nij,nj->ni", wanted.A[active], x) - wanted.b[active]
    normal = np.matmul(flat.transpose(0, 2, 1), np.matmul(wanted.A[active], flat))
    blocks = normal.reshape(n, K, UNKNOWNS, K, UNKNOWNS).transpose(0, 1, 3, 2, 4).reshape(-1, UNKNOWNS, UNKNOWNS)
    per_node = np.matmul(flat.transpose(0, 2, 1), force[..., None]).reshape(-1, UNKNOWNS)
    value = float(np.sum(x * force) - np.sum(wanted.b[active] * x) + wanted.c)
    return Parts(pattern.gather(pattern.vertex_slots[active].reshape(-1), blocks),
                 _sum_to(carriers.reshape(-1), per_node, pattern.shape[0]), value)


def stretch_term(graph: DeformationGraph, pattern: NodePattern, motion: NodeMotion, stiffness: float) -> Parts:
    """Every node wants to see its neighbours where its own turn and growth would put them.

    Parameters
    ----------
    stiffness : float, metres
        A strain of one costs as much as this distance from the data.
    """
    i, j = graph.edges.T
    rest = graph.edge_vectors
    w = stiffness**2 * graph.edge_area / np.einsum("ed,ed->e", rest, rest)
    y = np.matmul(motion.linear[i], rest[..., None])[..., 0]
    r = y - (motion.positions[j] - motion.positions[i])
    Ji, Jj = np.zeros((2, len(i), 3, UNKNOWNS))
    Ji[..., :3], Ji[..., 3], Ji[..., 4:], Jj[..., 4:] = -rotations.hat(y), y, np.eye(3), -np.eye(3)
    return _edge_parts(graph, pattern, r, Ji, Jj, w)


def bend_term(graph: DeformationGraph, pattern: NodePattern, motion: NodeMotion, stiffness: float) -> Parts:
    """Neighbours want to turn alike.

    Parameters
    ----------
    stiffness : float, metres
        A turn of one radian between neighbours costs as much as this distance from the data.
    """
    i, j = graph.edges.T
    r = rotations.log(motion.R[j] @ motion.R[i].transpose(0, 2, 1))
    Ji, Jj = np.zeros((2, len(i), 3, UNKNOWNS))
    Ji[..., :3], Jj[..., :3] = -np.eye(3), np.eye(3)
    return _edge_parts(graph, pattern, r, Ji, Jj, stiffness**2 * graph.edge_area)


def growth_term(graph: DeformationGraph, pattern: NodePattern, motion: NodeMotion, stiffness: float) -> Parts:
    """Neighbours want to grow alike.

    Parameters
    ----------
    stiffness : float, metres
        A factor of e between neighbours costs as much as this distance from the data.
    """
    i, j = graph.edges.T
    r = (motion.log_scale[j] - motion.log_scale[i])[:, None]
    Ji, Jj = np.zeros((2, len(i), 1, UNKNOWNS))
    Ji[..., 3], Jj[..., 3] = -1, 1
    return _edge_parts(graph, pattern, r, Ji, Jj, stiffness**2 * graph.edge_area)


def _edge_parts(graph: DeformationGraph, pattern: NodePattern, r: np.ndarray, Ji: np.ndarray, Jj: np.ndarray,
                w: np.ndarray) -> Parts:
    """Parts of `Σ w |r|²` for residuals (E, d) with Jacobians (E, d, 7) at both ends of each edge."""
    i, j = graph.edges.T
    wi, wj = w[:, None, None] * Ji.transpose(0, 2, 1), w[:, None, None] * Jj.transpose(0, 2, 1)
    blocks = np.concatenate([wi @ Ji, wi @ Jj, wj @ Ji, wj @ Jj])
    force = np.concatenate([wi @ r[..., None], wj @ r[..., None]])[..., 0]
    return Parts(pattern.gather(pattern.edge_slots.reshape(-1), blocks),
                 _sum_to(np.concatenate([i, j]), force, pattern.shape[0]), float(np.einsum("e,ed,ed->", w, r, r)))


def _sum_to(index: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    n = len(index)
    return csr_array(coo_array((np.ones(n), (index, np.arange(n))), shape=(count, n))) @ values


@dataclass(frozen=True)
class Stiffness:
    """How much the nodes resist, each in metres of distance to the data."""

    stretch: float
    bend: float
    growth: float


def terms(graph: DeformationGraph, pattern: NodePattern, motion: NodeMotion, wanted: Pull, stiffness: Stiffness
          ) -> dict[str, Parts]:
    """All terms of the energy at one state."""
    return {"data": data_term(graph, pattern, motion, wanted),
            "stretch": stretch_term(graph, pattern, motion, stiffness.stretch),
            "bend": bend_term(graph, pattern, motion, stiffness.bend),
            "growth": growth_term(graph, pattern, motion, stiffness.growth)}


@dataclass(frozen=True, eq=False)
class Descent:
    """The end of a minimisation: the motion, the energy of each term, steps taken, whether it settled."""

    motion: NodeMotion
    energies: dict[str, float]
    iterations: int
    converged: bool


def minimise(graph: DeformationGraph, pattern: NodePattern, motion: NodeMotion, wanted: Pull, stiffness: Stiffness,
             iterations: int, tolerance: float = 1e-4) -> Descent:
    """Levenberg-Marquardt over the motion of all nodes.

    Parameters
    ----------
    tolerance : float
        Relative decrease of the energy below which it has settled.
    """
    damping, done, settled = 1e-4, 0, False
    parts = terms(graph, pattern, motion, wanted, stiffness)
    while done < iterations and not settled:
        gradient = np.sum([p.gradient for p in parts.values()], axis=0)
        value = sum(p.value for p in parts.values())
        H = pattern.matrix(np.sum([p.blocks for p in parts.values()], axis=0))
        diagonal = H.diagonal()
        floor = 1e-9 * diagonal.max()
        while True:
            D = csc_array(coo_array((damping * diagonal + floor, (np.arange(len(diagonal)),) * 2), shape=H.shape))
            step = -factor(H + D)(gradient.reshape(-1)).reshape(-1, UNKNOWNS)
            trial = motion.moved(step)
            new = terms(graph, pattern, trial, wanted, stiffness)
            new_value = sum(p.value for p in new.values())
            if new_value <= value or damping > 1e3:
                break
            damping = max(damping, 1e-4) * 10
        done += 1
        if new_value > value:
            break
        settled = value - new_value <= tolerance * value
        motion, parts, damping = trial, new, damping / 5
    return Descent(motion, {name: p.value for name, p in parts.items()}, done, settled)
