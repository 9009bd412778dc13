"""Align range views with rough camera poses, all views at once."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..fusion.tsdf import border_distance
from ..geometry import rotations
from ..geometry.mesh import Mesh
from ..geometry.remeshing import smooth_taubin
from ..geometry.surface import OrientedPoints, mesh_and_camera
from ..ranges import Positive, Settings, Share
from .view_poses import fit_of_views, place_by_landmarks

ROUNDS = 60                   # of matching, at most: views that still move then are not trusted
BORDER = 0.02                 # metres: points nearer to the border of their view are not matched, as edges are noisy
CONFLICT = 0.03               # share of a view that others look through; with more, its pose is not trusted


@dataclass(frozen=True)
class AlignViewsConfig(Settings):
    """Settings of `align_views`.

    Attributes
    ----------
    reach : float, metres
        Largest distance of a match in the first round; later rounds allow three times the median distance.
    min_overlap : float
        Least share of a view that others also saw; with less, its pose is not trusted.
    """

    reach: Positive = 0.08
    min_overlap: Share = 0.15


@dataclass(frozen=True, eq=False)
class AlignedViews:
    """Views after `align_views`."""

    views: list[tuple[Mesh, np.ndarray]]     # moved surfaces and camera positions, ready for `merge_views`
    rms: float                               # metres, RMS point-to-plane distance of the matches at the end
    converged: bool
    overlap: np.ndarray                      # (V,) share of each view that others also saw
    conflict: np.ndarray                     # (V,) share that violates free space of others; 0 for a correct pose
    trusted: np.ndarray                      # (V,) converged, enough overlap, little conflict; else do not merge


def align_views(views: Sequence[Any], config: AlignViewsConfig | None = None,
                landmarks: Sequence[Mapping[str, np.ndarray]] | None = None) -> AlignedViews:
    """Refine rough camera poses by point-to-plane matching between all pairs of views together.

    `views` are RangeViews, or pairs of a Mesh and a camera position (3,), within a few centimetres and degrees of their
    true poses. Larger errors need `landmarks` to place them first: per view one mapping name -> (3,) point, each name
    in at least two views. ValueError for no views.
    """
    config, rng = config or AlignViewsConfig(), np.random.default_rng(0)
    pairs = [mesh_and_camera(view) for view in views]
    if not pairs:
        raise ValueError("views: expected at least one, got none")
    # rough poses first, where landmarks give them
    if landmarks is not None:
        start = place_by_landmarks(landmarks, len(pairs))
        pairs = [_move(pair, T) for pair, T in zip(pairs, start, strict=True)]
    # ICP over all pairs: match, solve for all motions together, tighten the reach
    samples = [_sample(mesh, rng) for mesh, _ in pairs]
    poses = np.tile(np.eye(4), (len(pairs), 1, 1))
    reach, rms, settled, rounds = config.reach, np.nan, len(pairs) == 1, 0
    while rounds < ROUNDS and not settled:
        placed = [(p @ T[:3, :3].T + T[:3, 3], n @ T[:3, :3].T)
                  for T, (p, n, _) in zip(poses, samples, strict=True)]
        matches = _match(placed, [inner for _, _, inner in samples], reach)
        if not matches:
            break
        steps, residual = _solve(placed, matches)
        moved = max(float(np.linalg.norm(p @ S[:3, :3].T + S[:3, 3] - p, axis=1).mean())
                    for S, (p, _) in zip(steps, placed, strict=True))
        poses = steps @ poses
        rms, settled, rounds = float(np.sqrt(np.mean(residual**2))), moved < 5e-5, rounds + 1
        distances = np.concatenate([d for *_, d in matches])
        # never below 5 mm, so that noise cannot end the matching
        reach = min(reach, max(3 * float(np.median(distances)), 0.005))
    out = [_move(pair, T) for pair, T in zip(pairs, poses, strict=True)]
    overlap, conflict = fit_of_views(out)
    trusted = settled & (overlap >= config.min_overlap) & (conflict <= CONFLICT) | (len(out) == 1)
    return AlignedViews(out, rms, settled, overlap, conflict, trusted)


def _move(view: tuple[Mesh, np.ndarray], T: np.ndarray) -> tuple[Mesh, np.ndarray]:
    """Move a view and its camera by a rigid transform (4, 4)."""
    mesh, camera = view
    return mesh.with_vertices(mesh.vertices @ T[:3, :3].T + T[:3, 3]), T[:3, :3] @ camera + T[:3, 3]


def _sample(mesh: Mesh, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw at most 16,000 points of a smoothed view, their normals, and which lie well inside its border."""
    even = smooth_taubin(mesh, 10)
    inner = border_distance(mesh, BORDER) >= BORDER
    chosen = rng.permutation(len(mesh.vertices))[:16_000]
    return even.vertices[chosen], even.vertex_normals[chosen], inner[chosen]


def _match(placed: list[tuple[np.ndarray, np.ndarray]], inner: list[np.ndarray], reach: float,
           ) -> list[tuple[int, int, np.ndarray, np.ndarray, np.ndarray]]:
    """Match every pair of views (i, j): points of i, their matches in j, distances; at least 30 matches per pair."""
    matches = []
    for j, (points, normals) in enumerate(placed):
        target = OrientedPoints(points, normals)
        for i, (source_points, source_normals) in enumerate(placed):
            if i == j:
                continue
            rows = np.flatnonzero(inner[i][:4000])         # 4,000 points are enough to match from
            match = target.match(source_points[rows], source_normals[rows], reach, 0.8)
            good = match.valid & inner[j][np.maximum(match.index, 0)]
            if good.sum() >= 30:
                matches.append((i, j, rows[good], match.index[good], match.distances[good]))
    return matches


def _solve(placed: list[tuple[np.ndarray, np.ndarray]],
           matches: list[tuple[int, int, np.ndarray, np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Solve for small motions (V, 4, 4) of all views but the first that minimise point-to-plane distances."""
    count = len(placed)
    A, b, residuals = np.zeros((6 * count, 6 * count)), np.zeros(6 * count), []
    centre = np.concatenate([p for p, _ in placed]).mean(axis=0)
    for i, j, rows, targets, _ in matches:
        x, y, n = placed[i][0][rows] - centre, placed[j][0][targets] - centre, placed[j][1][targets]
        # a match moves with both of its views: Jacobian J for view i, -J for view j
        residual = np.einsum("nd,nd->n", n, x - y)
        J = np.concatenate([np.cross(x, n), n], axis=1)
        JJ, Jr = J.T @ J, J.T @ residual
        a, c = slice(6 * i, 6 * i + 6), slice(6 * j, 6 * j + 6)
        A[a, a] += JJ
        A[c, c] += JJ
        A[a, c] -= JJ
        A[c, a] -= JJ
        b[a] -= Jr
        b[c] += Jr
        residuals.append(residual)
    A += 1e-6 * np.trace(A) / len(A) * np.eye(len(A))         # a view without matches stays
    step = np.zeros((count, 6))
    step[1:] = np.linalg.solve(A[6:, 6:], b[6:]).reshape(-1, 6)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = rotations.exp(step[:, :3])
    T[:, :3, 3] = step[:, 3:] + centre - np.einsum("vij,j->vi", T[:, :3, :3], centre)
    return T, np.concatenate(residuals)


def views_doubts(found: AlignedViews, names: Sequence[str]) -> list[str]:
    """Explain which aligned views, by name, need a look because their pose is uncertain."""
    return [f"the place of {name} is uncertain" for name, sure in zip(names, found.trusted, strict=True) if not sure]


def views_problem(found: AlignedViews) -> str | None:
    """Explain why aligned views are meaningless; None where some poses are trusted."""
    if found.trusted.any():
        return None
    return (f"no view is in its place, they share {100 * float(found.overlap.max()):.0f}% of their surface at most; "
            "the wrong cameras, another unit (--unit), or a start that is too far off (--landmarks)?")
