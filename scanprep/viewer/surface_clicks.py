"""What a click on the screen meets: found on the file's own surface, however much of it is drawn."""
from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..geometry.mesh import Mesh
from ..geometry.places import spacing
from ..geometry.surface import Rays, Surface


@dataclass(frozen=True, eq=False)
class Clickable:
    """A mesh, or points (n, 3), metres, that rays are sent to."""

    shape: Mesh | np.ndarray

    @property
    def points(self) -> np.ndarray:
        """(n, 3)"""
        return self.shape.vertices if isinstance(self.shape, Mesh) else self.shape

    @cached_property
    def _rays(self) -> Rays:
        assert isinstance(self.shape, Mesh)
        return Rays(self.shape)

    @cached_property
    def _surface(self) -> Surface:
        assert isinstance(self.shape, Mesh)
        return Surface(self.shape)

    @cached_property
    def _spacing(self) -> float:
        return spacing(self.points)

    @property
    def has_surface(self) -> bool:
        """Whether there are triangles; a cloud is clicked on point by point."""
        return isinstance(self.shape, Mesh) and len(self.shape.faces) > 0

    def hit(self, origin: np.ndarray, direction: np.ndarray) -> np.ndarray | None:
        """Where a ray meets the surface first (3,), metres; None where it passes it by.

        The triangle is found in single, the place on it in double precision.
        """
        origin, direction = (np.asarray(v, dtype=float) for v in (origin, direction))
        direction = direction / np.linalg.norm(direction)
        if not self.has_surface:
            return self._point_along(origin, direction)
        face, _ = self._rays.cast(origin[None], direction[None])
        return None if face[0] < 0 else self._on_plane(int(face[0]), origin, direction)

    def _on_plane(self, face: int, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
        assert isinstance(self.shape, Mesh)
        a, b, c = self.shape.corners[face]
        normal = np.cross(b - a, c - a)
        return origin + direction * (normal @ (a - origin)) / (normal @ direction)

    def _point_along(self, origin: np.ndarray, direction: np.ndarray) -> np.ndarray | None:
        along = (self.points - origin) @ direction
        aside = np.linalg.norm(self.points - origin - along[:, None] * direction, axis=1)
        # spacings of a cloud: from the ray to points, and along it
        near = np.flatnonzero((aside < 4.0 * self._spacing) & (along > 0))
        if not len(near):
            return None
        front = near[along[near] < along[near].min() + 8.0 * self._spacing]
        return self.points[front[aside[front].argmin()]].copy()

    def middle(self, origin: np.ndarray, direction: np.ndarray) -> np.ndarray | None:
        """The middle between where a ray enters the body and where it leaves it: inside, as joints are."""
        first = self.hit(origin, direction)
        if first is None or not self.has_surface:
            return None
        direction = np.asarray(direction, dtype=float) / np.linalg.norm(direction)
        size = float(np.ptp(self.points, axis=0).max())
        # of the size: so far behind a hit a ray goes on
        last = self.hit(first + 1e-6 * size * direction, direction)
        return None if last is None else (first + last) / 2

    def nearest(self, point: np.ndarray) -> np.ndarray:
        """The place on the surface, or the point, nearest to a point (3,)."""
        point = np.asarray(point, dtype=float)
        if self.has_surface:
            return self._surface.closest(point[None]).points[0]
        return self.points[int(np.linalg.norm(self.points - point, axis=1).argmin())].copy()
