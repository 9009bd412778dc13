"""What cameras must have seen is evidence too: nothing stands beside or in front of what one of them saw."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from .scan import ScanPoints, spread

GRAZING = 0.3                        # cosine below which a scanner sees little
FEW = 2000                           # points that are enough to find the viewpoint


@dataclass(frozen=True, eq=False)
class Sight:
    """A scan as one camera saw it."""

    viewpoint: np.ndarray   # (3,), metres
    points: np.ndarray      # (n, 3), metres

    @cached_property
    def _rays(self) -> tuple[np.ndarray, np.ndarray, cKDTree]:
        depth = np.linalg.norm(self.points - self.viewpoint, axis=1)
        direction = (self.points - self.viewpoint) / depth[:, None]
        return depth, direction, cKDTree(direction)

    def trespass(self, vertices: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """How far vertices stand where the camera saw nothing, or in front of what it saw.

        `vertices` (n, 3), metres; `tolerance` metres.
        Returns (n,), metres, beyond the tolerance; zero where there is nothing to object to; (n, 3), the way out,
        from the vertex's side: the normal of the plane it should reach; (n, 3), metres, a point of that plane.
        """
        depth, direction, tree = self._rays
        away = vertices - self.viewpoint
        far = np.linalg.norm(away, axis=1)
        chord, near = tree.query(away / far[:, None], 6)
        along = np.einsum("nd,nd->n", away, direction[near[:, 0]])
        beside = away - along[:, None] * direction[near[:, 0]]
        wide = np.linalg.norm(beside, axis=1)
        front = np.where(chord * far[:, None] < tolerance, depth[near], np.inf).min(axis=1)
        ahead = np.where(np.isfinite(front), front - far, 0.0)
        outside = wide > np.maximum(tolerance, ahead)
        normal = np.where(outside[:, None], beside / np.maximum(wide, 1e-12)[:, None], -away / far[:, None])
        excess = np.maximum(np.where(outside, wide, ahead) - tolerance, 0)
        return excess, normal, vertices - excess[:, None] * normal


@dataclass(frozen=True, eq=False)
class Sights:
    """A scan as several cameras saw it."""

    cameras: tuple[Sight, ...]  # Sight of each view whose viewpoint is known

    @property
    def points(self) -> np.ndarray:
        """(n, 3) what all of them saw, metres."""
        return np.concatenate([camera.points for camera in self.cameras])

    def trespass(self, vertices: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As `Sight.trespass`: what one camera denies is denied, by the one that objects most."""
        found = [camera.trespass(vertices, tolerance) for camera in self.cameras]
        worst = np.argmax([excess for excess, _, _ in found], axis=0)
        each = np.arange(len(vertices))
        excess, normal, target = (np.stack(part)[worst, each] for part in zip(*found, strict=True))
        return excess, normal, target


def find_sights(cloud: ScanPoints) -> Sight | Sights | None:
    """What the camera saw, or those of all views, or None when no view has a viewpoint.

    What is masked was seen too.
    """
    seen = cloud.everything
    views = [seen.some(seen.view == number) for number in range(cloud.views)]
    given: Sequence[np.ndarray | None] = len(views) * (None,) if cloud.viewpoints is None else list(cloud.viewpoints)
    found = [find_sight(view, place) for view, place in zip(views, given, strict=True) if len(view.points)]
    cameras = tuple(sight for sight in found if sight is not None)
    return None if not cameras else cameras[0] if len(cameras) == 1 else Sights(cameras)


def find_sight(cloud: ScanPoints, viewpoint: np.ndarray | None = None, share: float = 0.97) -> Sight | None:
    """The camera of a scan, or None when no single viewpoint faces nearly all of it.

    `viewpoint` (3,), metres.
    """
    if viewpoint is None:
        viewpoint = _facing_point(cloud)
    to = viewpoint - cloud.points
    facing = np.einsum("nd,nd->n", to, cloud.normals) > 0.05 * np.linalg.norm(to, axis=1)
    return Sight(np.asarray(viewpoint, dtype=np.float64), cloud.points) if facing.mean() >= share else None


def _facing_point(cloud: ScanPoints) -> np.ndarray:
    keep = spread(cloud.points, FEW) if len(cloud.points) > FEW else slice(None)
    normals, centre = cloud.normals[keep], cloud.points[keep].mean(axis=0)
    points = cloud.points[keep] - centre
    size = np.linalg.norm(points, axis=1).max()

    def turned_away(q: np.ndarray) -> float:
        to = q[:3] / np.linalg.norm(q[:3]) - q[3] * points / size
        cosine = np.einsum("nd,nd->n", normals, to) / np.linalg.norm(to, axis=1)
        return float(np.mean(np.clip(GRAZING - cosine, 0, 0.5)**2))   # some normals may have the wrong sign

    start = normals.mean(axis=0)
    found = minimize(turned_away, np.r_[start / max(np.linalg.norm(start), 1e-12), 0.3], method="Nelder-Mead",
                     options={"maxiter": 400, "xatol": 1e-3, "fatol": 1e-9}).x
    nearness = np.clip(found[3], 0.05, 0.7)
    return centre + size / nearness * found[:3] / np.linalg.norm(found[:3])
