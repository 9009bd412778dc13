"""What a decimation starts from: quadrics, the vertices that stay, the curves that stay."""
from __future__ import annotations

import numpy as np

from ..geometry.mesh import Mesh
from .edge_collapse import CURVE, FIXED, FREE, Rounds, RoundsConfig
from .quadrics import curve_quadrics, surface_quadrics


def begin(mesh: Mesh, points: np.ndarray, config: RoundsConfig, keep: np.ndarray | None = None,
          labels: np.ndarray | None = None, crease: float | None = None) -> Rounds:
    """Collapses that keep borders, and what else is asked for.

    Parameters
    ----------
    mesh : Mesh
        Manifold.
    points : (N, M, 3) float, metres
        Places of its vertices on M bodies, not far from the origin. Triangles keep their shape on the first.
    config : RoundsConfig
    keep : (n,) int, optional
        Vertices that stay, where they are.
    labels : (F,) int, optional
        Edges between triangles of different labels stay curves.
    crease : float, radians, optional
        Edges at which `mesh` bends by more stay curves.

    Raises
    ------
    ValueError
        Vertices or labels that do not belong to the mesh.
    """
    curves = kept_curves(mesh, labels, crease)
    kinds = np.minimum(np.bincount(curves.ravel(), minlength=len(mesh.vertices)), 3)
    kinds = np.array([FREE, FIXED, CURVE, FIXED])[kinds]          # the end of a curve, or where several meet, stays
    if keep is not None:
        kinds[checked_vertices(mesh, keep)] = FIXED
    quadrics, areas = surface_quadrics(points, mesh.faces, config.hold)
    quadrics += held_curves(mesh, points, areas, curves, config)
    return Rounds(points, mesh.faces, quadrics, areas[:, 0], kinds, curves, config)


def held_curves(mesh: Mesh, points: np.ndarray, areas: np.ndarray, curves: np.ndarray, config: RoundsConfig
                ) -> np.ndarray | float:
    """Quadrics (N, M, 10) of the walls along curves (E, 2), or 0 where there are none."""
    if not len(curves):
        return 0.0
    border = mesh.edges[mesh.edge_use == 1] @ [len(mesh.vertices), 1]
    weight = np.where(np.isin(curves @ [len(mesh.vertices), 1], border), config.wall, config.seam)
    return curve_quadrics(points, curves, areas[curves].sum(axis=1), weight)


def kept_curves(mesh: Mesh, labels: np.ndarray | None = None, crease: float | None = None) -> np.ndarray:
    """(E, 2) vertices of border edges, edges between labels, and creases sharper than an angle in radians."""
    stays = mesh.edge_use == 1
    if labels is not None or crease is not None:
        inner = np.flatnonzero(mesh.edge_use == 2)
        left, right = mesh.face_pairs.T
        if labels is not None:
            if np.shape(labels) != (len(mesh.faces),):
                raise ValueError(f"labels: expected one for each of {len(mesh.faces)} triangles, got "
                                 f"shape {np.shape(labels)}")
            stays[inner[np.asarray(labels)[left] != np.asarray(labels)[right]]] = True
        if crease is not None:
            cosine = np.einsum("nd,nd->n", mesh.face_normals[left], mesh.face_normals[right])
            stays[inner[cosine < np.cos(crease)]] = True
    return mesh.edges[stays]


def checked_vertices(mesh: Mesh, keep: np.ndarray) -> np.ndarray:
    """The vertices as integers, or ValueError when some are not of the mesh."""
    keep = np.asarray(keep, dtype=np.int64).reshape(-1)
    wrong = keep[(keep < 0) | (keep >= len(mesh.vertices))]
    if len(wrong):
        raise ValueError(f"keep: expected vertices 0..{len(mesh.vertices) - 1}, got {wrong[0]}")
    return keep
