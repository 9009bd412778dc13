"""Rigid alignment: by landmarks, and by iterative closest points (trimmed, point to plane)."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ..geometry import rotations
from ..geometry.mesh import Mesh
from ..geometry.surface import check_points
from ..geometry.target import target_of
from ..judgement import extent, unit_problem
from ..ranges import Positive, Settings, SomeShare
from ..threads import search_threads

LEAST = 6                   # matches that determine a motion


@dataclass(frozen=True)
class RigidConfig(Settings):
    """Settings of `align_rigid`.

    Attributes
    ----------
    keep : float
        Share of the matches, the nearest ones, that count.
    reach : float, metres, optional
        Farthest match that counts.
    """

    keep: SomeShare = 0.8
    reach: Positive | None = None


@dataclass(frozen=True, eq=False)
class RigidAlignment:
    """A rigid (or similarity) transform that brings a source to its target."""

    T_target_source: np.ndarray     # (4, 4)
    rms: float                      # metres, distances of inliers to the planes of the target, or between landmarks
    inliers: int
    converged: bool
    iterations: int


def align_landmarks(source: np.ndarray, target: np.ndarray, scale: bool = False) -> RigidAlignment:
    """The rotation and translation, optionally with scale, that bring landmarks (L, 3) nearest to their targets."""
    source, target = check_points(source, "source"), check_points(target, "target")
    if source.shape != target.shape:
        raise ValueError(f"target: expected {len(source)} landmarks as in source, got {len(target)}")
    if len(source) < 3:
        raise ValueError(f"source: expected at least 3 landmarks, got {len(source)}")
    R, _ = rotations.procrustes(source, target)
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    s = float(np.sum(b * (a @ R.T)) / np.sum(a * a)) if scale else 1.0
    T = transform(s * R, target.mean(axis=0) - s * R @ source.mean(axis=0))
    residual = np.linalg.norm(apply(T, source) - target, axis=1)
    return RigidAlignment(T, float(np.sqrt(np.mean(residual**2))), len(source), True, 1)


def align_rigid(source: Mesh | np.ndarray, target: Mesh | np.ndarray,
                landmarks: tuple[np.ndarray, np.ndarray] | None = None, config: RigidConfig | None = None,
                start: np.ndarray | None = None) -> RigidAlignment:
    """Bring one surface to another by trimmed point-to-plane matching.

    Parameters
    ----------
    source, target : Mesh or (n, 3) float, metres
    landmarks : (L, 3) and (L, 3) float, metres, optional
        Points of the source and where they are on the target; they give the start.
    start : (4, 4) float, optional
        A start in place of landmarks; without either, the source starts where it lies.

    Returns
    -------
    RigidAlignment

    Raises
    ------
    ValueError
        Empty input, values that are not finite, fewer than three landmarks.
    """
    config = config or RigidConfig()
    reach = np.inf if config.reach is None else config.reach
    moving = check_points(source.vertices if isinstance(source, Mesh) else source, "source")
    if not len(moving):
        raise ValueError("source: expected points, got none")
    goal = target_of(target, name="target")
    T = np.eye(4) if start is None else np.array(start, dtype=np.float64)
    if landmarks is not None:
        T = align_landmarks(*landmarks).T_target_source
    tree = cKDTree(goal.points)
    spread = np.linalg.norm(moving - moving.mean(axis=0), axis=1).mean()
    settled, rounds, rms, inliers = False, 0, np.nan, 0
    while rounds < 60 and not settled:
        moved = apply(T, moving)
        distance, near = tree.query(moved, workers=search_threads(len(moved)))
        good = (distance <= reach) & (distance <= np.quantile(distance, config.keep)) & ~goal.border[near]
        inliers = int(good.sum())
        if inliers < LEAST:
            break
        step, residual = _plane_step(moved[good], goal.points[near[good]], goal.normals[near[good]])
        T = step @ T
        rms = float(np.sqrt(np.mean(residual**2)))
        settled = bool(np.abs(apply(T, moving) - moved).mean() <= 1e-6 * spread)
        rounds += 1
    return RigidAlignment(T, rms, inliers, settled, rounds)


def apply(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (n, 3) after a transform (4, 4)."""
    return points @ T[:3, :3].T + T[:3, 3]


def _plane_step(x: np.ndarray, y: np.ndarray, n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The small motion that lessens the distances of points to planes most, and those distances before it."""
    middle = x.mean(axis=0)
    r = np.einsum("nd,nd->n", n, x - y)
    scale = np.median(np.abs(r)) * 1.4826 + 1e-12
    w = 1 / (1 + (r / (2 * scale)) ** 2)
    J = np.concatenate([np.cross(x - middle, n), n], axis=1)
    H = J.T @ (w[:, None] * J)
    step = -np.linalg.solve(H + 1e-9 * np.diag(np.maximum(H.diagonal(), 1e-12)), J.T @ (w * r))
    R = rotations.exp(step[:3])
    return transform(R, middle - R @ middle + step[3:]), r


def landmark_motion(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The rigid transform (4, 4) that brings points (n, 3) nearest to others."""
    return transform(*rotations.procrustes(source, target))


def transform(linear: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """(4, 4)"""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = linear, translation
    return T


def alignment_problem(source: np.ndarray, target: np.ndarray, found: RigidAlignment) -> str | None:
    """Why a rigid alignment of points (n, 3) to others means nothing; None where it means something."""
    ours, theirs = extent(source), extent(target)
    # surfaces farther apart than a fortieth of the smaller one do not lie on each other
    if found.inliers >= LEAST and found.rms <= 0.025 * min(ours, theirs):
        return None
    off = f"the surfaces are {1000 * found.rms:.0f} mm apart" if found.inliers >= LEAST else "the surfaces do not meet"
    return f"{off}; " + (unit_problem(ours, theirs, "the source is", 0.05) or
                         "a start far from the target, which needs landmarks, or something else?")
