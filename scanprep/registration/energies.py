"""The energy terms of a registration: each function returns one term with its Gauss-Newton parts.

A node of the graph has seven unknowns: a left rotation (radians), a change of log-scale and a translation
(metres). All energies are areas times squared lengths, so their balance does not depend on how finely template,
graph or scan are divided.
"""
from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np
from scipy.sparse import bsr_array, coo_array, csc_array, csr_array

from ..geometry import rotations
from ..geometry.least_squares import Minimum, Sparse, levenberg_marquardt
from .deformation_graph import DeformationGraph, NodeMotion, arms

UNKNOWNS = 7


@dataclass(frozen=True, eq=False)
class Pull:
    """A quadratic energy of each vertex, `Σ xᵀ A x - 2 b·x + c`: what matches and landmarks want.

    A (N, 3, 3), square metres; b (N, 3), cubic metres.
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
    """Some of `count` vertices, (n,), drawn to targets (n, 3) with weights (n,), square metres.

    A vertex may have several targets. With their normals the force along the surface is only a share, `slide`, of that
    across it.
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
        self.nodes = M
        self.rows, self.columns = keys // M, keys % M
        self._indptr = np.searchsorted(self.rows, np.arange(M + 1))
        self.vertex_slots = where[:len(of_vertices)].reshape(-1, K * K)
        self.edge_slots = where[len(of_vertices):len(of_vertices) + len(of_edges)].reshape(4, -1)

    def gather(self, slots: np.ndarray, blocks: np.ndarray) -> np.ndarray:
        """Sum blocks (n, 7, 7) into their slots (n,)."""
        n = len(slots)
        add = csr_array(coo_array((np.ones(n), (slots, np.arange(n))), shape=(len(self.rows), n)))
        return (add @ blocks.reshape(n, UNKNOWNS**2)).reshape(-1, UNKNOWNS, UNKNOWNS)

    def matrix(self, blocks: np.ndarray) -> csc_array:
        """The sparse symmetric matrix of all blocks."""
        size = self.nodes * UNKNOWNS
        return csc_array(bsr_array((blocks, self.columns, self._indptr), shape=(size, size)))


@lru_cache(maxsize=4)
def node_pattern(graph: DeformationGraph) -> NodePattern:
    """The pattern of a graph, made once."""
    return NodePattern(graph)


class Term(Protocol):
    """One energy at one state: its value, and on demand what it adds to the normal equations."""

    @property
    def value(self) -> float: ...

    def normal(self, pattern: NodePattern) -> tuple[np.ndarray, np.ndarray]:
        """Gauss-Newton blocks (P, 7, 7) of the pattern and half the gradient (M, 7)."""
        ...


@dataclass(frozen=True, eq=False)
class EdgeTerm:
    """`Σ w |r|²` over the edges (E, 2) of a graph, for residuals r (E, d) with weights w (E,).

    Ji, Jj (E, d, 7) are their derivatives by the unknowns of the first and the second node.
    """

    edges: np.ndarray
    r: np.ndarray
    Ji: np.ndarray
    Jj: np.ndarray
    w: np.ndarray

    @property
    def value(self) -> float:
        return float(np.sum(self.w[:, None] * self.r**2))

    def normal(self, pattern: NodePattern) -> tuple[np.ndarray, np.ndarray]:
        wi, wj = (self.w[:, None, None] * J.transpose(0, 2, 1) for J in (self.Ji, self.Jj))
        blocks = np.concatenate([wi @ self.Ji, wi @ self.Jj, wj @ self.Ji, wj @ self.Jj])
        force = np.concatenate([wi @ self.r[..., None], wj @ self.r[..., None]])[..., 0]
        return (pattern.gather(pattern.edge_slots.reshape(-1), blocks),
                _sum_to(self.edges.T.reshape(-1), force, pattern.nodes))


@dataclass(frozen=True, eq=False)
class DataTerm:
    """What matches and landmarks ask of the nodes that carry the vertices: A, b, c as in `Pull`.

    `active` (n,) are the vertices with a force on them, at x (n, 3), metres; `carriers` and `w` (n, K) the nodes that
    carry them and their shares; `y` (n, K, 3), metres, is the way from node to vertex.
    """

    active: np.ndarray
    carriers: np.ndarray
    w: np.ndarray
    y: np.ndarray
    x: np.ndarray
    A: np.ndarray
    b: np.ndarray
    c: float

    @property
    def value(self) -> float:
        force = np.matmul(self.A, self.x[..., None])[..., 0] - 2 * self.b
        return float(np.sum(self.x * force) + self.c)

    def normal(self, pattern: NodePattern) -> tuple[np.ndarray, np.ndarray]:
        n, K = self.w.shape
        J = np.empty((n, 3, K, UNKNOWNS))
        J[..., :3] = -rotations.hat(self.y).transpose(0, 2, 1, 3)
        J[..., 3] = self.y.transpose(0, 2, 1)
        J[..., 4:] = np.eye(3)[:, None]
        J *= self.w[:, None, :, None]
        flat = J.reshape(n, 3, K * UNKNOWNS)
        force = np.matmul(self.A, self.x[..., None])[..., 0] - self.b
        normal = np.matmul(flat.transpose(0, 2, 1), np.matmul(self.A, flat)).reshape(n, K, UNKNOWNS, K, UNKNOWNS)
        per_node = np.matmul(flat.transpose(0, 2, 1), force[..., None]).reshape(n * K, UNKNOWNS)
        return (pattern.gather(pattern.vertex_slots[self.active].reshape(-1),
                               normal.transpose(0, 1, 3, 2, 4).reshape(n * K * K, UNKNOWNS, UNKNOWNS)),
                _sum_to(self.carriers.reshape(-1), per_node, pattern.nodes))


def data_term(graph: DeformationGraph, motion: NodeMotion, wanted: Pull) -> DataTerm:
    """What matches and landmarks ask of the nodes that carry the vertices."""
    active = np.flatnonzero(np.einsum("nii->n", wanted.A) > 0)
    y, w, carriers = arms(graph, motion, active), graph.weights[active], graph.carriers[active]
    x = np.einsum("nk,nkd->nd", w, motion.positions[carriers] + y)
    return DataTerm(active, carriers, w, y, x, wanted.A[active], wanted.b[active], wanted.c)


def stretch_term(graph: DeformationGraph, motion: NodeMotion, stiffness: float) -> EdgeTerm:
    """Every node wants to see its neighbours where its own rotation and growth would put them.

    A strain of one costs as much as `stiffness` metres from the data.
    """
    i, j = graph.edges.T
    rest = graph.edge_vectors
    y = np.matmul(motion.linear[i], rest[..., None])[..., 0]
    Ji, Jj = np.zeros((2, len(i), 3, UNKNOWNS))
    Ji[..., :3], Ji[..., 3], Ji[..., 4:], Jj[..., 4:] = -rotations.hat(y), y, np.eye(3), -np.eye(3)
    squared = np.sum(rest**2, axis=1)
    squared = np.maximum(squared, 1e-6 * squared.mean())           # nodes may coincide where sheets touch
    return EdgeTerm(graph.edges, y - (motion.positions[j] - motion.positions[i]), Ji, Jj,
                    stiffness**2 * graph.edge_area / squared)


def bend_term(graph: DeformationGraph, motion: NodeMotion, stiffness: float) -> EdgeTerm:
    """Neighbours want to rotate alike: one radian between them costs as much as `stiffness` metres from the data."""
    i, j = graph.edges.T
    r = rotations.log(motion.R[j] @ motion.R[i].transpose(0, 2, 1))
    inverse = rotations.inverse_right_jacobian(r)
    Ji, Jj = np.zeros((2, len(i), 3, UNKNOWNS))
    Ji[..., :3], Jj[..., :3] = -inverse, inverse.transpose(0, 2, 1)
    return EdgeTerm(graph.edges, r, Ji, Jj, stiffness**2 * graph.edge_area)


def growth_term(graph: DeformationGraph, motion: NodeMotion, stiffness: float) -> EdgeTerm:
    """Neighbours want to grow alike: a factor of e between them costs as much as `stiffness` metres from the data."""
    i, j = graph.edges.T
    Ji, Jj = np.zeros((2, len(i), 1, UNKNOWNS))
    Ji[..., 3], Jj[..., 3] = -1, 1
    return EdgeTerm(graph.edges, (motion.log_scale[j] - motion.log_scale[i])[:, None], Ji, Jj,
                    stiffness**2 * graph.edge_area)


@dataclass(frozen=True)
class Stiffness:
    """How much the nodes resist, each in metres of distance to the data; with a growth of 0 they keep their size."""

    stretch: float
    bend: float
    growth: float


def terms(graph: DeformationGraph, motion: NodeMotion, wanted: Pull, stiffness: Stiffness) -> dict[str, Term]:
    """All terms of the energy at one state."""
    return {"data": data_term(graph, motion, wanted),
            "stretch": stretch_term(graph, motion, stiffness.stretch),
            "bend": bend_term(graph, motion, stiffness.bend),
            "growth": growth_term(graph, motion, stiffness.growth)}


def follow_pull(graph: DeformationGraph, motion: NodeMotion, wanted: Pull, stiffness: Stiffness, steps: int
                ) -> Minimum[NodeMotion]:
    """The motion of all nodes of least energy near a motion."""
    pattern = node_pattern(graph)

    def equations(at: NodeMotion) -> Sparse:
        now = terms(graph, at, wanted, stiffness).values()

        def assemble() -> tuple[np.ndarray, csc_array]:
            blocks, half = (np.sum(parts, axis=0) for parts in zip(*(t.normal(pattern) for t in now), strict=True))
            if not stiffness.growth:
                blocks[:, 3], blocks[:, :, 3], half[:, 3] = 0, 0, 0               # the log-scale
            return half.reshape(-1), pattern.matrix(blocks)

        return Sparse(sum(term.value for term in now), assemble)

    return levenberg_marquardt(equations, motion, steps, tolerance=1e-3, damping=1e-5,
                               retract=lambda at, step: at.moved(step.reshape(-1, UNKNOWNS)))


def _sum_to(index: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    n = len(index)
    return csr_array(coo_array((np.ones(n), (index, np.arange(n))), shape=(count, n))) @ values
