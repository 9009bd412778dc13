"""The last pass of a registration: the surface follows the scan, smooth where there is none, and unfolds."""
from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.sparse import coo_array, csc_array, diags_array

from ..geometry.mesh import Mesh
from ..geometry.sparse import Factored, factor
from .energies import Pull


class Shell:
    """A thin shell over a template that resists stretching and bending of its displacement.

    Parameters
    ----------
    template : Mesh
    """

    def __init__(self, template: Mesh) -> None:
        import igl

        vertices, faces = np.ascontiguousarray(template.vertices), np.ascontiguousarray(template.faces)
        L = -csc_array(igl.cotmatrix(vertices, faces))
        areas = np.maximum(template.vertex_areas, 1e-3 * template.vertex_areas.mean())
        self._membrane = L
        self._plate = csc_array(L.T @ diags_array(1 / areas) @ L)
        self._tiny = 1e-9 * areas.mean()

    def displaced(self, start: np.ndarray, wanted: Pull, smoothing: float, tension: float) -> np.ndarray:
        """Vertices (N, 3) that follow what matches want, as a smooth displacement of `start`.

        Minimises `wanted(x) + smoothing⁴ ∫|Δd|² + tension² ∫|∇d|²` for `d = x - start`.

        Parameters
        ----------
        start : (N, 3) float, metres
        wanted : Pull
        smoothing : float, metres
            Details of the displacement smaller than this are damped.
        tension : float, metres
            A gradient of one costs as much as this distance from the data.
        """
        smooth = smoothing**4 * self._plate + tension**2 * self._membrane
        across = np.linalg.eigvalsh(wanted.A)[:, 2]
        nearly = Factored(csc_array(smooth + diags_array(across + self._tiny)))
        force = wanted.b - np.einsum("nij,nj->ni", wanted.A, start)
        return start + conjugate_gradients(
            lambda d: smooth @ d + np.einsum("nij,nj->ni", wanted.A, d) + self._tiny * d, force, nearly.solve)


def flipped(template: Mesh, x: np.ndarray, linear: np.ndarray) -> np.ndarray:
    """(F,) bool: triangles of vertices (N, 3) that face away from where their corners (N, 3, 3) turned them."""
    turned = np.matmul(linear[template.faces].sum(axis=1), template.face_normals[..., None])[..., 0]
    return np.einsum("fd,fd->f", template.with_vertices(x).face_normals, turned) < 0


def unfold(template: Mesh, x: np.ndarray, linear: np.ndarray, rings: tuple[int, ...] = (1, 1, 2)) -> np.ndarray:
    """Lay small patches around flipped triangles anew, each edge as its surroundings turned it.

    Parameters
    ----------
    x : (N, 3) float, metres
    linear : (N, 3, 3) float
        Turn and growth around every vertex.
    rings : ints
        How far patches reach around flipped triangles in each round. They stay small: where skin truly folds
        triangles stay turned, and laying wide patches there would leave the data.

    Returns
    -------
    (N, 3) float, metres
    """
    a, b = template.edges.T
    rest = template.vertices[b] - template.vertices[a]
    wanted = np.matmul(0.5 * (linear[a] + linear[b]), rest[..., None])[..., 0]
    for reach in rings:
        bad = flipped(template, x, linear)
        if not bad.any():
            break
        patch = np.zeros(len(x))
        patch[template.faces[bad]] = 1
        for _ in range(reach):
            patch = (patch + template.vertex_adjacency @ patch > 0).astype(float)
        x = _laid(x, patch > 0, template.edges, wanted)
    return x


def _laid(x: np.ndarray, free: np.ndarray, edges: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Vertices (N, 3) where those that are free have moved so that their edges are nearest to the wanted ones."""
    if free.all():
        return x
    near = free[edges].any(axis=1)
    e = np.arange(int(near.sum()))
    a, b = edges[near].T
    D = csc_array(coo_array((np.r_[np.full(len(e), -1.0), np.ones(len(e))], (np.r_[e, e], np.r_[a, b])),
                            shape=(len(e), len(x))))
    inside, outside = D[:, np.flatnonzero(free)], D[:, np.flatnonzero(~free)]
    x = x.copy()
    x[free] = factor(csc_array(inside.T @ inside))(inside.T @ (wanted[near] - outside @ x[~free]))
    return x


def conjugate_gradients(apply: Callable[[np.ndarray], np.ndarray], force: np.ndarray,
                         precondition: Callable[[np.ndarray], np.ndarray], iterations: int = 40,
                         tolerance: float = 1e-4) -> np.ndarray:
    """Solve `apply(d) = force` for arrays of any shape, with a symmetric positive definite `apply`."""
    d, r = np.zeros_like(force), force.copy()
    z = precondition(r)
    p, rz = z, float(np.sum(r * z))
    first = rz
    for _ in range(iterations):
        if rz <= tolerance**2 * first or not rz:
            break
        Ap = apply(p)
        a = rz / float(np.sum(p * Ap))
        d, r = d + a * p, r - a * Ap
        z = precondition(r)
        rz, last = float(np.sum(r * z)), rz
        p = z + rz / last * p
    return d
