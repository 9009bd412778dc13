"""Errors of the results of the chain against the ground truth of the built-in people."""
from __future__ import annotations

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.synthetic.data_set import GroundTruth


def distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Compute distances (N,) of corresponding points (N, 3)."""
    return np.linalg.norm(a - b, axis=1)


def surface_error(mesh: Mesh, truth: GroundTruth) -> np.ndarray:
    """Compute the distance (N,), metres, of the vertices of a mesh to the true surface."""
    return Surface(truth.mesh).closest(mesh.vertices).distances


def mean_over_area(values: np.ndarray, mesh: Mesh, where: np.ndarray | None = None) -> float:
    """Compute the mean of values (N,) over the surface, or over the vertices in `where` (N,) bool."""
    weights = mesh.vertex_areas if where is None else mesh.vertex_areas * where
    return float(values @ weights / weights.sum())
