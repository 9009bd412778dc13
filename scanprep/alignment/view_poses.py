"""Find rough camera poses from shared landmarks, and measure how well views agree."""
from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..geometry.mesh import Mesh
from ..geometry.surface import OrientedPoints, SeenSpace
from .icp import landmark_motion


def place_by_landmarks(landmarks: Sequence[Mapping[str, np.ndarray]], count: int) -> np.ndarray:
    """Find motions (V, 4, 4) that bring landmarks of the same name together; the first view stays.

    Views are added one by one. Each must share at least three landmarks, not on one line, with the views before it.
    Then all are moved in turn onto the mean positions of their landmarks.
    """
    if len(landmarks) != count:
        raise ValueError(f"landmarks: expected one mapping for each of {count} views, got {len(landmarks)}")
    # table of landmarks (V, L, 3), NaN where a view does not see one
    names = sorted(set().union(*landmarks)) if count else []
    points = np.full((count, len(names), 3), np.nan)
    for view, marks in enumerate(landmarks):
        for name, point in marks.items():
            points[view, names.index(name)] = point
    seen = np.isfinite(points).all(axis=2)
    T = np.tile(np.eye(4), (count, 1, 1))
    placed = [0]
    while len(placed) < count:
        # next: the view that shares most landmarks with those already placed
        rest = [view for view in range(count) if view not in placed]
        known = seen[placed].any(axis=0)
        view = max(rest, key=lambda v: int((seen[v] & known).sum()))
        shared = seen[view] & known
        there = points[view][shared]
        if len(there) < 3 or np.linalg.matrix_rank(there - there.mean(axis=0), tol=1e-3) < 2:
            raise ValueError(f"landmarks: view {view} shares {shared.sum()} with the views placed before it; "
                             "expected at least three that are not on one line")
        T[view] = landmark_motion(points[view][shared], _means(T[placed], points[placed])[shared])
        placed.append(view)
    # alternate mean landmarks and rigid fits; fifty rounds settle it
    for _ in range(50):
        means = _means(T, points)
        for view in range(1, count):
            good = seen[view] & (seen.sum(axis=0) > 1)
            T[view] = landmark_motion(points[view][good], means[good])
    return T


def fit_of_views(views: Sequence[tuple[Mesh, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Measure which share (V,) of each view another view also saw, and which share (V,) violates free space of another.

    Two views agree on a point if their surfaces face the same way and are at most 1 cm apart. They conflict if one sees
    through a point of the other, more than 2 cm in front of its own surface.
    """
    rng = np.random.default_rng(0)
    chosen = [rng.permutation(len(mesh.vertices))[:2000] for mesh, _ in views]
    targets = [OrientedPoints(mesh.vertices, mesh.vertex_normals) for mesh, _ in views]
    overlap, conflict = np.zeros(len(views)), np.zeros(len(views))
    for number, (mesh, _) in enumerate(views):
        rows = chosen[number]
        others = [k for k in range(len(views)) if k != number]
        if not others or not len(rows):
            continue
        p, n = mesh.vertices[rows], mesh.vertex_normals[rows]
        overlap[number] = np.mean(np.any([targets[k].match(p, n, 0.01, 0.5).valid for k in others], axis=0))
        conflict[number] = np.mean(SeenSpace([views[k] for k in others]).ahead(p) > 0.02)
    return overlap, conflict


def _means(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Average the moved landmarks (L, 3) over the views that see them; NaN where none does."""
    moved = np.einsum("vij,vlj->vli", T[:, :3, :3], points) + T[:, None, :3, 3]
    seen = np.isfinite(moved).all(axis=2, keepdims=True)
    total = np.where(seen, moved, 0).sum(axis=0)
    return np.asarray(np.where(seen.any(axis=0), total / np.maximum(seen.sum(axis=0), 1), np.nan))
