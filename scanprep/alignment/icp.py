"""Rigid alignment: by landmarks, and by ICP (iterative closest points; trimmed, point to plane)."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ..geometry import rotations
from ..geometry.mesh import Mesh, take_any_mesh
from ..geometry.surface import check_points
from ..geometry.target import target_of
from ..judgement import extent
from ..plausible import unit_problem
from ..ranges import Settings, SomeShare
from ..threads import search_threads

LEAST = 6                   # fewest matches: as many as a rigid motion has unknowns


@dataclass(frozen=True)
class RigidConfig(Settings):
    """Settings of `align_rigid`.

    Attributes
    ----------
    keep : float
        Share of the matches that count, the nearest ones.

    Examples
    --------
    >>> RigidConfig(keep=0.5).keep
    0.5
    """

    keep: SomeShare = 0.8


@dataclass(frozen=True, eq=False)
class RigidAlignment:
    """A rigid (or similarity) transform from a source to its target.

    Attributes
    ----------
    T_target_source : (4, 4) float
        The transform; translations in metres.
    rms : float, metres
        RMS distance of the inliers to the tangent planes of the target, or between landmarks.
    inliers : int
        Matches in the last iteration.
    converged : bool
        The last iteration moved the source by less than a millionth of its size.
    iterations : int
        Iterations done.
    """

    T_target_source: np.ndarray
    rms: float
    inliers: int
    converged: bool
    iterations: int


def align_landmarks(source: np.ndarray, target: np.ndarray, scale: bool = False) -> RigidAlignment:
    """Align landmarks (L, 3), metres, to their targets by least squares; `scale` allows a similarity."""
    source, target = check_points(source, "source"), check_points(target, "target")
    if source.shape != target.shape:
        raise ValueError(f"target: expected {len(source)} landmarks as in source, got {len(target)}")
    if len(source) < 3:
        raise ValueError(f"source: expected at least 3 landmarks, got {len(source)}")
    # rotation by Procrustes, then the least-squares scale, then the translation between centroids
    R, _ = rotations.procrustes(source, target)
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    s = float(np.sum(b * (a @ R.T)) / np.sum(a * a)) if scale else 1.0
    T = transform(s * R, target.mean(axis=0) - s * R @ source.mean(axis=0))
    residual = np.linalg.norm(apply(T, source) - target, axis=1)
    return RigidAlignment(T, float(np.sqrt(np.mean(residual**2))), len(source), True, 1)


@take_any_mesh
def align_rigid(source: Mesh | np.ndarray, target: Mesh | np.ndarray,
                landmarks: tuple[np.ndarray, np.ndarray] | None = None, config: RigidConfig | None = None,
                start: np.ndarray | None = None) -> RigidAlignment:
    """Align one surface rigidly to another by trimmed point-to-plane ICP.

    Parameters
    ----------
    source : Mesh or (n, 3) float, metres
        The surface to move.
    target : Mesh or (m, 3) float, metres
        The surface that stays.
    landmarks : ((L, 3) float, (L, 3) float), metres, optional
        Points of the source and their positions on the target, for the initial transform.
    config : RigidConfig, optional
        Settings.
    start : (4, 4) float, optional
        Initial transform instead of landmarks. By default the source starts where it is.

    Returns
    -------
    RigidAlignment
        The transform (4, 4), translation in metres, with convergence facts.

    Raises
    ------
    ValueError
        Empty input, values that are not finite, fewer than three landmarks.

    Examples
    --------
    >>> x, y = np.meshgrid(np.linspace(-1, 1, 30), np.linspace(-1, 1, 30))
    >>> surface = np.stack([x, y, 0.3 * np.sin(3 * x) * np.cos(2 * y)], axis=-1).reshape(-1, 3)
    >>> T = align_rigid(surface + [0.02, 0, 0.03], surface).T_target_source
    >>> np.allclose(T[:3, 3], [-0.02, 0, -0.03], atol=1e-3)
    True
    """
    config = config or RigidConfig()
    moving = check_points(source.vertices if isinstance(source, Mesh) else source, "source")
    if not len(moving):
        raise ValueError("source: expected points, got none")
    goal = target_of(target, name="target")
    T = np.eye(4) if start is None else np.array(start, dtype=np.float64)
    if landmarks is not None:
        T = align_landmarks(*landmarks).T_target_source
    # trimmed ICP: nearest points, drop the farthest fifth and matches on borders, one Gauss-Newton step
    tree = cKDTree(goal.points)
    spread = np.linalg.norm(moving - moving.mean(axis=0), axis=1).mean()
    settled, rounds, rms, inliers = False, 0, np.nan, 0
    while rounds < 60 and not settled:
        moved = apply(T, moving)
        distance, near = tree.query(moved, workers=search_threads(len(moved)))
        good = (distance <= np.quantile(distance, config.keep)) & ~goal.border[near]
        inliers = int(good.sum())
        if inliers < LEAST:
            break
        step, residual = _plane_step(moved[good], goal.points[near[good]], goal.normals[near[good]])
        T = step @ T
        rms = float(np.sqrt(np.mean(residual**2)))
        # converged when a step moves points by less than a millionth of the size of the source
        settled = bool(np.abs(apply(T, moving) - moved).mean() <= 1e-6 * spread)
        rounds += 1
    return RigidAlignment(T, rms, inliers, settled, rounds)


def apply(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Transform points (n, 3) by a matrix (4, 4)."""
    return points @ T[:3, :3].T + T[:3, 3]


def _plane_step(x: np.ndarray, y: np.ndarray, n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute one robust point-to-plane step (4, 4) of points x to planes y, n, and the distances before it."""
    middle = x.mean(axis=0)
    r = np.einsum("nd,nd->n", n, x - y)
    # Cauchy weights: residuals beyond two robust standard deviations count less
    scale = np.median(np.abs(r)) * 1.4826 + 1e-12
    w = 1 / (1 + (r / (2 * scale)) ** 2)
    J = np.concatenate([np.cross(x - middle, n), n], axis=1)
    # normal equations of the six unknowns about the centroid; the ridge covers motions along a plane
    H = J.T @ (w[:, None] * J)
    step = -np.linalg.solve(H + 1e-9 * np.diag(np.maximum(H.diagonal(), 1e-12)), J.T @ (w * r))
    R = rotations.exp(step[:3])
    return transform(R, middle - R @ middle + step[3:]), r


def landmark_motion(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Compute the rigid transform (4, 4) that brings points (n, 3) nearest to others, by Procrustes."""
    return transform(*rotations.procrustes(source, target))


def transform(linear: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Build a transform (4, 4) from a linear part (3, 3) and a translation (3,)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = linear, translation
    return T


def alignment_problem(source: np.ndarray, target: np.ndarray, found: RigidAlignment) -> str | None:
    """Explain why a rigid alignment of points (n, 3) to others is meaningless; None where it is not."""
    source_extent, target_extent = extent(source), extent(target)
    # surfaces farther apart than a fortieth of the smaller one do not lie on each other
    if found.inliers >= LEAST and found.rms <= 0.025 * min(source_extent, target_extent):
        return None
    off = f"the surfaces are {1000 * found.rms:.0f} mm apart" if found.inliers >= LEAST else "the surfaces do not meet"
    return f"{off}; " + (unit_problem(source_extent, target_extent, "the source is", 0.05) or
                         "a start far from the target, which needs landmarks, or something else?")
