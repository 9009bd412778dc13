"""Parts that share what lies between them: weights that are smooth across the borders of parts."""
from __future__ import annotations

import numpy as np
from scipy.sparse import csc_array, diags_array

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.remeshing import clamped_cotangents
from scanprep.geometry.sparse import factor
from scanprep.skeleton.tree import Skeleton

LEAST = 0.01                         # a weight below is dropped: it would cost a term and move nothing


def vertex_weights(template: Mesh, skeleton: Skeleton, width: float) -> np.ndarray:
    """(N, J) how much each part carries each vertex, smooth across the borders of parts, rows sum to 1.

    The labels of the parts spread over a width, metres, of surface by one step of diffusion. What comes from a part
    that is not linked to the vertex's own one counts for the part on the way to it, so that a thigh never carries the
    other.
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
    spread = factor(csc_array(diags_array(areas) + width**2 * clamped_cotangents(template)))(labels)
    return to_neighbours(np.maximum(spread, 0), skeleton)


def face_weights(template: Mesh, skeleton: Skeleton, width: float) -> np.ndarray:
    """(F, J) how much the rotation of each part carries each triangle, own part and linked ones, rows sum to 1.

    [BlendSCAPE]
    """
    spread = vertex_weights(template, skeleton, width)[template.faces].mean(axis=1)
    linked = np.eye(len(skeleton.parents), dtype=bool)
    child = np.arange(1, len(skeleton.parents))
    linked[child, skeleton.parents[child]] = linked[skeleton.parents[child], child] = True
    spread[~linked[skeleton.part_of_face] | (spread < LEAST)] = 0
    own = np.arange(len(spread)), skeleton.part_of_face
    spread[own] = np.maximum(spread[own], LEAST)
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
