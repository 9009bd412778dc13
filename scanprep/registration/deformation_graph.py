"""A graph of rotating and scaling nodes that carries a surface, and its energies, each with its Gauss-Newton parts.

A node has seven unknowns: a left rotation (radians), a change of log-scale and a translation (metres). All energies
are areas times squared lengths, so their balance does not depend on how finely template, graph or scan are divided.
"""
from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.sparse import bsr_array, coo_array, csc_array, csr_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from ..geometry import rotations
from ..geometry.farthest_points import farthest_points
from ..geometry.least_squares import Sparse, levenberg_marquardt
from ..geometry.mesh import Mesh
from ..geometry.surface import Rays

UNKNOWNS = 7


@dataclass(frozen=True, eq=False)
class DeformationGraph:
    """Nodes on a template, how they carry its vertices, and which nodes hold each other."""

    rest: np.ndarray             # (N, 3) metres, the template's vertices
    node_vertices: np.ndarray    # (M,) the vertex where each node sits
    carriers: np.ndarray         # (N, K) the nodes that carry each vertex
    weights: np.ndarray          # (N, K) their shares, each row summing to 1
    edges: np.ndarray            # (E, 2) directed pairs of nodes, each pair in both directions
    edge_area: np.ndarray        # (E,) square metres, the part of the surface that each edge stands for

    @property
    def nodes(self) -> np.ndarray:
        """(M, 3) rest positions of the nodes, metres."""
        return self.rest[self.node_vertices]

    @property
    def edge_vectors(self) -> np.ndarray:
        """(E, 3) from the first to the second node at rest, metres."""
        return self.nodes[self.edges[:, 1]] - self.nodes[self.edges[:, 0]]


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


@lru_cache(maxsize=4)                # a folder of scans shares one template
def build_graph(template: Mesh, count: int, carriers: int = 4, reach: float = 0.18) -> DeformationGraph:
    """So many nodes spread over a template, linked along and through the body.

    Neighbours on the surface are linked, and so are nodes that face each other through the inside, up to `reach` times
    the root of the template's area: these keep the thickness of limbs where the scan shows nothing, and make a limb's
    cross-section rotate as one.
    """
    nodes = farthest_points(template.vertices, min(count, len(template.vertices)))
    carrying, weights = _carriers(template, nodes, min(carriers, len(nodes) - 1))
    surface = _surface_links(carrying)
    inner = _inner_links(template, nodes, reach * np.sqrt(template.face_areas.sum()))
    links = np.unique(np.sort(np.concatenate([surface, inner]), axis=1), axis=0)
    edges = np.concatenate([links, links[:, ::-1]])
    area = np.bincount(carrying.ravel(), (weights * template.vertex_areas[:, None]).ravel(), len(nodes))
    degree = np.bincount(edges[:, 0], minlength=len(nodes))
    return DeformationGraph(template.vertices, nodes, carrying, weights, edges, (area / degree)[edges[:, 0]])


def _carriers(template: Mesh, nodes: np.ndarray, K: int) -> tuple[np.ndarray, np.ndarray]:
    """The K nodes nearest to each vertex along the surface (N, K) and their shares (N, K)."""
    a, b = template.edges.T
    N = len(template.vertices)
    lengths = csr_array(coo_array((template.edge_lengths, (a, b)), shape=(N, N)))
    best = np.full((N, K + 1), np.inf)
    index = np.zeros((N, K + 1), dtype=np.int64)
    limit = 4 * np.sqrt(template.face_areas.sum() / len(nodes))
    for first in range(0, len(nodes), 128):
        block = nodes[first:first + 128]
        distance = dijkstra(lengths, directed=False, indices=block, limit=limit).T
        every = np.concatenate([best, distance], axis=1)
        number = np.concatenate([index, np.broadcast_to(first + np.arange(len(block)), distance.shape)], axis=1)
        order = np.argpartition(every, K, axis=1)[:, :K + 1]
        best = np.take_along_axis(every, order, axis=1)
        index = np.take_along_axis(number, order, axis=1)
    order = np.argsort(best, axis=1)
    best, index = np.take_along_axis(best, order, axis=1), np.take_along_axis(index, order, axis=1)
    lost = np.flatnonzero(~np.isfinite(best[:, 0]))
    if len(lost):
        straight = ((template.vertices[lost, None] - template.vertices[nodes]) ** 2).sum(axis=-1)
        index[lost], best[lost, 0] = np.argmin(straight, axis=1)[:, None], 0.0
    radius = np.where(np.isfinite(best[:, -1]), best[:, -1], 1.2 * limit)[:, None]
    share = np.where(np.isfinite(best[:, :K]), np.maximum(1 - best[:, :K] / radius, 0) ** 2, 0.0)
    share[:, 0] += 1e-9
    index = np.where(np.isfinite(best), index, index[:, :1])
    return index[:, :K], share / share.sum(axis=1, keepdims=True)


def _surface_links(carriers: np.ndarray) -> np.ndarray:
    """(L, 2) pairs of nodes that carry a vertex together."""
    K = carriers.shape[1]
    pairs = np.concatenate([carriers[:, [i, j]] for i in range(K) for j in range(i + 1, K)])
    return np.unique(np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1), axis=0)


def _inner_links(template: Mesh, nodes: np.ndarray, reach: float, most: int = 8) -> np.ndarray:
    """(L, 2) pairs of nodes that see each other through the inside, for each node the `most` nearest."""
    points, normals = template.vertices[nodes], template.vertex_normals[nodes]
    pairs = cKDTree(points).query_pairs(reach, output_type="ndarray")
    i, j = np.concatenate([pairs, pairs[:, ::-1]]).T
    along = points[j] - points[i]
    length = np.linalg.norm(along, axis=1)
    along /= np.maximum(length, 1e-12)[:, None]
    inward = (np.einsum("nd,nd->n", normals[i], along) < -0.3) & (np.einsum("nd,nd->n", normals[j], along) > 0.3)
    i, j, along, length = i[inward], j[inward], along[inward], length[inward]
    skin = 0.02 * reach
    _, hit = Rays(template).cast(points[i] + skin * along, along)
    clear = np.abs(hit + skin - length) < skin
    i, j, length = i[clear], j[clear], length[clear]
    order = np.lexsort((length, i))
    i, j = i[order], j[order]
    rank = np.arange(len(i)) - np.searchsorted(i, i)
    return np.stack([i, j], axis=1)[rank < most]


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
    return Pull(summed(vertices, A, count), summed(vertices, b, count), float(np.sum(b * targets)))


def summed(index: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """(count, ...) the sums of the values (n, ...) of each index (n,)."""
    n = len(index)
    add = csr_array(coo_array((np.ones(n), (index, np.arange(n))), shape=(count, n)))
    return (add @ values.reshape(n, math.prod(values.shape[1:]))).reshape(count, *values.shape[1:])


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
        self.edge_slots = where[len(of_vertices):len(of_vertices) + len(of_edges)]

    def matrix(self, blocks: np.ndarray) -> csc_array:
        """The sparse symmetric matrix of all blocks (P, 7, 7)."""
        size = self.nodes * UNKNOWNS
        return csc_array(bsr_array((blocks, self.columns, self._indptr), shape=(size, size)))


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


def _edge_term(graph: DeformationGraph, r: np.ndarray, Ji: np.ndarray, Jj: np.ndarray, w: np.ndarray) -> Term:
    """`Σ w |r|²` over the edges of a graph, for residuals r (E, d) with weights w (E,).

    Ji, Jj (E, d, 7) are their derivatives by the unknowns of the first and the second node.
    """
    def normal(pattern: NodePattern) -> tuple[np.ndarray, np.ndarray]:
        wi, wj = (w[:, None, None] * J.transpose(0, 2, 1) for J in (Ji, Jj))
        blocks = np.concatenate([wi @ Ji, wi @ Jj, wj @ Ji, wj @ Jj])
        force = np.concatenate([wi @ r[..., None], wj @ r[..., None]])[..., 0]
        return (summed(pattern.edge_slots, blocks, len(pattern.rows)),
                summed(graph.edges.T.reshape(-1), force, pattern.nodes))

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
        return (summed(pattern.vertex_slots[active].reshape(-1),
                       blocks.transpose(0, 1, 3, 2, 4).reshape(n * K * K, UNKNOWNS, UNKNOWNS), len(pattern.rows)),
                summed(carriers.reshape(-1), force, pattern.nodes))

    return Term(float(np.sum(x * (Ax - 2 * b)) + wanted.c), normal)


def stretch_term(graph: DeformationGraph, motion: NodeMotion, stiffness: float) -> Term:
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
    return _edge_term(graph, y - (motion.positions[j] - motion.positions[i]), Ji, Jj,
                      stiffness**2 * graph.edge_area / squared)


def bend_term(graph: DeformationGraph, motion: NodeMotion, stiffness: float) -> Term:
    """Neighbours want to rotate alike: one radian between them costs as much as `stiffness` metres from the data."""
    i, j = graph.edges.T
    r = rotations.log(motion.R[j] @ motion.R[i].transpose(0, 2, 1))
    inverse = rotations.inverse_right_jacobian(r)
    Ji, Jj = np.zeros((2, len(i), 3, UNKNOWNS))
    Ji[..., :3], Jj[..., :3] = -inverse, inverse.transpose(0, 2, 1)
    return _edge_term(graph, r, Ji, Jj, stiffness**2 * graph.edge_area)


def growth_term(graph: DeformationGraph, motion: NodeMotion, stiffness: float) -> Term:
    """Neighbours want to grow alike: a factor of e between them costs as much as `stiffness` metres from the data."""
    i, j = graph.edges.T
    Ji, Jj = np.zeros((2, len(i), 1, UNKNOWNS))
    Ji[..., 3], Jj[..., 3] = -1, 1
    return _edge_term(graph, (motion.log_scale[j] - motion.log_scale[i])[:, None], Ji, Jj,
                      stiffness**2 * graph.edge_area)


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
            now = terms(self.graph, at, wanted, stiffness).values()

            def assemble() -> tuple[np.ndarray, csc_array]:
                blocks, half = (np.sum(parts, axis=0) for parts in zip(*(t.normal(pattern) for t in now), strict=True))
                if not stiffness.growth:
                    blocks[:, 3], blocks[:, :, 3], half[:, 3] = 0, 0, 0               # the log-scale
                return half.reshape(-1), pattern.matrix(blocks)

            return Sparse(sum(term.value for term in now), assemble)

        found = levenberg_marquardt(equations, self.motion, steps, tolerance=1e-3, damping=1e-5,
                                    retract=lambda at, step: at.moved(step.reshape(-1, UNKNOWNS)))
        now = {name: term.value for name, term in terms(self.graph, found.x, wanted, stiffness).items()}
        return replace(self, x=deform(self.graph, found.x), motion=found.x, energies=now,
                       iterations=self.iterations + found.iterations)


def start_fit(template: Mesh, T: np.ndarray, nodes: int) -> GraphFit:
    """The template where a rigid transform (4, 4) places it, on a graph of so many nodes."""
    graph = build_graph(template, nodes)
    return GraphFit(template.vertices @ T[:3, :3].T + T[:3, 3], graph, start_motion(graph, T))
