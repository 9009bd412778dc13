"""Fewer triangles, quickly: for a mesh that is only looked at, and before work for which a scan is too fine."""
from __future__ import annotations

import warnings

import numpy as np
from scipy.spatial import cKDTree

from ..threads import search_threads
from .mesh import Mesh

MOST = 2_000_000         # triangles of a person about 1.3 mm long: finer than any scanner's noise


def fewer_triangles(mesh: Mesh, most: int) -> tuple[Mesh, np.ndarray]:
    """A mesh of about `most` triangles, without its surface kept manifold, and the old vertex next to each (n,)."""
    import fast_simplification

    middle = mesh.vertices.mean(axis=0)                # it works in single precision
    points, faces = fast_simplification.simplify((mesh.vertices - middle).astype(np.float32),
                                                 mesh.faces.astype(np.int32), target_count=most)
    vertices = points.astype(float) + middle
    nearest = cKDTree(mesh.vertices).query(vertices, workers=search_threads(len(vertices)))[1]
    colors = None if mesh.colors is None else mesh.colors[nearest]
    return Mesh(vertices, faces.astype(np.int64), colors), nearest


def thin_scan(scan: Mesh, name: str = "scan", most: int = MOST) -> Mesh:
    """A scan with at most about `most` triangles, with a UserWarning where it had more; numbers of vertices are kept.

    `of_file` says which vertex stands for each one before, so files of vertex numbers go on to mean the same places.
    """
    if len(scan.faces) <= most:
        return scan
    thin, _ = fewer_triangles(scan, most)
    new = cKDTree(thin.vertices).query(scan.vertices, workers=search_threads(len(scan.vertices)))[1]
    warnings.warn(f"{name}: thinned from {len(scan.faces)} to {len(thin.faces)} triangles before any work", stacklevel=2)
    return Mesh(thin.vertices, thin.faces, thin.colors, new if scan.of_file is None else new[scan.of_file])
