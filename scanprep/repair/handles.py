"""Cut handles: bridges by which fingers, or thighs, are joined in a mesh though not in the person."""
from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra, minimum_spanning_tree

from ..geometry.mesh import Mesh
from .hole_filling import FillConfig, close

LONGEST = 0.1           # metres: a bridge between two scanned fingers was 2 cm around, its opening 6; a thigh has 50


def count_handles(mesh: Mesh) -> int:
    """Count the handles of a closed mesh of one piece, by Euler's V - E + F = 2 - 2 handles: 1 for a ring."""
    return 1 - (len(mesh.vertices) - len(mesh.edges) + len(mesh.faces)) // 2


def cut_handles(mesh: Mesh) -> Mesh:
    """Cut the short handles of a closed mesh of one piece, and fill the two holes that each cut leaves.

    A handle is cut along the shortest loop around it, or its opening is closed where that loop is the shorter one.
    Those whose loops are longer than 10 cm stay.
    """
    for _ in range(count_handles(mesh)):
        loop = find_short_loop(mesh)
        if measure_loop(mesh, loop) > LONGEST:
            break
        apart = np.isin(mesh.faces, loop, invert=True).all(axis=1)
        cut = close(mesh.submesh(np.asarray(apart))[0], FillConfig(join=False))
        if count_handles(cut) >= count_handles(mesh):
            break
        mesh = cut
    return mesh


def find_short_loop(mesh: Mesh) -> np.ndarray:
    """Find the vertices (n,) of a short loop that is no border of a piece of a closed mesh with a handle.

    The shortest loop through a vertex is exact; it starts again from the loop's far side until it gets no shorter.

    [Erickson] greedy tree and cotree
    """
    best, length, root = np.empty(0, dtype=int), np.inf, 0
    while True:
        loop = _shortest_loop_through(mesh, root)
        if measure_loop(mesh, loop) > (1 - 1e-9) * length:
            return best
        # the loop begins at its far side, which is on the handle: from there it need not come and go
        best, length, root = loop, measure_loop(mesh, loop), int(loop[0])


def measure_loop(mesh: Mesh, loop: np.ndarray) -> float:
    """Measure a closed loop of vertices (n,), metres."""
    return float(np.linalg.norm(mesh.vertices[loop] - mesh.vertices[np.roll(loop, 1)], axis=1).sum())


def _shortest_loop_through(mesh: Mesh, root: int) -> np.ndarray:
    """Find the shortest loop (n,) that leaves a vertex, goes around a handle and comes back; shared ways are left out.

    The edges of neither the tree of shortest paths nor the longest tree across the others close one loop each,
    which goes around a handle.
    """
    a, b = mesh.edges.T
    graph = csr_array((mesh.edge_lengths, (a, b)), shape=(len(mesh.vertices),) * 2)
    distance, before = dijkstra(graph, directed=False, indices=root, return_predecessors=True)
    rest = np.flatnonzero((before[a] != b) & (before[b] != a))
    around = (distance[a] + distance[b] + mesh.edge_lengths)[rest]
    # the spanning tree over triangles that crosses the edges of the longest loops; the edges that it leaves close one
    pairs, count = np.sort(mesh.face_pairs[rest], axis=1), len(mesh.faces)
    across = csr_array((around.max() + 1 - around, pairs.T), shape=(count, count))
    crossed = np.stack(minimum_spanning_tree(across).tocoo().coords, axis=1)
    free = ~np.isin(pairs @ [count, 1], crossed @ [count, 1])
    closing = rest[free][around[free].argmin()]
    one, other = _path(before, int(a[closing])), _path(before, int(b[closing]))
    while len(one) > 1 and len(other) > 1 and one[-2] == other[-2]:
        del one[-1], other[-1]
    return np.array(one + other[-2::-1])


def _path(before: np.ndarray, vertex: int) -> list[int]:
    """List the vertices from one to the root of a tree of predecessors."""
    path = [vertex]
    while before[path[-1]] >= 0:
        path.append(int(before[path[-1]]))
    return path
