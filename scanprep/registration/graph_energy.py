"""Energy terms of a deformation graph: each with its value and its part of the normal equations.

All energies are areas times squared lengths. Their balance does not depend on how finely template, graph or scan are
sampled.
"""
from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.sparse import bsr_array, csc_array

from ..geometry import rotations
from ..geometry.sparse import gatherer, sum_groups
from .deformation_graph import DeformationGraph, NodeMotion, arms
from .matches import QuadraticTargets
from .schedule import GraphStage

UNKNOWNS = 7         # of a node: rotation (3), log-scale (1), translation (3)


class NodePattern:
    """Sparsity of the normal matrix of a graph: which blocks exist, and which block every vertex and edge adds to."""

    def __init__(self, graph: DeformationGraph) -> None:
        M, K = len(graph.node_vertices), graph.carriers.shape[1]
        i, j = graph.edges.T
        # a block (i, j) has the key i M + j: pairs of nodes that carry a vertex, ends of edges, and the diagonal
        of_vertices = (graph.carriers[:, :, None] * M + graph.carriers[:, None, :]).reshape(-1)
        of_edges = np.concatenate([i * M + i, i * M + j, j * M + i, j * M + j])
        keys, where = np.unique(np.concatenate([of_vertices, of_edges, np.arange(M) * (M + 1)]),
                                return_inverse=True)
        self.nodes = M
        self.rows, self.columns = keys // M, keys % M
        # the order of entries is found once, so that `matrix` only copies values
        blocks = bsr_array((np.arange(len(keys) * UNKNOWNS**2).reshape(-1, UNKNOWNS, UNKNOWNS), self.columns,
                            np.searchsorted(self.rows, np.arange(M + 1))), shape=(M * UNKNOWNS, M * UNKNOWNS))
        self._entries = csc_array(blocks)            # the place of every entry in the blocks
        self.vertex_slots = where[:len(of_vertices)].reshape(-1, K * K)
        edge_slots = where[len(of_vertices):len(of_vertices) + len(of_edges)].reshape(4, -1)
        self._gather = {count: (gatherer(edge_slots[:, :count].reshape(-1), len(keys)),
                                gatherer(graph.edges[:count].T.reshape(-1), M))
                        for count in (len(graph.edges), len(graph.edges) // 2)}

    def of_edges(self, blocks: np.ndarray, forces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Sum blocks (P, 7, 7) and half the gradient (M, 7) over all edges, or over their first half.

        The blocks (4, E, 7, 7) of every edge are those of its node pairs (i, i), (i, j), (j, i), (j, j). The forces
        (2, E, 7) act on its first and its second node.
        """
        to_blocks, to_nodes = self._gather[blocks.shape[1]]
        return (sum_groups(to_blocks, blocks.reshape(-1, UNKNOWNS, UNKNOWNS)),
                sum_groups(to_nodes, forces.reshape(-1, UNKNOWNS)))

    def matrix(self, blocks: np.ndarray) -> csc_array:
        """Assemble the sparse symmetric matrix of all blocks (P, 7, 7)."""
        entries = self._entries
        return csc_array((blocks.reshape(-1)[entries.data], entries.indices, entries.indptr), shape=entries.shape)


node_pattern = lru_cache(maxsize=4)(NodePattern)          # all rounds of a stage, and a folder of scans, share it


class Term(NamedTuple):
    """One energy at one state: its value, and on demand the Gauss-Newton blocks (P, 7, 7) and half the gradient (M, 7)
    that it adds to the normal equations.
    """

    value: float
    normal: Callable[[NodePattern], tuple[np.ndarray, np.ndarray]]


def _edge_term(r: np.ndarray, w: np.ndarray, jacobians: Callable[[], tuple[np.ndarray, np.ndarray]]) -> Term:
    """Build the term `Σ w |r|²` over the edges of a graph, or their first half: residuals r (E, d), weights w (E,).

    The Jacobians (E, d, 7) are with respect to the unknowns of the first and of the second node.
    """
    def normal(pattern: NodePattern) -> tuple[np.ndarray, np.ndarray]:
        Ji, Jj = jacobians()
        wi, wj = (w[:, None, None] * J.transpose(0, 2, 1) for J in (Ji, Jj))
        return pattern.of_edges(np.stack([wi @ Ji, wi @ Jj, wj @ Ji, wj @ Jj]),
                                np.stack([wi @ r[..., None], wj @ r[..., None]])[..., 0])

    return Term(float(np.sum(w[:, None] * r**2)), normal)


def match_term(graph: DeformationGraph, motion: NodeMotion, wanted: QuadraticTargets) -> Term:
    """Build the data term: squared distances of vertices to their matches and landmarks."""
    # vertices without a match or landmark add nothing
    active = np.flatnonzero(np.einsum("nii->n", wanted.A) > 0)
    A, b = wanted.A[active], wanted.b[active]
    w, carriers = graph.weights[active], graph.carriers[active]
    y = arms(graph, motion, active)
    x = np.einsum("nk,nkd->nd", w, motion.positions[carriers] + y)
    Ax = np.matmul(A, x[..., None])[..., 0]

    def normal(pattern: NodePattern) -> tuple[np.ndarray, np.ndarray]:
        n, K = w.shape
        # Jacobian of a vertex by each of its K nodes: -[y]x for a rotation, y for the log-scale, I for a translation
        J = np.empty((n, 3, K, UNKNOWNS))
        J[..., :3] = -rotations.hat(y).transpose(0, 2, 1, 3)
        J[..., 3] = y.transpose(0, 2, 1)
        J[..., 4:] = np.eye(3)[:, None]
        J *= w[:, None, :, None]
        # Gauss-Newton: JᵀAJ goes to the pairs of nodes that carry the vertex, Jᵀ(Ax - b) to the nodes
        flat = J.reshape(n, 3, K * UNKNOWNS)
        blocks = np.matmul(flat.transpose(0, 2, 1), np.matmul(A, flat)).reshape(n, K, UNKNOWNS, K, UNKNOWNS)
        force = np.matmul(flat.transpose(0, 2, 1), (Ax - b)[..., None]).reshape(n * K, UNKNOWNS)
        return (sum_groups(gatherer(pattern.vertex_slots[active].reshape(-1), len(pattern.rows)),
                           blocks.transpose(0, 1, 3, 2, 4).reshape(n * K * K, UNKNOWNS, UNKNOWNS)),
                sum_groups(gatherer(carriers.reshape(-1), pattern.nodes), force))

    return Term(float(np.sum(x * (Ax - 2 * b)) + wanted.c), normal)


def stretch_term(graph: DeformationGraph, motion: NodeMotion, stiffness: float) -> Term:
    """Build the stretch term: every node predicts where its neighbours are by its own rotation and growth [Hahnel].

    A strain of one costs as much as `stiffness` metres from the data.
    """
    i, j = graph.edges.T
    rest = graph.edge_vectors
    y = np.matmul(motion.linear[i], rest[..., None])[..., 0]
    squared = np.sum(rest**2, axis=1)
    squared = np.maximum(squared, 1e-6 * squared.mean())           # nodes may coincide where sheets touch

    def jacobians() -> tuple[np.ndarray, np.ndarray]:
        Ji, Jj = np.zeros((2, len(i), 3, UNKNOWNS))
        Ji[..., :3], Ji[..., 3], Ji[..., 4:], Jj[..., 4:] = -rotations.hat(y), y, np.eye(3), -np.eye(3)
        return Ji, Jj

    return _edge_term(y - (motion.positions[j] - motion.positions[i]), stiffness**2 * graph.edge_area / squared,
                      jacobians)


def bend_term(graph: DeformationGraph, motion: NodeMotion, stiffness: float) -> Term:
    """Build the bending term between neighbours: one radian costs as much as `stiffness` metres from the data."""
    i, j = graph.links.T
    r = rotations.log(motion.R[j] @ motion.R[i].transpose(0, 2, 1))

    def jacobians() -> tuple[np.ndarray, np.ndarray]:
        Ji, Jj = np.zeros((2, len(i), 3, UNKNOWNS))
        inverse = rotations.inverse_right_jacobian(r)
        Ji[..., :3], Jj[..., :3] = -inverse, inverse.transpose(0, 2, 1)
        return Ji, Jj

    return _edge_term(r, stiffness**2 * graph.link_area, jacobians)


def growth_term(graph: DeformationGraph, motion: NodeMotion, stiffness: float) -> Term:
    """Build the growth term between neighbours: a factor of e costs as much as `stiffness` metres from the data."""
    i, j = graph.links.T

    def jacobians() -> tuple[np.ndarray, np.ndarray]:
        Ji, Jj = np.zeros((2, len(i), 1, UNKNOWNS))
        Ji[..., 3], Jj[..., 3] = -1, 1
        return Ji, Jj

    return _edge_term((motion.log_scale[j] - motion.log_scale[i])[:, None], stiffness**2 * graph.link_area, jacobians)


def terms(graph: DeformationGraph, motion: NodeMotion, wanted: QuadraticTargets, stage: GraphStage, size: float
          ) -> dict[str, Term]:
    """Return all terms of the energy at one state; `size` of the template in metres."""
    return {"data": match_term(graph, motion, wanted),
            "stretch": stretch_term(graph, motion, stage.stretch * size),
            "bend": bend_term(graph, motion, stage.bend * size),
            "growth": growth_term(graph, motion, stage.growth * size)}
