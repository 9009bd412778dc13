"""Errors of the results of the chain against the ground truth of the built-in people."""
from __future__ import annotations

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.skeleton.tree import Skeleton
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


def rand_index(one: np.ndarray, other: np.ndarray, weights: np.ndarray) -> float:
    """Compute the adjusted Rand index of two labellings (n,) with weights (n,): 1 the same, 0 as by chance."""
    table = np.zeros((one.max() + 1, other.max() + 1))
    np.add.at(table, (one, other), weights / weights.sum())
    # pairs of points that share a label in both, in one, and in the other labelling
    together, rows, columns = (float((t**2).sum()) for t in (table, table.sum(axis=1), table.sum(axis=0)))
    chance = rows * columns
    return (together - chance) / (0.5 * (rows + columns) - chance)


def joint_errors(skeleton: Skeleton, rest: GroundTruth) -> np.ndarray:
    """Compute the distance (J - 1,), metres, of every joint to the nearest true one at rest."""
    apart = np.linalg.norm(skeleton.joints[1:, None] - rest.joints[None, 1:], axis=2)
    return apart.min(axis=1)
