"""Where a closed control mesh is cut so that it can be laid flat: seams over its edges."""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components, dijkstra

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Rays
from scanprep.skeleton.tree import Skeleton

RAYS = 48                            # from every vertex, to see how much of it is hidden
IN_SIGHT = 2.0                       # an edge in full sight counts as so much longer than a hidden one


def find_seams(mesh: Mesh, skeleton: Skeleton) -> list[np.ndarray]:
    """A tree of seams, each the vertices (k,) that it passes, to the tips of all limbs, rather where the surface is
    hidden. Each tip in turn, the nearest first, is joined to the seams there are by the shortest path over the edges.
    """
    graph = _costs(mesh)
    tips = limb_tips(mesh, skeleton)
    tree = np.array(tips[:1])
    seams: list[np.ndarray] = []
    left = set(tips[1:])
    while left or not seams:
        if left:
            far = dijkstra(graph, directed=False, indices=tree, min_only=True)
            goal = min(left, key=lambda v: (far[v], v))
            left.discard(goal)
        else:                                                          # one tip only: through the body to its far end
            goal = int(dijkstra(graph, directed=False, indices=tree, min_only=True).argmax())
        seam = join(graph, tree, goal)
        if len(seam) > 1:
            seams.append(seam)
            tree = np.union1d(tree, seam)
    return seams


def extended(mesh: Mesh, seams: Sequence[np.ndarray], vertex: int) -> list[np.ndarray]:
    """Seams with one more, the shortest path from them to a vertex; the same where they pass it already."""
    seam = join(_costs(mesh), np.unique(np.concatenate(list(seams))), vertex)
    return [*seams, seam] if len(seam) > 1 else list(seams)


def join(graph: csr_array, tree: np.ndarray, goal: int) -> np.ndarray:
    """The cheapest path (k,) over a graph from any vertex of `tree` to `goal`."""
    before = dijkstra(graph, directed=False, indices=tree, min_only=True, return_predecessors=True)[1]
    path = [goal]
    while before[path[-1]] >= 0:
        path.append(int(before[path[-1]]))
    return np.array(path[::-1])


def limb_tips(mesh: Mesh, skeleton: Skeleton) -> list[int]:
    """One vertex for each part without children, and for the root when it has only one."""
    x, y = mesh.edges.T
    graph = coo_array((mesh.edge_lengths, (x, y)), shape=2 * (len(mesh.vertices),)).tocsr()
    part, parents = skeleton.part_of_vertex(mesh), skeleton.parents
    tips = []
    for p in range(len(parents)):
        children = np.flatnonzero(parents == p)
        if len(children) > (1 if p == 0 else 0):
            continue
        mine = np.flatnonzero(part == p)
        if not len(mine):
            continue
        joint = int(children[0]) if p == 0 and len(children) else p   # where it meets its neighbour
        start = skeleton.ring(mesh, joint) if joint else mine[:0]
        if not len(start):
            start = mine[[np.linalg.norm(mesh.vertices[mine] - skeleton.joints[joint], axis=1).argmin()]]
        far = dijkstra(graph, directed=False, indices=start, min_only=True)
        tips.append(int(mine[far[mine].argmax()]))
    return sorted(set(tips))


def cut(mesh: Mesh, seams: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Triangles (F, 3) of a closed mesh opened along seams, and the vertex (M,) that each of the new ones was;
    ValueError for a seam that leaves the edges.
    """
    if not mesh.is_closed:
        raise ValueError("mesh: expected a closed surface")
    number = {edge: k for k, edge in enumerate(map(tuple, mesh.edges.tolist()))}
    is_open = np.zeros(len(mesh.edges), dtype=bool)
    for seam in seams:
        for a, b in zip(seam[:-1].tolist(), seam[1:].tolist(), strict=True):
            if (min(a, b), max(a, b)) not in number:
                raise ValueError(f"seams: vertices {a} and {b} follow each other but no edge joins them")
            is_open[number[min(a, b), max(a, b)]] = True
    sides = np.argsort(mesh.face_edges.ravel(), kind="stable").reshape(-1, 2)[~is_open]    # the two at every edge
    begin, end = sides, sides - sides % 3 + (sides + 1) % 3            # corners; the two sides run in opposite ways
    n = mesh.faces.size
    pairs = (np.r_[begin[:, 0], end[:, 0]], np.r_[end[:, 1], begin[:, 1]])
    _, fan = connected_components(coo_array((np.ones(len(pairs[0])), pairs), shape=(n, n)), directed=False)
    _, first = np.unique(fan, return_index=True)
    return fan.reshape(-1, 3).astype(np.int64), mesh.faces.ravel()[first]


def _costs(mesh: Mesh) -> csr_array:
    """Lengths of the edges, those in sight counted longer."""
    k = np.arange(RAYS) + 0.5                                          # evenly over the sphere
    z, turn = 1 - 2 * k / RAYS, np.pi * (1 + 5**0.5) * k
    directions = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=1)
    cosine = np.maximum(mesh.vertex_normals @ directions.T, 0)
    vertex, ray = np.nonzero(cosine)
    start = mesh.vertices[vertex] + 1e-3 * mesh.mean_edge * mesh.vertex_normals[vertex]
    free = ~Rays(mesh).occluded(start, directions[ray])
    weight = cosine[vertex, ray]
    n = len(mesh.vertices)
    seen = np.bincount(vertex, weight * free, n) / np.maximum(np.bincount(vertex, weight, n), 1e-12)
    x, y = mesh.edges.T
    return csr_array(coo_array((mesh.edge_lengths * (1 + (IN_SIGHT - 1) * (seen[x] + seen[y]) / 2), (x, y)),
                               shape=(n, n)))
