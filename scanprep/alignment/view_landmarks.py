"""Rough camera poses from landmarks that were seen in several views, and how well views fit together."""
from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..geometry import rotations
from ..geometry.mesh import Mesh
from ..geometry.seen_space import SeenSpace
from ..geometry.surface import OrientedPoints

ROUNDS = 50


def place_by_landmarks(landmarks: Sequence[Mapping[str, np.ndarray]], count: int) -> np.ndarray:
    """Motions that bring landmarks of the same name together, over all views at once.

    Views are added one after the other, each on three or more landmarks it shares with those before it; then all
    are moved in turns onto the mean places of their landmarks.

    Parameters
    ----------
    landmarks : sequence of mappings name -> (3,) point in metres, one for each view
    count : int
        Views.

    Returns
    -------
    (V, 4, 4) float
        The first view stays.

    Raises
    ------
    ValueError
        A mapping is missing, or a view shares fewer than three landmarks, or three on one line, with the others.
    """
    if len(landmarks) != count:
        raise ValueError(f"landmarks: expected one mapping for each of {count} views, got {len(landmarks)}")
    names = sorted(set().union(*landmarks)) if count else []
    points = np.full((count, len(names), 3), np.nan)
    for view, marks in enumerate(landmarks):
        for name, point in marks.items():
            points[view, names.index(name)] = point
    seen = np.isfinite(points).all(axis=2)
    T = np.tile(np.eye(4), (count, 1, 1))
    placed = [0]
    while len(placed) < count:
        rest = [view for view in range(count) if view not in placed]
        known = seen[placed].any(axis=0)
        view = max(rest, key=lambda v: int((seen[v] & known).sum()))
        shared = seen[view] & known
        if shared.sum() < 3 or np.linalg.matrix_rank(_centred(points[view][shared]), tol=1e-3) < 2:
            raise ValueError(f"landmarks: view {view} shares {shared.sum()} with the views placed before it; "
                             "expected at least three that are not on one line")
        T[view] = _fit(points[view][shared], _means(T[placed], points[placed])[shared])
        placed.append(view)
    for _ in range(ROUNDS):
        means = _means(T, points)
        for view in range(1, count):
            good = seen[view] & (seen.sum(axis=0) > 1)
            T[view] = _fit(points[view][good], means[good])
    return T


def fit_of_views(views: Sequence[tuple[Mesh, np.ndarray]], near: float = 0.01, apart: float = 0.02,
                 points: int = 2000, rng: np.random.Generator | None = None) -> tuple[np.ndarray, np.ndarray]:
    """How far views agree with one another.

    Parameters
    ----------
    views : sequence of (Mesh, camera position (3,)) pairs
    near : float, metres
        Two views agree about a point when their surfaces, facing the same way, are this close.
    apart : float, metres
        They contradict each other when one looks through what the other saw, this far in front of its own surface.
    points : int
        Points of each view that are looked at.
    rng : numpy.random.Generator, optional

    Returns
    -------
    overlap : (V,) float
        Share of the points of each view that another view saw as well.
    conflict : (V,) float
        Share that another view looks through.
    """
    rng = rng or np.random.default_rng(0)
    chosen = [rng.permutation(len(mesh.vertices))[:points] for mesh, _ in views]
    targets = [OrientedPoints(mesh.vertices, mesh.vertex_normals) for mesh, _ in views]
    overlap, conflict = np.zeros(len(views)), np.zeros(len(views))
    for number, (mesh, _) in enumerate(views):
        rows = chosen[number]
        others = [k for k in range(len(views)) if k != number]
        if not others or not len(rows):
            continue
        p, n = mesh.vertices[rows], mesh.vertex_normals[rows]
        overlap[number] = np.mean(np.any([targets[k].match(p, n, near, 0.5).valid for k in others], axis=0))
        conflict[number] = np.mean(SeenSpace([views[k] for k in others]).ahead(p) > apart)
    return overlap, conflict


def _centred(points: np.ndarray) -> np.ndarray:
    return np.asarray(points - points.mean(axis=0))


def _means(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(L, 3) mean of the moved landmarks over the views that saw each; NaN where none did."""
    moved = np.einsum("vij,vlj->vli", T[:, :3, :3], points) + T[:, None, :3, 3]
    seen = np.isfinite(moved).all(axis=2, keepdims=True)
    total = np.where(seen, moved, 0).sum(axis=0)
    return np.asarray(np.where(seen.any(axis=0), total / np.maximum(seen.sum(axis=0), 1), np.nan))


def _fit(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotations.procrustes(source, target)
    return T
