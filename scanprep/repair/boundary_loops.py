"""Which borders of a mesh are borders of one hole."""
from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from ..geometry.mesh import Mesh


def group_loops(mesh: Mesh, loops: list[np.ndarray]) -> list[list[np.ndarray]]:
    """Borders that face each other put together, as the two ends where a limb was cut through; order as of `loops`."""
    large = [number for number, loop in enumerate(loops) if len(loop) >= 6]    # others are pinholes
    label = np.arange(len(loops))
    if len(large) > 1:
        points = np.concatenate([mesh.vertices[loops[number]] for number in large])
        owner = np.repeat(large, [len(loops[number]) for number in large])
        ahead = np.concatenate([_outward(mesh, loops[number]) for number in large])
        facing = np.array([_met(points, owner, ahead, number, len(loops)) for number in large])
        both = np.zeros((len(loops), len(loops)), dtype=bool)
        both[large] = facing > 0.6
        pairs = np.argwhere(both & both.T)
        graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=both.shape)
        label = connected_components(graph, directed=False)[1]
    return [[loops[k] for k in np.flatnonzero(label == label[number])]
            for number in np.unique(label, return_index=True)[1]]


def joined_polygon(vertices: np.ndarray, loops: list[np.ndarray]) -> np.ndarray:
    """One polygon (m,) from several loops, cut open along the shortest lines between them.

    The vertices at the ends of a cut are named twice. All loops run as the sides of the triangles at the border do.
    """
    polygon = loops[0]
    rest = list(loops[1:])
    while rest:
        apart = [np.linalg.norm(vertices[polygon][:, None] - vertices[loop], axis=2) for loop in rest]
        nearest = int(np.argmin([a.min() for a in apart]))
        i, k = np.unravel_index(apart[nearest].argmin(), apart[nearest].shape)
        other = np.roll(rest.pop(nearest), -int(k))
        polygon = np.concatenate([polygon[:i + 1], other, other[:1], polygon[i:]])
    return polygon


def _outward(mesh: Mesh, loop: np.ndarray) -> np.ndarray:
    """(n, 3) unit directions in which the surface would go on at the vertices of a border."""
    v = mesh.vertices[loop]
    along = np.roll(v, -1, axis=0) - np.roll(v, 1, axis=0)
    out = np.cross(along, mesh.vertex_normals[loop])
    for _ in range(3):                                        # jagged borders point everywhere
        out = out + np.roll(out, 1, axis=0) + np.roll(out, -1, axis=0)
    return np.asarray(out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-30))


def _met(points: np.ndarray, owner: np.ndarray, ahead: np.ndarray, number: int, count: int) -> np.ndarray:
    """(count,) for one border, the share of its vertices that have each border ahead of them as the next thing.

    Only a border closer than this one is wide counts.
    """
    mine = owner == number
    apart = points[None] - points[mine][:, None]
    far = np.linalg.norm(apart, axis=2)
    width = np.linalg.norm(np.ptp(points[mine], axis=0))
    straight = np.einsum("abd,ad->ab", apart, ahead[mine]) > 0.7 * far
    far = np.where(straight & (far > 0) & (far < width), far, np.inf)
    next_one = far.argmin(axis=1)
    met = owner[next_one][np.isfinite(far.min(axis=1))]
    shares = np.bincount(met, minlength=count) / mine.sum()
    shares[number] = 0
    return np.asarray(shares)
