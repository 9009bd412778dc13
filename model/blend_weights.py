"""Blend weights: the share of each part's motion in the motion of a vertex or triangle."""
from __future__ import annotations

import numpy as np
from scipy.sparse import csc_array, csr_array, diags_array, eye_array
from scipy.sparse.csgraph import laplacian

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.remeshing import clamp_cotangents
from scanprep.geometry.sparse import Factored, factor
from scanprep.skeleton.tree import Skeleton

CARRIERS = 4                         # parts that one vertex follows: glTF and most programs read four weights a vertex


def skin_weights(template: Mesh, skeleton: Skeleton, width: float = 0.05) -> np.ndarray:
    """Compute blend weights of the vertices that are smooth across the borders of parts.

    The labels of the parts spread over the surface by one step of diffusion. A weight of a part that is not linked to
    the vertex's own part moves to the linked part on the way there. So one thigh never follows the other.

    Parameters
    ----------
    template : Mesh
        N vertices.
    skeleton : Skeleton
        J parts.
    width : float, metres
        How far a part reaches along the surface. Of widths from 0.5 to 8 cm, 5 cm comes nearest to a SCAPE model of
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
    # every triangle gives a third of its area to the part label of each of its corners
    labels = np.zeros((len(template.vertices), J))
    for corner in range(3):
        np.add.at(labels, (template.faces[:, corner], skeleton.part_of_face), template.face_areas / 3)
    # a vertex without triangles keeps the label of its part
    alone = ~labels.any(axis=1)
    labels[alone, skeleton.part_of_vertex(template)[alone]] = areas[alone]
    # one implicit step of heat diffusion: (areas + width² cotangent Laplacian) weights = labels
    spread = factor(csc_array(diags_array(areas) + width**2 * clamp_cotangents(template)))(labels)
    return to_neighbours(np.maximum(spread, 0), skeleton)


def face_weights(template: Mesh, skeleton: Skeleton, width: float) -> np.ndarray:
    """Compute weights (F, J) of the part rotations for every triangle; rows sum to 1.

    Only a triangle's own part and the parts linked to it have a weight.

    [BlendSCAPE]
    """
    spread = skin_weights(template, skeleton, width)[template.faces].mean(axis=1)
    # which parts are joined: a part to itself, to its parent and to its children
    linked = np.eye(len(skeleton.parents), dtype=bool)
    child = np.arange(1, len(skeleton.parents))
    linked[child, skeleton.parents[child]] = linked[skeleton.parents[child], child] = True
    least = 0.01  # a weight below is dropped: it would cost a term and move nothing
    spread[~linked[skeleton.part_of_face] | (spread < least)] = 0
    # the own part always keeps a weight, so that every row can be scaled to a sum of 1
    own = np.arange(len(spread)), skeleton.part_of_face
    spread[own] = np.maximum(spread[own], least)
    return spread / spread.sum(axis=1, keepdims=True)


def to_neighbours(spread: np.ndarray, skeleton: Skeleton) -> np.ndarray:
    """Move weights (n, J) to the part with the largest weight and the parts linked to it; rows sum to 1."""
    weights = np.zeros_like(spread)
    owner, toward = spread.argmax(axis=1), _first_step(skeleton)
    for p in range(spread.shape[1]):
        rows = owner == p
        for q in range(spread.shape[1]):
            weights[rows, toward[p, q]] += spread[rows, q]
    return weights / weights.sum(axis=1, keepdims=True)


def _first_step(skeleton: Skeleton) -> np.ndarray:
    """Find the part next to p on the way to q along the tree, for all pairs (J, J); p itself where q is p."""
    J = len(skeleton.parents)
    step = np.zeros((J, J), dtype=np.int64)
    for p in range(J):
        for q in range(J):
            # go down into the branch that holds q, else up to the parent
            below = [c for c in np.flatnonzero(skeleton.parents == p) if skeleton.descends[q, c]]
            step[p, q] = p if p == q else below[0] if below else skeleton.parents[p]
    return step


def strongest(weights: np.ndarray, count: int = CARRIERS, least: float = 1e-6) -> np.ndarray:
    """Keep the largest `count` weights (N, J) of each vertex, drop those below `least`, and scale rows to sum to 1."""
    kept = np.array(weights, dtype=np.float64)
    if count < kept.shape[1]:
        np.put_along_axis(kept, np.argsort(-kept, axis=1, kind="stable")[:, count:], 0, axis=1)
    kept[kept < least] = 0
    return kept / kept.sum(axis=1, keepdims=True)


def diffuse_weights(template: Mesh, skeleton: Skeleton, width: float) -> np.ndarray:
    """Compute weights (N, J) that change from part to part over a width, metres, along the surface."""
    own = np.eye(len(skeleton.parents))[skeleton.part_of_vertex(template)]
    # a learned vertex may choose among at most 6 parts; weights below a thousandth are no candidates
    return strongest(diffuse(template, own, width), 6, 1e-3)


def diffuse(template: Mesh, values: np.ndarray, width: float) -> np.ndarray:
    """Smooth values (N, k) of the vertices over a width, metres, along the surface."""
    # the graph Laplacian counts edges, so the width is measured in mean edge lengths
    reach = (width / template.mean_edge) ** 2
    smooth = eye_array(len(values)) + reach * csc_array(laplacian(template.vertex_adjacency))
    return Factored(csc_array(smooth)).solve(values)


def fit_weights(carried: list[np.ndarray], bodies: np.ndarray, template: Mesh, start: np.ndarray,
                allowed: np.ndarray, smoothness: float = 0.005, steps: int = 100) -> np.ndarray:
    """Find the blend weights with which skinning comes nearest to the bodies, in the least-squares sense.

    Weights are not negative, sum to 1 for each vertex, and differ little between neighbours. The method is accelerated
    projected gradient descent; every vertex has its own step length.

    Parameters
    ----------
    carried : M arrays (J, N, 3) float, metres
        Where each part alone would carry each vertex, for every body.
    bodies : (M, N, 3) float, metres
        Registered bodies.
    template : Mesh
        N vertices.
    start : (N, J) float
        Weights to begin with.
    allowed : (N, J) bool
        The parts that each vertex may follow.
    smoothness : float, metres
        An error of this size costs as much as a weight that changes by 1 along an edge.
    steps : int
        Number of gradient steps.

    Returns
    -------
    (N, J) float
    """
    # the P parts that a vertex may follow stand first, so that dense arrays (N, P) hold everything
    parts = np.argsort(~allowed, axis=1, kind="stable")[:, :allowed.sum(axis=1).max()]       # (N, P)
    free = np.take_along_axis(allowed, parts, axis=1)
    N, P = parts.shape
    # weights sum to 1, so the error is linear in them: gram holds the products of the parts' own errors
    gram = np.zeros((N, P, P))
    for by_part, body in zip(carried, bodies, strict=True):
        off = by_part[parts, np.arange(N)[:, None]] - body[:, None]
        gram += off @ np.swapaxes(off, -1, -2) / len(bodies)
    # step lengths from a bound on the curvature: the largest eigenvalue, and twice the Laplacian's diagonal
    pull = csr_array(laplacian(template.vertex_adjacency)) * smoothness**2
    stiff = np.linalg.eigvalsh(gram)[:, -1] + 2 * pull.diagonal()
    w = last = np.take_along_axis(start, parts, axis=1)
    spread = np.zeros(start.shape)
    t = 1.0
    for _ in range(steps):
        # Nesterov's momentum: the gradient is taken ahead of the weights
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
    """Project rows v (N, P) onto the simplex: not negative, zero where not free, with sum 1."""
    ranked = -np.sort(-np.where(free, v, -np.inf), axis=1)
    # the threshold that is subtracted from all free entries, from the sorted cumulative sums
    finite = np.where(np.isfinite(ranked), ranked, 0)
    level = (np.cumsum(finite, axis=1) - 1) / np.arange(1, v.shape[1] + 1)
    last = (ranked > level).sum(axis=1) - 1
    return np.where(free, np.maximum(v - level[np.arange(len(v)), last][:, None], 0), 0)
