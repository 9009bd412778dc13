"""Make meshes manifold: no duplicate or degenerate triangles, no touching sheets, no small components."""
from __future__ import annotations

import numpy as np

from ..geometry.mesh import Mesh
from ..geometry.sanitise import invert_against_neighbours, invert_triangles
from ..geometry.sparse import label_components
from ..geometry.surface import Rays


def repair(mesh: Mesh, min_component: float = 1.0) -> Mesh:
    """Repair a mesh to a manifold without duplicate, degenerate or unused elements and small components.

    Triangles are inverted where neighbours disagree, and otherwise only removed, so holes may open. A vertex where
    sheets touch is split.

    Parameters
    ----------
    mesh : Mesh
        Any triangle mesh.
    min_component : float
        Components with a smaller share of the vertices of the largest one are dropped; 1 keeps only the largest.

    Returns
    -------
    Mesh
        Vertices in metres; colours are kept.

    Raises
    ------
    ValueError
        No triangle is left.
    """
    # weld, drop degenerate triangles, orient; remove triangles at bad edges until the edges are manifold
    mesh = orient_triangles(_drop_flat(weld(mesh, 1e-7)))
    for _ in range(20):
        if mesh.is_edge_manifold:
            break
        mesh = _drop_at_bad_edges(mesh)
    mesh = drop_small_components(split_vertices(mesh), min_component)
    if not len(mesh.faces):
        raise ValueError("mesh: no triangle is left after repair")
    return mesh


def weld(mesh: Mesh, distance: float = 0.0) -> Mesh:
    """Merge vertices closer than `distance` metres, and drop triangles that become degenerate or duplicate."""
    # equal keys become one vertex, the first of them
    key = np.round(mesh.vertices / distance) if distance > 0 else mesh.vertices
    rows = np.lexsort(key.T)
    new = np.empty(len(key), dtype=np.int64)
    new[rows] = np.cumsum(np.r_[True, (key[rows][1:] != key[rows][:-1]).any(axis=1)][:len(key)]) - 1
    first = np.full(int(new.max(initial=-1)) + 1, len(key))
    np.minimum.at(first, new, np.arange(len(key)))
    order = np.argsort(first, kind="stable")                 # keep the order of the vertices
    faces = np.argsort(order, kind="stable")[new][mesh.faces]
    distinct = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    corners = np.sort(faces, axis=1)
    rows = np.lexsort(corners.T)                             # stable: the first of equal triangles stays
    keep = np.ones(len(faces), dtype=bool)
    keep[rows[1:]] = (corners[rows][1:] != corners[rows][:-1]).any(axis=1)
    kept = first[order]
    welded = Mesh(mesh.vertices[kept], faces[keep & distinct], None if mesh.colors is None else mesh.colors[kept])
    return welded.submesh(np.arange(len(welded.faces)))[0]


def _drop_flat(mesh: Mesh) -> Mesh:
    """Remove degenerate triangles by collapsing their shortest side; what is left after ten rounds is dropped."""
    least_area = 1e-12  # square metres; triangles with less area are degenerate
    for _ in range(10):
        flat = np.flatnonzero(mesh.face_areas < least_area)
        if not len(flat):
            return mesh
        corners = mesh.corners[flat]
        side = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).argmin(axis=1)
        a, b = mesh.faces[flat, side], mesh.faces[flat, (side + 1) % 3]
        target = np.arange(len(mesh.vertices))
        target[np.maximum(a, b)] = np.minimum(a, b)
        moved = mesh.vertices[target[target]]
        faces = target[target][mesh.faces]
        mesh = weld(Mesh(moved, faces, mesh.colors))
    return mesh.submesh(mesh.face_areas >= least_area)[0]


def orient_triangles(mesh: Mesh) -> Mesh:
    """Invert triangles so that neighbours face the same way: in every patch the way of most of its area."""
    invert, _ = invert_against_neighbours(mesh)
    return Mesh(mesh.vertices, invert_triangles(mesh.faces, invert), mesh.colors) if invert.any() else mesh


def _drop_at_bad_edges(mesh: Mesh) -> Mesh:
    """Remove the triangles that make an edge non-manifold: of two in one direction, the smaller."""
    half = mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    edge = mesh.face_edges.ravel()
    forward = half[:, 0] < half[:, 1]
    size = np.repeat(mesh.face_areas, 3)
    # an edge may be used once in each direction: the largest triangle keeps it
    order = np.lexsort((-size, forward, edge))
    e, f = edge[order], forward[order]
    again = np.r_[False, (e[1:] == e[:-1]) & (f[1:] == f[:-1])]
    keep = np.ones(len(mesh.faces), dtype=bool)
    keep[order[again] // 3] = False
    return mesh.submesh(keep)[0]


def split_vertices(mesh: Mesh, across_holes: bool = False) -> Mesh:
    """Split vertices: every fan of triangles around a vertex beyond the first gets a copy.

    `across_holes` keeps fans together that become one when the holes between them are filled.
    """
    if mesh.is_vertex_manifold:
        return mesh
    fan = mesh.corner_fans
    number = (_join_across_holes(mesh, fan)[fan] if across_holes else fan).ravel()
    # the first fan keeps the vertex, the others get new numbers at the end
    _, first, new = np.unique(number, return_index=True, return_inverse=True)
    owner = mesh.faces.ravel()[first]
    order = np.lexsort((first, owner))
    duplicate = np.r_[False, owner[order][1:] == owner[order][:-1]]
    place = np.empty(len(owner), dtype=np.int64)
    place[order] = np.where(duplicate, len(mesh.vertices) + np.cumsum(duplicate) - 1, owner[order])
    source = np.concatenate([np.arange(len(mesh.vertices)), owner[order][duplicate]])
    colors = None if mesh.colors is None else mesh.colors[source]
    return Mesh(mesh.vertices[source], place[new.reshape(-1)].reshape(-1, 3), colors)


def _join_across_holes(mesh: Mesh, fan: np.ndarray) -> np.ndarray:
    """Give the same number to the fans at a vertex between which a simple border loop passes."""
    face, side = np.nonzero(mesh.edge_use[mesh.face_edges] == 1)
    ends = mesh.faces[face, side], mesh.faces[face, (side + 1) % 3]
    at = {(int(a), int(b)): (int(p), int(q)) for a, b, p, q in
          zip(*ends, fan[face, side], fan[face, (side + 1) % 3], strict=True)}
    pairs = [(at[u, v][1], at[v, w][0]) for loop in mesh.boundary_loops
             for u, v, w in zip(np.roll(loop, 1).tolist(), loop.tolist(), np.roll(loop, -1).tolist(), strict=True)]
    a, b = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    return label_components(a, b, int(fan.max()) + 1)


def drop_small_components(mesh: Mesh, share: float) -> Mesh:
    """Drop components with less than `share` of the vertices of the largest, and unused vertices."""
    if not len(mesh.faces):
        return mesh
    a, b = mesh.faces[:, [0, 1]].T, mesh.faces[:, [1, 2]].T       # not mesh.edges: sorting them takes longer
    label = label_components(a.ravel(), b.ravel(), len(mesh.vertices))
    size = np.bincount(label)
    keep = size >= share * size.max()
    if share >= 1:
        keep = np.arange(len(size)) == size.argmax()
    return mesh.submesh(keep[label[mesh.faces[:, 0]]])[0]


def drop_thin(mesh: Mesh, thinnest: float) -> Mesh:
    """Drop parts thinner than `thinnest` metres, such as poorly seen fingers, and what was attached to them.

    Thickness is measured along the inward normals. The surface is open where something was removed.
    """
    middle = mesh.corners.mean(axis=1)
    inward = -mesh.face_normals
    # from just below the surface; only distances up to ten times the limit matter
    _, depth = Rays(mesh).cast(middle + 1e-4 * inward, inward, 10 * thinnest)
    thick = ~(depth < thinnest)
    return drop_small_components(mesh.submesh(thick)[0], 1.0) if not thick.all() else mesh
