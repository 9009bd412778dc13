"""A graph of rotating and scaling nodes that carries a surface: the coarse degrees of freedom of a registration.

A node has seven unknowns: a left rotation (radians), a change of log-scale and a translation (metres).
"""
from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from ..geometry import rotations
from ..geometry.farthest_points import farthest_points
from ..geometry.mesh import Mesh
from ..geometry.sparse import gatherer, sum_groups
from ..geometry.surface import Rays


@dataclass(frozen=True, eq=False)
class DeformationGraph:
    """Nodes on a template, how they carry its vertices, and which nodes hold each other."""

    rest: np.ndarray             # (N, 3) metres, the template's vertices
    node_vertices: np.ndarray    # (M,) the vertex where each node sits
    carriers: np.ndarray         # (N, K) the nodes that carry each vertex
    weights: np.ndarray          # (N, K) their shares, each row summing to 1
    edges: np.ndarray            # (E, 2) directed pairs of nodes, each pair in both directions: the links, and back
    edge_area: np.ndarray        # (E,) square metres, the part of the surface that each edge stands for

    @property
    def nodes(self) -> np.ndarray:
        """(M, 3) rest positions of the nodes, metres."""
        return self.rest[self.node_vertices]

    @property
    def edge_vectors(self) -> np.ndarray:
        """(E, 3) from the first to the second node at rest, metres."""
        return self.nodes[self.edges[:, 1]] - self.nodes[self.edges[:, 0]]

    @property
    def links(self) -> np.ndarray:
        """(E / 2, 2) pairs of nodes that hold each other, each once."""
        return self.edges[:len(self.edges) // 2]

    @property
    def link_area(self) -> np.ndarray:
        """(E / 2,) square metres, that of both directions."""
        return self.edge_area.reshape(2, -1).sum(axis=0)


@lru_cache(maxsize=4)                # a folder of scans shares one template
def build_graph(template: Mesh, count: int) -> DeformationGraph:
    """Build a graph of `count` nodes spread over a template, linked along the surface and through the body.

    Nodes that face each other through the inside are linked too, up to 0.18 times the root of the template's area.
    These inner links keep the thickness of limbs where the scan has no data. They make a cross-section rotate as one.
    """
    nodes = farthest_points(template.vertices, min(count, len(template.vertices)))
    carrying, weights = _carriers(template, nodes, min(4, len(nodes) - 1))
    # surface links: two nodes that carry the same vertex
    pairs = np.concatenate([carrying[:, pair] for pair in combinations(range(carrying.shape[1]), 2)])
    inner = _inner_links(template, nodes, 0.18 * np.sqrt(template.face_areas.sum()))
    # each pair once, then both directions; every node shares its area among its edges
    links = np.unique(np.sort(np.concatenate([pairs[pairs[:, 0] != pairs[:, 1]], inner]), axis=1), axis=0)
    edges = np.concatenate([links, links[:, ::-1]])
    area = np.bincount(carrying.ravel(), (weights * template.vertex_areas[:, None]).ravel(), len(nodes))
    degree = np.bincount(edges[:, 0], minlength=len(nodes))
    return DeformationGraph(template.vertices, nodes, carrying, weights, edges, (area / degree)[edges[:, 0]])


def _carriers(template: Mesh, nodes: np.ndarray, K: int) -> tuple[np.ndarray, np.ndarray]:
    """Find the K nodes nearest to each vertex along the surface (N, K) and their weights (N, K)."""
    a, b = template.edges.T
    N = len(template.vertices)
    lengths = csr_array(coo_array((template.edge_lengths, (a, b)), shape=(N, N)))
    best = np.full((N, K + 1), np.inf)
    index = np.zeros((N, K + 1), dtype=np.int64)
    # nodes farther than four mean node spacings never carry a vertex; this keeps the search short
    limit = 4 * np.sqrt(template.face_areas.sum() / len(nodes))
    # keep the K + 1 nearest nodes of every vertex; 128 nodes at a time bound the memory
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
    # vertices that no node reaches along the surface take the nearest node in a straight line
    lost = np.flatnonzero(~np.isfinite(best[:, 0]))
    if len(lost):
        straight = ((template.vertices[lost, None] - template.vertices[nodes]) ** 2).sum(axis=-1)
        index[lost], best[lost, 0] = np.argmin(straight, axis=1)[:, None], 0.0
    # weights fall to zero at the distance of the (K + 1)th node, so they change smoothly over the surface
    radius = np.where(np.isfinite(best[:, -1]), best[:, -1], 1.2 * limit)[:, None]
    share = np.where(np.isfinite(best[:, :K]), np.maximum(1 - best[:, :K] / radius, 0) ** 2, 0.0)
    share[:, 0] += 1e-9
    index = np.where(np.isfinite(best), index, index[:, :1])
    return index[:, :K], share / share.sum(axis=1, keepdims=True)


def _inner_links(template: Mesh, nodes: np.ndarray, reach: float) -> np.ndarray:
    """Find pairs (L, 2) of nodes that see each other through the inside, at most the eight nearest of each node."""
    points, normals = template.vertices[nodes], template.vertex_normals[nodes]
    pairs = cKDTree(points).query_pairs(reach, output_type="ndarray")
    i, j = np.concatenate([pairs, pairs[:, ::-1]]).T
    along = points[j] - points[i]
    length = np.linalg.norm(along, axis=1)
    along /= np.maximum(length, 1e-12)[:, None]
    # both normals must point away from the other node: more than about 107 degrees off the line between them
    inward = (np.einsum("nd,nd->n", normals[i], along) < -0.3) & (np.einsum("nd,nd->n", normals[j], along) > 0.3)
    i, j, along, length = i[inward], j[inward], along[inward], length[inward]
    # cast a ray from just below the skin; it must first hit the surface at the other node
    skin = 0.02 * reach
    _, hit = Rays(template).cast(points[i] + skin * along, along)
    clear = np.abs(hit + skin - length) < skin
    i, j, length = i[clear], j[clear], length[clear]
    # rank the partners of every node by distance
    order = np.lexsort((length, i))
    i, j = i[order], j[order]
    rank = np.arange(len(i)) - np.searchsorted(i, i)
    return np.stack([i, j], axis=1)[rank < 8]


@dataclass(frozen=True, eq=False)
class NodeMotion:
    """Rotation R (M, 3, 3), growth log_scale (M,) and positions (M, 3), metres, of every node."""

    R: np.ndarray
    log_scale: np.ndarray
    positions: np.ndarray

    @property
    def linear(self) -> np.ndarray:
        """(M, 3, 3) rotation and growth together."""
        return np.exp(self.log_scale)[:, None, None] * self.R

    def advance(self, step: np.ndarray) -> NodeMotion:
        """Return the motion after a step (M, 7): left rotation (radians), change of log-scale, translation (metres)."""
        return replace(self, R=rotations.exp(step[:, :3]) @ self.R, log_scale=self.log_scale + step[:, 3],
                       positions=self.positions + step[:, 4:])


def arms(graph: DeformationGraph, motion: NodeMotion, vertices: np.ndarray) -> np.ndarray:
    """Return vectors (n, K, 3), metres, from each carrying node to each of the vertices (n,), moved with the node."""
    carriers = graph.carriers[vertices]
    local = graph.rest[vertices, None] - graph.nodes[carriers]
    return np.matmul(motion.linear[carriers], local[..., None])[..., 0]


def deform(graph: DeformationGraph, motion: NodeMotion) -> np.ndarray:
    """Return the template's vertices (N, 3), metres, after the motion: the weighted mean of what their nodes say."""
    linear = motion.linear
    # each node is an affine map x -> linear x + offset; blending the maps once is cheaper than the vertices
    offset = motion.positions - np.matmul(linear, graph.nodes[..., None])[..., 0]
    affine = np.concatenate([linear, offset[..., None]], axis=2).reshape(-1, 12)
    blended = np.einsum("nk,nkc->nc", graph.weights, affine[graph.carriers]).reshape(-1, 3, 4)
    return np.matmul(blended[..., :3], graph.rest[..., None])[..., 0] + blended[..., 3]


def refine_motion(old: DeformationGraph, motion: NodeMotion, new: DeformationGraph) -> NodeMotion:
    """Transfer the motion of a coarse graph to a finer graph of the same template."""
    at = new.node_vertices
    w, carriers = old.weights[at], old.carriers[at]
    R = rotations.project(np.einsum("mk,mkij->mij", w, motion.R[carriers]))
    return NodeMotion(R, np.einsum("mk,mk->m", w, motion.log_scale[carriers]), deform(old, motion)[at])


def motion_of(graph: DeformationGraph, x: np.ndarray) -> NodeMotion:
    """Estimate the motion of the nodes that takes the template to vertices (N, 3), metres, from their edges."""
    i, j = graph.edges.T
    at = x[graph.node_vertices]
    now, rest = at[j] - at[i], graph.edge_vectors
    gather = gatherer(i, len(at))
    # rotation by orthogonal Procrustes over the edges of a node, growth by the ratio of their lengths
    R = rotations.project(sum_groups(gather, np.einsum("ei,ej->eij", now, rest)))
    grown = gather @ (now**2).sum(axis=1) / (gather @ (rest**2).sum(axis=1))
    return NodeMotion(R, 0.5 * np.log(grown), at)
