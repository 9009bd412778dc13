"""Shortest paths along the surface."""
from __future__ import annotations

import numpy as np

from scanprep.geometry.mesh import Mesh

from .section import SectionCurve, chain_length


def shortest_path(body: np.ndarray, faces: np.ndarray, start: int, end: int) -> tuple[float, SectionCurve]:
    """Find the shortest path along triangles from one vertex to another: its exact length, metres, and its curve.

    Parameters
    ----------
    body : (N, 3) float, metres
        Vertices.
    faces : (F, 3) int
        The triangles that the path may cross.
    start : int
        Vertex at which the path starts.
    end : int
        Vertex at which it ends.

    Raises
    ------
    ValueError
        No path leads there.
    """
    import igl
    from scipy.optimize import minimize

    used, local = np.unique(faces, return_inverse=True)
    local, vertices = local.reshape(-1, 3), np.ascontiguousarray(body[used])
    places = np.searchsorted(used, [start, end])
    if not np.array_equal(used[np.minimum(places, len(used) - 1)], [start, end]) or start == end:
        raise ValueError(f"vertices {start} and {end}: expected two that the triangles join")
    none = np.zeros(0, dtype=np.int64)
    far = igl.exact_geodesic(vertices, local, places[:1], none, np.arange(len(used)), none)
    if not 0 < far[places[1]] < 1e6:                                       # 0, or a huge number, where no way leads
        raise ValueError(f"vertices {start} and {end}: no way along the surface joins them, there is a gap")
    edges, share = _descent(Mesh(vertices, local), far, int(places[0]), int(places[1]))
    # trace the path down the distances, then shorten it across the same edges: a convex problem in the points on them
    first, along = vertices[edges[:, 0]], vertices[edges[:, 1]] - vertices[edges[:, 0]]

    def length(s: np.ndarray) -> tuple[float, np.ndarray]:
        total, pull = chain_length(first + s[:, None] * along)
        return total, np.einsum("md,md->m", pull, along)

    best = minimize(length, share, jac=True, method="L-BFGS-B", bounds=[(0, 1)] * len(share),
                    options={"maxiter": 200, "ftol": 1e-14})
    return float(far[places[1]]), SectionCurve(used[edges], np.asarray(best.x), False)


def _descent(mesh: Mesh, far: np.ndarray, start: int, end: int) -> tuple[np.ndarray, np.ndarray]:
    """Trace a path from `end` down the distances `far` (N,) from `start`: edges (m, 2) and shares (m,) along them."""
    of_vertex: dict[int, list[int]] = {}
    for face, corners in enumerate(mesh.faces.tolist()):
        for corner in corners:
            of_vertex.setdefault(corner, []).append(face)
    edges, share, grid = [(end, end)], [0.0], np.linspace(0, 1, 65)      # places tried on an edge
    for _ in range(len(far)):
        (a, b), s = edges[-1], share[-1]
        around = set(of_vertex[a]) & set(of_vertex[b])
        corners = [mesh.faces[face].tolist() for face in around]
        if any(start in three for three in corners):
            break
        here = (1 - s) * mesh.vertices[a] + s * mesh.vertices[b]
        below = (1 - s) * far[a] + s * far[b]
        # of all points on the other edges of the triangles here, the one with the shortest way to the start
        best = (np.inf, a, b, s)
        for three in corners:
            for c, d in ((three[0], three[1]), (three[1], three[2]), (three[2], three[0])):
                if {c, d} == {a, b} or (a == b and a in (c, d)):
                    continue
                ahead = np.outer(1 - grid, mesh.vertices[c]) + np.outer(grid, mesh.vertices[d])
                level = (1 - grid) * far[c] + grid * far[d]
                cost = np.where(level < below - 1e-12, level + np.linalg.norm(ahead - here, axis=1), np.inf)
                k = int(cost.argmin())
                best = min(best, (float(cost[k]), c, d, float(grid[k])))
        if not np.isfinite(best[0]):
            break
        _, c, d, s = best
        c, d = (c, c) if s == 0 else (d, d) if s == 1 else (c, d)
        edges.append((c, d))
        share.append(s if c != d else 0.0)
    return np.array([*edges, (start, start)]), np.array([*share, 0.0])
