"""Skinning weights: how much of each vertex follows each part."""
from __future__ import annotations

import numpy as np
from scipy.sparse import csc_array, csr_array, eye_array
from scipy.sparse.csgraph import laplacian

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.sparse import Factored
from scanprep.skeleton.tree import Skeleton

SMALLEST = 1e-3                      # lighter weights are dropped
CANDIDATES = 6                       # parts that a vertex may choose from


def diffused_weights(template: Mesh, skeleton: Skeleton, width: float) -> np.ndarray:
    """Weights (N, J) that pass from part to part over a width, in metres, along the surface."""
    own = np.eye(len(skeleton.parents))[skeleton.part_of_vertex(template)]
    return kept_weights(diffused(template, own, width), CANDIDATES)


def diffused(template: Mesh, values: np.ndarray, width: float) -> np.ndarray:
    """Values (N, k) of the vertices after they have spread over a width, in metres, along the surface."""
    reach = (width / template.mean_edge) ** 2
    smooth = eye_array(len(values)) + reach * csc_array(laplacian(template.vertex_adjacency))
    return Factored(csc_array(smooth)).solve(values)


def kept_weights(weights: np.ndarray, count: int) -> np.ndarray:
    """The `count` heaviest weights of each vertex, no lighter than `SMALLEST`, with rows that sum to 1."""
    order = np.argsort(-weights, axis=1, kind="stable")[:, :count]
    kept = np.zeros_like(weights)
    np.put_along_axis(kept, order, np.take_along_axis(weights, order, axis=1), axis=1)
    kept[kept < SMALLEST] = 0
    return kept / kept.sum(axis=1, keepdims=True)


def fit_weights(carried: list[np.ndarray], bodies: np.ndarray, template: Mesh, start: np.ndarray,
                allowed: np.ndarray, smoothness: float = 0.005, steps: int = 100) -> np.ndarray:
    """Weights with which the mean of what the parts say comes nearest to the bodies.

    Per vertex it is least squares over weights that are not negative and sum to 1, and neighbours are drawn to each
    other; accelerated projected gradients, every vertex with a step of its own.

    Of M arrays (J, N, 3) where each part carries each vertex of bodies (M, N, 3), and the parts (N, J) that each
    vertex may choose from. An error of `smoothness`, metres, is as bad as a weight that changes by 1 along an edge.
    """
    parts = np.argsort(~allowed, axis=1, kind="stable")[:, :allowed.sum(axis=1).max()]       # (N, P)
    free = np.take_along_axis(allowed, parts, axis=1)
    N, P = parts.shape
    gram = np.zeros((N, P, P))
    for each, body in zip(carried, bodies, strict=True):
        off = each[parts, np.arange(N)[:, None]] - body[:, None]
        gram += off @ np.swapaxes(off, -1, -2) / len(bodies)
    pull = csr_array(laplacian(template.vertex_adjacency)) * smoothness**2
    stiff = np.linalg.eigvalsh(gram)[:, -1] + 2 * pull.diagonal()
    w = last = np.take_along_axis(start, parts, axis=1)
    spread = np.zeros(start.shape)
    t = 1.0
    for _ in range(steps):
        ahead = (1 + np.sqrt(1 + 4 * t * t)) / 2
        v, t = w + (t - 1) / ahead * (w - last), ahead
        np.put_along_axis(spread, parts, v, axis=1)
        slope = (gram @ v[..., None])[..., 0] + np.take_along_axis(pull @ spread, parts, axis=1)
        last, w = w, _onto_simplex(v - slope / stiff[:, None], free)
        if ((v - w) * (w - last)).sum() > 0:                                  # past the goal: start the run anew
            t = 1.0
    fitted = np.zeros(start.shape)
    np.put_along_axis(fitted, parts, w, axis=1)
    return fitted


def _onto_simplex(v: np.ndarray, free: np.ndarray) -> np.ndarray:
    """The nearest rows to v (N, P) that are not negative, zero where not free, and sum to 1."""
    ranked = -np.sort(-np.where(free, v, -np.inf), axis=1)
    finite = np.where(np.isfinite(ranked), ranked, 0)
    level = (np.cumsum(finite, axis=1) - 1) / np.arange(1, v.shape[1] + 1)
    last = (ranked > level).sum(axis=1) - 1
    return np.where(free, np.maximum(v - level[np.arange(len(v)), last][:, None], 0), 0)
