"""Functional maps: correspondences through the low frequencies of two surfaces, refined by ZoomOut.

1. Both surfaces get a Laplace-Beltrami basis from one point-cloud operator, so that sheets and holes do no harm.
2. Wave kernel signatures, and wave kernel maps of the seeds, are functions that must go over into each other: a
   small least-squares problem gives the functional map.
3. ZoomOut: turn the map into points and the points into a larger map, from few frequencies to many.

Functional maps are due to Ovsjanikov et al. (2012), wave kernels to Aubry et al. (2011), ZoomOut to Melzi et al.
(2019), the operator to Coifman and Lafon (2006).
"""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csc_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import LinearOperator, eigsh
from scipy.spatial import cKDTree

from ..geometry.mesh import Mesh, check_template
from ..geometry.sparse import factor
from ..ranges import Cell, Count, Settings
from ..registration.deformation_graph import farthest_points
from ..registration.matches import Target, target_of
from .correspondences import Correspondences, checked_pairs
from .sheet import Sheet


@dataclass(frozen=True)
class FunctionalConfig(Settings):
    """Settings of `find_functional_correspondences`.

    Attributes
    ----------
    first, last, step : int
        Frequencies of the first map, of the last, and how many each round of ZoomOut adds.
    energies : int
        Energies at which wave kernels are taken.
    commute : float
        Weight of commuting with the Laplacian.
    spacing : float
        Distance that both surfaces are thinned to, as a multiple of the template's size.
    sample : int
        Points of the scan that take part in ZoomOut.
    points : int
        Correspondences in the result, the first of these.
    neighbours : int
        Points of the scan over which its normals are averaged.
    """

    first: Count = 20
    last: Count = 120
    step: Count = 5
    energies: Count = 30
    commute: float = 1e-3
    spacing: Cell = 0.012
    sample: Count = 1200
    points: Count = 170
    neighbours: Count = 16


@dataclass(frozen=True, eq=False)
class Spectrum:
    """The low frequencies of a surface of unit area.

    Attributes
    ----------
    points : (n, 3) float, metres
        Of the largest connected piece: an island would bring a frequency of zero of its own.
    values : (k,) float
        Ascending, the first zero.
    functions : (n, k) float
        Orthonormal under `mass`.
    mass : (n,) float
    """

    points: np.ndarray
    values: np.ndarray
    functions: np.ndarray
    mass: np.ndarray

    def coefficients(self, functions: np.ndarray, count: int) -> np.ndarray:
        """(count, d) of functions (n, d)."""
        return self.functions[:, :count].T @ (self.mass[:, None] * functions)


def find_functional_correspondences(template: Mesh, scan: Mesh | np.ndarray,
                                    seeds: tuple[np.ndarray, np.ndarray] | None = None,
                                    config: FunctionalConfig | None = None) -> Correspondences:
    """Correspondences by a functional map with ZoomOut.

    Parameters
    ----------
    template : Mesh
        One connected manifold component.
    scan : Mesh or (n, 3) float, metres
        Nearly complete: a basis of half a body is not that of the whole.
    seeds : (S,) int and (S, 3) float, metres, optional
        Vertices of the template and where they are on the scan. Without them, nothing tells left from right.

    Returns
    -------
    Correspondences
        The confidence is how well the way there and back closes.

    Raises
    ------
    ValueError
        A template that is not one manifold component, a scan with fewer points than frequencies, fewer than three
        seeds or seeds that do not exist.
    """
    config = config or FunctionalConfig()
    check_template(template)
    seeds = seeds and checked_pairs(template, *seeds, "seeds")
    size = float(np.sqrt(template.face_areas.sum()))
    body = Sheet(Target(template.vertices, template.vertex_normals, np.zeros(len(template.vertices), dtype=bool),
                        True), config.spacing * size)
    sheet = Sheet(target_of(scan, config.neighbours), config.spacing * size)
    if min(len(sheet.points), len(body.points)) <= config.last + 1:
        raise ValueError(f"scan: expected more than {config.last + 1} points at this spacing, got "
                         f"{min(len(sheet.points), len(body.points))}")
    a, b = (spectrum(s, config.last) for s in (body, sheet))
    marks = None
    if seeds is not None:
        marks = (cKDTree(a.points).query(template.vertices[seeds[0]])[1], cKDTree(b.points).query(seeds[1])[1])
    sample = farthest_points(b.points, min(config.sample, len(b.points)))
    C = zoom_out(a, b, first_map(a, b, marks, config), sample, config)
    chosen = sample[:config.points]
    there = nearest_functions(a, b, C, chosen)
    back = _nearest(a.functions[there, :len(C)] @ C.T, b.functions[:, :len(C)])
    gap = np.linalg.norm(b.points[back] - b.points[chosen], axis=1)
    vertices = cKDTree(template.vertices).query(a.points[there])[1]
    error = float(np.linalg.norm(C.T @ C - np.eye(len(C))) / np.sqrt(len(C)))
    return Correspondences(vertices, b.points[chosen], np.exp(-gap / (0.03 * size)), "functional",
                           {"not_orthonormal": error}, bool(error < 0.5))


def spectrum(sheet: Sheet, count: int) -> Spectrum:
    """The `count` lowest frequencies of a sheet, by heat between neighbours, scaled to unit area.

    Each point's weight to its neighbours falls with distance as heat does in a short time; dividing by the
    density first makes the operator that of the surface, however unevenly it is sampled.
    """
    _, label = connected_components(sheet.graph, directed=False)
    main = np.flatnonzero(label == np.bincount(label).argmax())
    edges = sheet.graph[main][:, main].tocoo()
    n = len(main)
    time = (1.2 * sheet.spacing) ** 2
    W = coo_array((np.exp(-edges.data**2 / time), (edges.row, edges.col)), shape=(n, n)).tocsr()
    W = W + diags_array(np.ones(n))
    density = np.asarray(W.sum(axis=1)).ravel()
    W = diags_array(1 / density) @ W @ diags_array(1 / density)
    mass = np.asarray(W.sum(axis=1)).ravel()
    stiffness = csc_array(diags_array(mass) - W)
    mass = mass / mass.sum()
    M = csc_array(diags_array(mass))
    # Shifted a little below zero, where the operator can be factored.
    shift = 1e-6 * float(stiffness.diagonal().mean() / mass.mean())
    inverse = LinearOperator((n, n), factor(csc_array(stiffness + shift * M)))
    values, functions = eigsh(stiffness, count, M, sigma=-shift, which="LM", v0=np.ones(n), OPinv=inverse)
    order = np.argsort(values)
    values = np.maximum(values[order] - values[order[0]], 0.0)
    weyl = 4 * np.pi * count / max(values[-1], 1e-300)       # on unit area the k-th is about 4 pi k
    return Spectrum(sheet.points[main], weyl * values, functions[:, order], mass)


def wave_kernels(surface: Spectrum, energies: np.ndarray, width: float, source: np.ndarray | None = None
                 ) -> np.ndarray:
    """Wave kernel signatures (n, d), or wave kernel maps (n, d S) of points (S,).
    """
    log_values = np.log(np.maximum(surface.values[1:], 1e-9))
    filters = np.exp(-((energies[:, None] - log_values) ** 2) / (2 * width**2))
    filters /= np.maximum(filters.sum(axis=1, keepdims=True), 1e-300)
    phi = surface.functions[:, 1:]
    if source is None:
        return phi**2 @ filters.T
    return np.concatenate([phi @ (filters * phi[s]).T for s in source], axis=1)


def first_map(a: Spectrum, b: Spectrum, marks: tuple[np.ndarray, np.ndarray] | None, config: FunctionalConfig
              ) -> np.ndarray:
    """The map (k, k) that carries the functions of the first surface to those of the second.
    """
    k = config.first
    low, high = np.log(max(a.values[1], 1e-9)), np.log(a.values[-1])
    width = 0.07 * (high - low)
    energies = np.linspace(low + 2 * width, high - 2 * width, config.energies)
    parts = [[wave_kernels(s, energies, width)] for s in (a, b)]
    if marks is not None:
        for s, part, mark in zip((a, b), parts, marks, strict=True):
            part.append(wave_kernels(s, energies, width, mark))
    A, B = (s.coefficients(np.concatenate(part, axis=1), k) for s, part in zip((a, b), parts, strict=True))
    scale = np.maximum(np.linalg.norm(A, axis=0), 1e-12)
    A, B = A / scale, B / scale
    C = np.zeros((k, k))
    apart = (b.values[:k, None] - a.values[None, :k]) ** 2 / max(b.values[k - 1], 1e-300) ** 2
    for row in range(k):                                    # rows of the least-squares problem are independent
        C[row] = np.linalg.solve(A @ A.T + config.commute * A.shape[1] * np.diag(apart[row]) + 1e-9 * np.eye(k),
                                 A @ B[row])
    return C


def nearest_functions(a: Spectrum, b: Spectrum, C: np.ndarray, points: np.ndarray) -> np.ndarray:
    """For points (m,) of the second surface those of the first that the map takes there, (m,) int."""
    rows, columns = C.shape
    return _nearest(b.functions[points, :rows], a.functions[:, :columns] @ C.T)


def zoom_out(a: Spectrum, b: Spectrum, C: np.ndarray, sample: np.ndarray, config: FunctionalConfig) -> np.ndarray:
    """A functional map refined from few frequencies to many, with the points `sample` of the second surface."""
    for k in range(len(C) + config.step, config.last + 1, config.step):
        image = nearest_functions(a, b, C, sample)
        C = np.linalg.lstsq(b.functions[sample, :k], a.functions[image, :k], rcond=None)[0]
    return C


def _nearest(queries: np.ndarray, places: np.ndarray) -> np.ndarray:
    """The row of `places` nearest to each query: by products, as trees do not help in a hundred dimensions."""
    return np.argmin(np.sum(places**2, axis=1) - 2 * queries @ places.T, axis=1)
