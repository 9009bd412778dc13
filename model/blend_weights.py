"""Blend weights: how much each part counts for each vertex or triangle."""
from __future__ import annotations

import numpy as np
from scipy.sparse import csc_array, csr_array, diags_array, eye_array
from scipy.sparse.csgraph import laplacian

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.remeshing import clamp_cotangents
from scanprep.geometry.sparse import Factored, factor
from scanprep.skeleton.tree import Skeleton

CARRIERS = 4                         # parts that one vertex follows: more is not what other programs read


def skin_weights(template: Mesh, skeleton: Skeleton, width: float = 0.05) -> np.ndarray:
    """How much each part counts for each vertex, smooth across the borders of parts.

    The labels of the parts spread over the surface by one step of diffusion. What comes from a part that is not linked
    to the vertex's own one counts for the part on the way to it, so that a thigh never follows the other.

    Parameters
    ----------
    width : float, metres
        How far a part reaches along the surface. 5 cm is of widths from 0.5 to 8 cm the nearest to a SCAPE model of
        real scans, within a percent.

    Returns
    -------
    (N, J) float
        Rows sum to 1.

    Raises
    ------
    ValueError
        A width that is not positive.
    """
    if not width > 0:
        raise ValueError(f"width: expected a positive length, got {width}")
    J = len(skeleton.parents)
    areas = np.maximum(template.vertex_areas, 1e-12)
    labels = np.zeros((len(template.vertices), J))
    for corner in range(3):
        np.add.at(labels, (template.faces[:, corner], skeleton.part_of_face), template.face_areas / 3)
    alone = ~labels.any(axis=1)
    labels[alone, skeleton.part_of_vertex(template)[alone]] = areas[alone]
    spread = factor(csc_array(diags_array(areas) + width**2 * clamp_cotangents(template)))(labels)
    return to_neighbours(np.maximum(spread, 0), skeleton)


def face_weights(template: Mesh, skeleton: Skeleton, width: float) -> np.ndarray:
    """(F, J) how much the rotation of each part carries each triangle, own part and linked ones, rows sum to 1.

    [BlendSCAPE]
    """
    spread = skin_weights(template, skeleton, width)[template.faces].mean(axis=1)
    linked = np.eye(len(skeleton.parents), dtype=bool)
    child = np.arange(1, len(skeleton.parents))
    linked[child, skeleton.parents[child]] = linked[skeleton.parents[child], child] = True
    least = 0.01  # a weight below is dropped: it would cost a term and move nothing
    spread[~linked[skeleton.part_of_face] | (spread < least)] = 0
    own = np.arange(len(spread)), skeleton.part_of_face
    spread[own] = np.maximum(spread[own], least)
    return spread / spread.sum(axis=1, keepdims=True)


def to_neighbours(spread: np.ndarray, skeleton: Skeleton) -> np.ndarray:
    """(n, J) weights moved to the part of the largest one and the parts linked to it, rows summing to 1."""
    weights = np.zeros_like(spread)
    owner, toward = spread.argmax(axis=1), _first_step(skeleton)
    for p in range(spread.shape[1]):
        mine = owner == p
        for q in range(spread.shape[1]):
            weights[mine, toward[p, q]] += spread[mine, q]
    return weights / weights.sum(axis=1, keepdims=True)


def _first_step(skeleton: Skeleton) -> np.ndarray:
    """(J, J) the part next to p on the way to q along the tree; p itself where q is p."""
    J = len(skeleton.parents)
    step = np.zeros((J, J), dtype=np.int64)
    for p in range(J):
        for q in range(J):
            below = [c for c in np.flatnonzero(skeleton.parents == p) if skeleton.descends[q, c]]
            step[p, q] = p if p == q else below[0] if below else skeleton.parents[p]
    return step


def strongest(weights: np.ndarray, count: int = CARRIERS, least: float = 1e-6) -> np.ndarray:
    """Weights (N, J) with no more than the largest `count` of each vertex, none below the least, which sum to 1."""
    kept = np.array(weights, dtype=np.float64)
    if count < kept.shape[1]:
        np.put_along_axis(kept, np.argsort(-kept, axis=1, kind="stable")[:, count:], 0, axis=1)
    kept[kept < least] = 0
    return kept / kept.sum(axis=1, keepdims=True)


def diffuse_weights(template: Mesh, skeleton: Skeleton, width: float) -> np.ndarray:
    """Weights (N, J) that pass from part to part over a width, in metres, along the surface."""
    own = np.eye(len(skeleton.parents))[skeleton.part_of_vertex(template)]
    # at most 6 parts that a vertex may choose from
    return strongest(diffuse(template, own, width), 6, 1e-3)


def diffuse(template: Mesh, values: np.ndarray, width: float) -> np.ndarray:
    """Values (N, k) of the vertices after they have spread over a width, in metres, along the surface."""
    reach = (width / template.mean_edge) ** 2
    smooth = eye_array(len(values)) + reach * csc_array(laplacian(template.vertex_adjacency))
    return Factored(csc_array(smooth)).solve(values)


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
