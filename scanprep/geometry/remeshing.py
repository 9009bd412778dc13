"""Improve triangles on the same surface: flip edges, and move vertices along it."""
from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, csr_array

from .mesh import Mesh
from .sparse import unique_integers
from .surface import Surface


def flip_edges(mesh: Mesh, allowed: np.ndarray | None = None, rounds: int = 20, min_cosine: float = 0.7) -> Mesh:
    """Flip edges until opposite angles sum to at most 180 degrees (Delaunay), as far as the surface allows.

    Only triangles `allowed` (F,) change, and triangles keep their rows. Edges with a bend sharper than `min_cosine`
    stay, and no flip creates a sharper one; -1 flips all.
    """
    faces = np.array(mesh.faces)
    allowed = np.ones(len(faces), dtype=bool) if allowed is None else allowed
    for _ in range(rounds):
        if not _flip_once(mesh.vertices, faces, allowed, min_cosine):
            break
    return Mesh(mesh.vertices, faces, mesh.colors)


def _flip_once(v: np.ndarray, faces: np.ndarray, allowed: np.ndarray, min_cosine: float) -> int:
    """Flip a set of independent edges; change `faces` in place and return the number of flips."""
    count = len(v)
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    across = np.roll(faces, 1, axis=1).ravel()
    face = np.repeat(np.arange(len(faces)), 3)
    key = np.minimum(start, end) * count + np.maximum(start, end)
    known = unique_integers(key)
    order = np.argsort(key, kind="stable")
    order = order[allowed[face[order]]]
    # pairs of half-edges at an inner edge, and how far their opposite angles exceed 180 degrees
    twin = np.flatnonzero(key[order][1:] == key[order][:-1])
    h, g = order[twin], order[twin + 1]
    a, b, c, d = start[h], end[h], across[h], across[g]          # triangles a b c and b a d
    gain = _angle(v, c, a, b) + _angle(v, d, b, a) - np.pi
    ends = np.minimum(c, d) * count + np.maximum(c, d)
    place = np.minimum(np.searchsorted(known, ends), len(known) - 1)
    good = (gain > 1e-3) & (c != d) & (known[place] != ends) & (start[g] == b)
    h, g, a, b, c, d, gain, ends = (x[good] for x in (h, g, a, b, c, d, gain, ends))
    # neither the old nor the new pair may bend sharply, and no triangle may invert
    old = _normal(v, a, b, c), _normal(v, b, a, d)
    new = _normal(v, a, d, c), _normal(v, d, b, c)
    mean = old[0] + old[1]
    good = np.ones(len(h), dtype=bool)
    if min_cosine > -1:
        good = (_dot(*old) > min_cosine) & (_dot(*new) > min_cosine) & (_dot(new[0], mean) > 0)
        good &= _dot(new[1], mean) > 0
    h, g, a, b, c, d, gain, ends = (x[good] for x in (h, g, a, b, c, d, gain, ends))
    # independent flips: the best one of both of its triangles, and one per new edge
    best = np.zeros(len(faces))
    np.maximum.at(best, face[h], gain)
    np.maximum.at(best, face[g], gain)
    take = np.flatnonzero((best[face[h]] == gain) & (best[face[g]] == gain))
    take = take[np.unique(ends[take], return_index=True)[1]]
    take = take[_first_use(np.stack([face[h[take]], face[g[take]]], axis=1))]
    faces[face[h[take]]] = np.stack([a, d, c], axis=1)[take]
    faces[face[g[take]]] = np.stack([d, b, c], axis=1)[take]
    return len(take)


def _first_use(pairs: np.ndarray) -> np.ndarray:
    """Return the rows of pairs (n, 2) in which both numbers appear for the first time."""
    _, first = np.unique(pairs.ravel(), return_index=True)
    new = np.zeros(pairs.size, dtype=bool)
    new[first] = True
    return np.flatnonzero(new.reshape(-1, 2).all(axis=1))


def _angle(v: np.ndarray, tip: np.ndarray, p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the angles (n,) at `tip` between p and q, radians."""
    x, y = v[p] - v[tip], v[q] - v[tip]
    return np.arctan2(np.linalg.norm(np.cross(x, y), axis=1), _dot(x, y))


def _normal(v: np.ndarray, a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Return unit normals (n, 3) of triangles a, b, c."""
    n = np.cross(v[b] - v[a], v[c] - v[a])
    return n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-30)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return dot products (n,) of rows."""
    return np.einsum("nd,nd->n", a, b)


def mean_of_neighbours(mesh: Mesh) -> csr_array:
    """Build the operator (N, N) that replaces every vertex by the mean of its neighbours."""
    adjacency = mesh.vertex_adjacency
    degree = np.maximum(np.asarray(adjacency.sum(axis=1)).ravel(), 1)
    return csr_array(adjacency.multiply(1 / degree[:, None]))


def relax(mesh: Mesh, surface: Surface, rounds: int) -> Mesh:
    """Move vertices, except on borders, towards the mean of their neighbours along a surface."""
    free = np.ones(len(mesh.vertices), dtype=bool)
    free[mesh.boundary_vertices] = False
    mean = mean_of_neighbours(mesh)
    for _ in range(rounds):
        move = 0.5 * (mean @ mesh.vertices - mesh.vertices)
        normal = mesh.vertex_normals
        move -= _dot(move, normal)[:, None] * normal
        move[~free] = 0
        vertices = mesh.vertices + move
        vertices[free] = surface.closest(vertices[free]).points
        mesh = mesh.with_vertices(vertices)
    return mesh


def smooth_taubin(mesh: Mesh, rounds: int) -> Mesh:
    """Smooth a mesh without shrinking, by steps forward and back [Taubin].

    A border is smoothed as a curve.
    """
    border = mesh.edges[mesh.edge_use == 1]
    inner = np.ones(len(mesh.vertices), dtype=bool)
    inner[border] = False
    a, b = mesh.edges[inner[mesh.edges].any(axis=1)].T
    rows = np.concatenate([a[inner[a]], b[inner[b]], border[:, 0], border[:, 1]])
    columns = np.concatenate([b[inner[a]], a[inner[b]], border[:, 1], border[:, 0]])
    count = len(mesh.vertices)
    near = csr_array(coo_array((np.ones(len(rows)), (rows, columns)), shape=(count, count)))
    degree = np.asarray(near.sum(axis=1)).ravel()
    mean = csr_array(near.multiply(1 / np.maximum(degree, 1)[:, None]))
    free = degree > 0
    vertices = np.array(mesh.vertices)
    for _ in range(rounds):
        for step in (0.5, -0.53):                         # the step back is a little larger, against shrinking
            vertices[free] += step * (mean @ vertices - vertices)[free]
    return mesh.with_vertices(vertices)


def improve_triangles(mesh: Mesh, surface: Surface, keep: np.ndarray | None = None) -> Mesh:
    """Improve the shape of triangles on a surface; their number and the positions of vertices `keep` stay."""
    fixed = np.zeros(0, dtype=np.int64) if keep is None else keep
    places = mesh.vertices[fixed]
    for _ in range(6):
        mesh = relax(flip_edges(mesh, rounds=8), surface, rounds=2)
        vertices = mesh.vertices.copy()
        vertices[fixed] = places
        mesh = mesh.with_vertices(vertices)
    return flip_edges(mesh)


def clamp_cotangents(mesh: Mesh) -> csr_array:
    """Build a cotangent Laplacian (N, N), rows summing to 0, with clamped weights that stay positive."""
    rows, cols, values = [], [], []
    for corner in range(3):
        tip, p, q = (mesh.faces[:, (corner + i) % 3] for i in range(3))
        x, y = mesh.vertices[p] - mesh.vertices[tip], mesh.vertices[q] - mesh.vertices[tip]
        area = np.maximum(np.linalg.norm(np.cross(x, y), axis=1), 1e-30)
        weight = np.clip(_dot(x, y) / area, 0.02, 20) / 2      # cotangents of 89 to 3 degrees
        rows += [p, q]
        cols += [q, p]
        values += [weight, weight]
    count = len(mesh.vertices)
    w = csr_array(coo_array((np.concatenate(values), (np.concatenate(rows), np.concatenate(cols))),
                            shape=(count, count)))
    total = np.asarray(w.sum(axis=1)).ravel()
    return csr_array(coo_array((total, (np.arange(count), np.arange(count))), shape=(count, count)) - w)
