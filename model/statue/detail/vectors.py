"""Displacements of any direction where a scan is not one-to-one with the control mesh [Statues].

Around folds a fine subdivision of the control mesh, displaced and smooth across them, is drawn onto the scan: each
vertex to the closest place whose normal agrees, held by the thin-plate energy of its displacement, which is solved
for (implicit steps) and made softer from step to step. Around the folds it stays where the heights say.
"""
from __future__ import annotations

import numpy as np
from scipy.sparse import csc_array, csr_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from scanprep.geometry import sparse
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import OrientedPoints, Surface
from scanprep.threads import search_threads

from .normal_volume import interpolate
from .texels import Lattice

SPACING = 0.002                      # metres between the places of the scan that are matched


def bend_over_folds(lattice: Lattice, scan: Mesh, heights: np.ndarray, folded: np.ndarray, reach: float
                    ) -> tuple[np.ndarray, np.ndarray]:
    """Which fine vertices (n,) of a lattice are drawn onto the scan, and the displacements (n, 3) of all, metres in the
    axes of the world; from `heights` (n,), smooth across folds, and which of them are `folded` (n,).
    """
    fine, mesh = lattice.fine, lattice.mesh
    p, n = interpolate(mesh, lattice.subdivision.parent, lattice.subdivision.bary)
    start = p + heights[:, None] * n
    near = fine.vertex_adjacency
    drawn = folded
    for _ in range(5):    # vertices around a fold that are drawn with it
        drawn = drawn | (near @ drawn.astype(float) > 0)
    free = np.flatnonzero(drawn)
    if not len(free):
        return drawn, start - p
    used = np.flatnonzero(drawn[fine.faces].any(axis=1))
    L = csr_array(diags_array(1 / near.sum(axis=1)) @ near - diags_array(np.ones(len(p))))
    held = start.copy()
    held[free] = 0
    of_free = csc_array(L)[:, free]
    bending, pull = csc_array(of_free.T @ of_free), -of_free.T @ (L @ held)
    places, facing = _places(scan, start[free], reach)
    if not len(places):
        return drawn, start - p
    target = OrientedPoints(places, facing, 0.01)    # metres that a change of the normal by 60 degrees is worth
    surface = start.copy()
    for stiffness in (100.0, 30.0, 10.0, 3.0, 1.0, 0.3, 0.1, 0.03):    # of the thin plate
        for _ in range(3):
            normals = Mesh(surface, fine.faces[used]).vertex_normals[free]
            match = target.match(surface[free], normals, reach, 0.3)
            onto = _onto(places[match.index], facing[match.index], surface[free])
            w = np.where(match.valid, 1.0, 0.001)[:, None]    # lightly held where nothing matches
            wanted = np.where(match.valid[:, None], onto, surface[free])
            solver = sparse.Factored(csc_array(stiffness * bending + diags_array(w[:, 0])))
            surface[free] = solver.solve(w * wanted + stiffness * pull)
    better = _better(lattice, scan, start, surface, drawn)
    return drawn & better, np.where(better[:, None], surface, start) - p


def _better(lattice: Lattice, scan: Mesh, before: np.ndarray, after: np.ndarray, drawn: np.ndarray) -> np.ndarray:
    """(n,) bool: vertices of those patches of drawn ones that have come nearer to the scan, in the mean square."""
    only = diags_array(drawn.astype(float))
    _, patch = connected_components(only @ lattice.fine.vertex_adjacency @ only, directed=False)
    faces = lattice.fine.faces[drawn[lattice.fine.faces].all(axis=1)]
    surface, of = Surface(scan), patch[faces[:, 0]]
    error = []
    for vertices in (before, after):
        there = Mesh(vertices, faces)
        far = surface.closest(there.corners.mean(axis=1)).distances
        area = np.bincount(of, there.face_areas, len(patch))
        error.append(np.bincount(of, there.face_areas * far**2, len(patch)) / np.maximum(area, 1e-30))
    return (error[1] < error[0])[patch]


def _places(scan: Mesh, points: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Places (m, 3) spread over the scan within reach of points, one for a square of SPACING, with normals (m, 3)."""
    middle = scan.corners.mean(axis=1)
    far = reach + np.sqrt(((scan.corners[:, 0] - middle)**2).sum(axis=1).max())
    apart, _ = cKDTree(points).query(middle, distance_upper_bound=far, workers=search_threads(len(middle)))
    around = scan.submesh(np.flatnonzero(np.isfinite(apart)))[0]
    if not len(around.faces) or not around.face_areas.sum():
        return np.zeros((0, 3)), np.zeros((0, 3))
    count = int(np.ceil(around.face_areas.sum() / SPACING**2))
    places, faces, _ = around.sample(count, np.random.default_rng(0))
    return places, around.face_normals[faces]


def _onto(q: np.ndarray, m: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points moved into the planes through their matches (n, 3), and no farther than SPACING from these."""
    off = points - q
    slip = off - np.einsum("nd,nd->n", off, m)[:, None] * m
    return q + slip * np.minimum(1, SPACING / np.maximum(np.linalg.norm(slip, axis=1), 1e-12))[:, None]
