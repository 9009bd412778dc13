"""The coarse registration: a deformation graph is drawn to the scan by matches in both directions, stage by stage.

A node has seven unknowns: a left rotation (radians), a change of log-scale and a translation (metres). All energies
are areas times squared lengths, so their balance does not depend on how finely template, graph or scan are divided.
"""
from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache, reduce
from typing import NamedTuple

import numpy as np
from scipy.sparse import bsr_array, coo_array, csc_array, csr_array

from ..geometry import rotations
from ..geometry.farthest_points import thin
from ..geometry.least_squares import Sparse, levenberg_marquardt
from ..geometry.mesh import Mesh
from ..geometry.target import orient
from .deformation_graph import DeformationGraph, build_graph
from .limb_ends import End, RigidFit, bending, find_ends, rotated_ends
from .matches import NORMALS, Inputs, Pull, landmark_pull, pull, wanted_by
from .schedule import GraphStage

UNKNOWNS = 7
SHAPE = 20.0                # what bending of an end of a body in itself weighs against its distance to the scan


def graph_fit(given: Inputs, T: np.ndarray, stages: tuple[GraphStage, ...], ends: int,
              tell: Callable[[int], None]) -> GraphFit:
    """The template bent onto the scan by all stages, from where a rigid transform (4, 4) places it."""
    return followed(given, start_fit(given.template, T, stages[0].nodes if stages else 300), stages, ends, tell)


def followed(given: Inputs, fit: GraphFit, stages: tuple[GraphStage, ...], ends: int,
             tell: Callable[[int], None]) -> GraphFit:
    """The fit after some stages."""
    for stage in stages:
        before, fit = fit, bent(given, fit, stage)
        fit = replace(fit, moved=float(np.linalg.norm(fit.x - before.x, axis=1).mean()))
        tell(stage.rounds)
        if stage.ends:
            for end in find_ends(given.template, ends, 0.14 * given.size) if ends else ():
                fit = with_end_rotated(given, fit, stage, end)
    return fit


def bent(given: Inputs, fit: GraphFit, stage: GraphStage) -> GraphFit:
    """The fit after matches were sought and followed, as often as the stage says."""
    size, template = given.size, given.template
    target, sample = given.target.thinned(stage.detail * size), thin(template.vertices, stage.detail * size)
    fit = fit.refined(template, stage.nodes)
    for _ in range(stage.rounds):
        fit = fit.minimised(wanted_by(given, stage, fit.x, target, sample), _stiffness(stage, size), 1)
    return fit


def with_end_rotated(given: Inputs, fit: GraphFit, stage: GraphStage, end: End) -> GraphFit:
    """The fit with an end of the body rotated about itself, where that lies nearer to the scan and needs less bending.

    A head or a hand that is rolled wrongly lies on the scan as well, but must change its shape for it. The joint above
    may bend, so what counts is how far the end is from an enlarged copy of itself.
    """
    size, template = given.size, given.template
    target = given.target.thinned(0.5 * stage.detail * size)
    target = orient(target, template.with_vertices(fit.x), NORMALS * size)
    scan = RigidFit(target, size)
    tried = rotated_ends(template, end, fit.x, scan)
    if not tried:
        return fit
    held = landmark_pull(len(fit.x), given.landmarks, stage.landmarks * size**2)
    stiffness = _stiffness(stage, size)
    areas = template.vertex_areas

    def trial(places: np.ndarray) -> GraphFit:
        drawn = held + pull(len(fit.x), end.vertices, places, areas[end.vertices])
        return bent(given, fit.minimised(drawn, stiffness, 8), replace(stage, hints=0.0, paths=0.0))

    def misfit(of: GraphFit) -> float:
        """Error against the scan, strain, and what the end is bent in itself, as they are now."""
        body = template.with_vertices(of.x)
        strain = sum(term.value for term in terms(of.graph, of.motion, held, stiffness).values())
        bent = SHAPE * areas[end.vertices].sum() * bending(template.vertices[end.vertices], of.x[end.vertices])[0] ** 2
        return float(scan.error(body.vertices, body.vertex_normals) @ areas) + strain + bent

    return min([fit, *map(trial, tried)], key=misfit)


def _stiffness(stage: GraphStage, size: float) -> Stiffness:
    return Stiffness(stage.stretch * size, stage.bend * size, stage.growth * size)


@dataclass(frozen=True, eq=False)
class NodeMotion:
    """How every node has rotated, R (M, 3, 3), grown, log_scale (M,), and moved: positions (M, 3), metres."""

    R: np.ndarray
    log_scale: np.ndarray
    positions: np.ndarray

    @property
    def linear(self) -> np.ndarray:
        """(M, 3, 3) rotation and growth together."""
        return np.exp(self.log_scale)[:, None, None] * self.R

    def moved(self, step: np.ndarray) -> NodeMotion:
        """After a step (M, 7): left rotation (radians), change of log-scale, translation (metres)."""
        return replace(self, R=rotations.exp(step[:, :3]) @ self.R, log_scale=self.log_scale + step[:, 3],
                       positions=self.positions + step[:, 4:])


def start_motion(graph: DeformationGraph, T: np.ndarray) -> NodeMotion:
    """The motion of all nodes by one rigid transform (4, 4)."""
    M = len(graph.nodes)
    return NodeMotion(np.broadcast_to(T[:3, :3], (M, 3, 3)).copy(), np.zeros(M),
                      graph.nodes @ T[:3, :3].T + T[:3, 3])


def arms(graph: DeformationGraph, motion: NodeMotion, vertices: np.ndarray) -> np.ndarray:
    """(n, K, 3) from each carrying node to each of the vertices (n,), as the node sees it, metres."""
    carriers = graph.carriers[vertices]
    local = graph.rest[vertices, None] - graph.nodes[carriers]
    return np.matmul(motion.linear[carriers], local[..., None])[..., 0]


def deform(graph: DeformationGraph, motion: NodeMotion) -> np.ndarray:
    """The template's vertices (N, 3) after the motion, metres."""
    linear = motion.linear
    offset = motion.positions - np.matmul(linear, graph.nodes[..., None])[..., 0]
    affine = np.concatenate([linear, offset[..., None]], axis=2).reshape(-1, 12)
    blended = np.einsum("nk,nkc->nc", graph.weights, affine[graph.carriers]).reshape(-1, 3, 4)
    return np.matmul(blended[..., :3], graph.rest[..., None])[..., 0] + blended[..., 3]


def transferred(old: DeformationGraph, motion: NodeMotion, new: DeformationGraph) -> NodeMotion:
    """The motion of a finer graph of the same template that repeats the motion of a coarser one."""
    at = new.node_vertices
    w, carriers = old.weights[at], old.carriers[at]
    R = rotations.project(np.einsum("mk,mkij->mij", w, motion.R[carriers]))
    return NodeMotion(R, np.einsum("mk,mk->m", w, motion.log_scale[carriers]), deform(old, motion)[at])


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
        blocks = bsr_array((np.arange(len(keys) * UNKNOWNS**2).reshape(-1, UNKNOWNS, UNKNOWNS), self.columns,
                            np.searchsorted(self.rows, np.arange(M + 1))), shape=(M * UNKNOWNS, M * UNKNOWNS))
        self._entries = csc_array(blocks)            # of every entry its place in the blocks
        self.vertex_slots = where[:len(of_vertices)].reshape(-1, K * K)
        edge_slots = where[len(of_vertices):len(of_vertices) + len(of_edges)].reshape(4, -1)
        self._gather = {count: (gatherer(edge_slots[:, :count].reshape(-1), len(keys)),
                                gatherer(graph.edges[:count].T.reshape(-1), M))
                        for count in (len(graph.edges), len(graph.edges) // 2)}

    def of_edges(self, blocks: np.ndarray, forces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Blocks (P, 7, 7) and half the gradient (M, 7) of all nodes from those of edges, or of their first half.

        Of every edge the blocks (4, E, 7, 7) join the first node with itself, with the second, the second with the
        first and with itself; the forces (2, E, 7) are on the first and the second.
        """
        to_blocks, to_nodes = self._gather[blocks.shape[1]]
        return (summed(to_blocks, blocks.reshape(-1, UNKNOWNS, UNKNOWNS)),
                summed(to_nodes, forces.reshape(-1, UNKNOWNS)))

    def matrix(self, blocks: np.ndarray) -> csc_array:
        """The sparse symmetric matrix of all blocks (P, 7, 7)."""
        entries = self._entries
        return csc_array((blocks.reshape(-1)[entries.data], entries.indices, entries.indptr), shape=entries.shape)


@lru_cache(maxsize=4)
def node_pattern(graph: DeformationGraph) -> NodePattern:
    """The pattern of a graph, made once."""
    return NodePattern(graph)


class Term(NamedTuple):
    """One energy at one state: its value, and on demand the Gauss-Newton blocks (P, 7, 7) and half the gradient (M, 7)
    that it adds to the normal equations.
    """

    value: float
    normal: Callable[[NodePattern], tuple[np.ndarray, np.ndarray]]


def _edge_term(r: np.ndarray, w: np.ndarray, jacobians: Callable[[], tuple[np.ndarray, np.ndarray]]) -> Term:
    """`Σ w |r|²` over the edges of a graph, or their first half, for residuals r (E, d) with weights w (E,).

    The Jacobians (E, d, 7) are by the unknowns of the first and of the second node.
    """
    def normal(pattern: NodePattern) -> tuple[np.ndarray, np.ndarray]:
        Ji, Jj = jacobians()
        wi, wj = (w[:, None, None] * J.transpose(0, 2, 1) for J in (Ji, Jj))
        return pattern.of_edges(np.stack([wi @ Ji, wi @ Jj, wj @ Ji, wj @ Jj]),
                                np.stack([wi @ r[..., None], wj @ r[..., None]])[..., 0])

    return Term(float(np.sum(w[:, None] * r**2)), normal)


def data_term(graph: DeformationGraph, motion: NodeMotion, wanted: Pull) -> Term:
    """What matches and landmarks ask of the nodes that carry the vertices."""
    active = np.flatnonzero(np.einsum("nii->n", wanted.A) > 0)
    A, b = wanted.A[active], wanted.b[active]
    w, carriers = graph.weights[active], graph.carriers[active]
    y = arms(graph, motion, active)
    x = np.einsum("nk,nkd->nd", w, motion.positions[carriers] + y)
    Ax = np.matmul(A, x[..., None])[..., 0]

    def normal(pattern: NodePattern) -> tuple[np.ndarray, np.ndarray]:
        n, K = w.shape
        J = np.empty((n, 3, K, UNKNOWNS))
        J[..., :3] = -rotations.hat(y).transpose(0, 2, 1, 3)
        J[..., 3] = y.transpose(0, 2, 1)
        J[..., 4:] = np.eye(3)[:, None]
        J *= w[:, None, :, None]
        flat = J.reshape(n, 3, K * UNKNOWNS)
        blocks = np.matmul(flat.transpose(0, 2, 1), np.matmul(A, flat)).reshape(n, K, UNKNOWNS, K, UNKNOWNS)
        force = np.matmul(flat.transpose(0, 2, 1), (Ax - b)[..., None]).reshape(n * K, UNKNOWNS)
        return (summed(gatherer(pattern.vertex_slots[active].reshape(-1), len(pattern.rows)),
                       blocks.transpose(0, 1, 3, 2, 4).reshape(n * K * K, UNKNOWNS, UNKNOWNS)),
                summed(gatherer(carriers.reshape(-1), pattern.nodes), force))

    return Term(float(np.sum(x * (Ax - 2 * b)) + wanted.c), normal)


def stretch_term(graph: DeformationGraph, motion: NodeMotion, stiffness: float) -> Term:
    """Every node wants to see its neighbours where its own rotation and growth would put them.

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
    """Neighbours want to rotate alike: one radian between them costs as much as `stiffness` metres from the data."""
    i, j = graph.links.T
    r = rotations.log(motion.R[j] @ motion.R[i].transpose(0, 2, 1))

    def jacobians() -> tuple[np.ndarray, np.ndarray]:
        Ji, Jj = np.zeros((2, len(i), 3, UNKNOWNS))
        inverse = rotations.inverse_right_jacobian(r)
        Ji[..., :3], Jj[..., :3] = -inverse, inverse.transpose(0, 2, 1)
        return Ji, Jj

    return _edge_term(r, stiffness**2 * graph.link_area, jacobians)


def growth_term(graph: DeformationGraph, motion: NodeMotion, stiffness: float) -> Term:
    """Neighbours want to grow alike: a factor of e between them costs as much as `stiffness` metres from the data."""
    i, j = graph.links.T

    def jacobians() -> tuple[np.ndarray, np.ndarray]:
        Ji, Jj = np.zeros((2, len(i), 1, UNKNOWNS))
        Ji[..., 3], Jj[..., 3] = -1, 1
        return Ji, Jj

    return _edge_term((motion.log_scale[j] - motion.log_scale[i])[:, None], stiffness**2 * graph.link_area, jacobians)


class Stiffness(NamedTuple):
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


@dataclass(frozen=True, eq=False)
class GraphFit:
    """Where the template lies: its vertices x (N, 3), metres, and the motion of the nodes that carry them.

    `moved` is how far the last stage moved the mean vertex, metres.
    """

    x: np.ndarray
    graph: DeformationGraph
    motion: NodeMotion
    energies: dict[str, float] = field(default_factory=dict)
    iterations: int = 0
    moved: float = np.inf

    def refined(self, template: Mesh, nodes: int) -> GraphFit:
        """The same motion on a graph of so many nodes."""
        if min(nodes, len(self.x)) == len(self.graph.node_vertices):
            return self
        finer = build_graph(template, nodes)
        return replace(self, graph=finer, motion=transferred(self.graph, self.motion, finer))

    def minimised(self, wanted: Pull, stiffness: Stiffness, steps: int) -> GraphFit:
        """The fit nearer to what matches and landmarks want, against the resistance of the nodes."""
        if not wanted.A.any():
            return self
        pattern = node_pattern(self.graph)

        def equations(at: NodeMotion) -> Sparse:
            now = terms(self.graph, at, wanted, stiffness)

            def assemble() -> tuple[np.ndarray, csc_array]:
                normals = (term.normal(pattern) for term in now.values())
                blocks, half = (reduce(np.add, parts) for parts in zip(*normals, strict=True))
                if not stiffness.growth:
                    blocks[:, 3], blocks[:, :, 3], half[:, 3] = 0, 0, 0               # the log-scale
                return half.reshape(-1), pattern.matrix(blocks)

            values = {name: term.value for name, term in now.items()}
            return Sparse(sum(values.values()), assemble, values)

        found = levenberg_marquardt(equations, self.motion, steps, tolerance=1e-3, damping=1e-5,
                                    retract=lambda at, step: at.moved(step.reshape(-1, UNKNOWNS)))
        return replace(self, x=deform(self.graph, found.x), motion=found.x, energies=found.equations.terms,
                       iterations=self.iterations + found.iterations)


def start_fit(template: Mesh, T: np.ndarray, nodes: int) -> GraphFit:
    """The template where a rigid transform (4, 4) places it, on a graph of so many nodes."""
    graph = build_graph(template, nodes)
    return GraphFit(template.vertices @ T[:3, :3].T + T[:3, 3], graph, start_motion(graph, T))


def gatherer(index: np.ndarray, count: int) -> csr_array:
    """The matrix (count, n) that sums the values of each index (n,)."""
    n = len(index)
    return csr_array(coo_array((np.ones(n), (index, np.arange(n))), shape=(count, n)))


def summed(gather: csr_array, values: np.ndarray) -> np.ndarray:
    """(count, ...) what a `gatherer` makes of values (n, ...)."""
    return (gather @ values.reshape(len(values), math.prod(values.shape[1:]))).reshape(-1, *values.shape[1:])
