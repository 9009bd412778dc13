"""Find what a click on the screen hits, on the full surface of the file, however much of it is drawn."""
from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..geometry.mesh import Mesh
from ..geometry.places import spacing
from ..geometry.surface import Rays, Surface


@dataclass(frozen=True, eq=False)
class Clickable:
    """A mesh, or points (n, 3), metres, that rays are cast at."""

    shape: Mesh | np.ndarray

    @property
    def points(self) -> np.ndarray:
        """(n, 3) float, metres: vertices, or the points."""
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
        """Return whether there are triangles; a point cloud is clicked point by point."""
        return isinstance(self.shape, Mesh) and len(self.shape.faces) > 0

    def hit(self, origin: np.ndarray, direction: np.ndarray) -> np.ndarray | None:
        """Find where a ray first meets the surface (3,), metres; None where it misses.

        The triangle is found in single precision, the place on it in double.
        """
        origin, direction = (np.asarray(v, dtype=float) for v in (origin, direction))
        direction = direction / np.linalg.norm(direction)
        if not self.has_surface:
            return self._point_along(origin, direction)
        face, _ = self._rays.cast(origin[None], direction[None])
        if face[0] < 0:
            return None
        # intersect the ray with the plane of the triangle that it hits
        assert isinstance(self.shape, Mesh)
        a, b, c = self.shape.corners[int(face[0])]
        normal = np.cross(b - a, c - a)
        return origin + direction * (normal @ (a - origin)) / (normal @ direction)

    def _point_along(self, origin: np.ndarray, direction: np.ndarray) -> np.ndarray | None:
        """Find the point that a ray passes closest to, among those in front; None where it misses all."""
        along = (self.points - origin) @ direction
        aside = np.linalg.norm(self.points - origin - along[:, None] * direction, axis=1)
        # within 4 spacings of the ray a click hits; points up to 8 spacings behind the first one count as the same side
        near = np.flatnonzero((aside < 4.0 * self._spacing) & (along > 0))
        if not len(near):
            return None
        front = near[along[near] < along[near].min() + 8.0 * self._spacing]
        return self.points[front[aside[front].argmin()]].copy()

    def middle(self, origin: np.ndarray, direction: np.ndarray) -> np.ndarray | None:
        """Find the middle between where a ray enters the body and where it leaves: inside, like joints."""
        first = self.hit(origin, direction)
        if first is None or not self.has_surface:
            return None
        direction = np.asarray(direction, dtype=float) / np.linalg.norm(direction)
        size = float(np.ptp(self.points, axis=0).max())
        # start a millionth of the size behind the first hit, so that it is not found again
        last = self.hit(first + 1e-6 * size * direction, direction)
        return None if last is None else (first + last) / 2

    def nearest(self, point: np.ndarray) -> np.ndarray:
        """Find the place on the surface, or the point, nearest to a point (3,)."""
        point = np.asarray(point, dtype=float)
        if self.has_surface:
            return self._surface.closest(point[None]).points[0]
        return self.points[int(np.linalg.norm(self.points - point, axis=1).argmin())].copy()
