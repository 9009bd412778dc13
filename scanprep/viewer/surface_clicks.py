"""Find what a click on the screen hits, on the full surface of the file, however much of it is drawn."""
from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..geometry.mesh import Mesh
from ..geometry.places import spacing
from ..geometry.surface import Rays, Surface

# Share of a body's size that a ray is inside, from which on a joint may be there. At the true joints of 37 public
# figures, seen from the front, the thinnest wrist has 0.014 and the thinnest elbow 0.026; cloth of 5 mm has 0.003.
THICK = 0.01
MOST_CROSSINGS = 200                 # a ray through a tree of hair: what is behind is not looked at


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
        crossing = self._crossing(origin, direction)
        return None if crossing is None else crossing[0]

    def _crossing(self, origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, bool] | None:
        """Find the point (3,) where a ray, with a unit direction, first meets a triangle, and whether from outside."""
        face, _ = self._rays.cast(origin[None], direction[None])
        if face[0] < 0:
            return None
        # intersect the ray with the plane of the triangle that it hits
        assert isinstance(self.shape, Mesh)
        a, b, c = self.shape.corners[int(face[0])]
        normal = np.cross(b - a, c - a)
        slope = float(normal @ direction)
        return origin + direction * (normal @ (a - origin)) / slope, slope < 0

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

    def interval(self, origin: np.ndarray, direction: np.ndarray) -> np.ndarray | None:
        """Find where a ray enters and leaves the body (2, 3): its first stretch inside that a joint has room in.

        Shells within the body, as teeth and clothes have, do not divide it. Stretches thinner than THICK are passed; if
        all are, the thickest counts. None where the ray misses the body, or meets no back of it.

        Examples
        --------
        >>> import trimesh
        >>> box = trimesh.creation.box((1, 1, 0.2))
        >>> Clickable(Mesh(box.vertices, box.faces)).interval([0.1, 0.2, 1], [0, 0, -1])[:, 2]
        array([ 0.1, -0.1])

        [Statues]
        """
        if not self.has_surface:
            return None
        origin, direction = (np.asarray(v, dtype=float) for v in (origin, direction))
        direction = direction / np.linalg.norm(direction)
        size = float(np.ptp(self.points, axis=0).max())
        depth = 0
        points: list[np.ndarray] = []
        depths: list[int] = []
        while len(points) < MOST_CROSSINGS and (crossing := self._crossing(origin, direction)) is not None:
            depth += 1 if crossing[1] else -1
            points.append(crossing[0])
            depths.append(depth)
            # start a millionth of the size behind a crossing, so that it is not found again
            origin = crossing[0] + 1e-6 * size * direction
        # inside is where entries and exits do not cancel, which holds for a body turned inside out too
        inside = np.array([False, *(np.array(depths[:-1]) != 0), False])
        starts, ends = np.flatnonzero(inside[1:] & ~inside[:-1]), np.flatnonzero(inside[:-1] & ~inside[1:])
        if not len(starts):
            return None
        stretches = np.array(points)[np.stack([starts, ends], axis=1)]
        thickness = np.linalg.norm(stretches[:, 1] - stretches[:, 0], axis=1)
        return stretches[int(np.argmax(np.minimum(thickness, THICK * size)))]

    def middle(self, origin: np.ndarray, direction: np.ndarray) -> np.ndarray | None:
        """Find the middle (3,) between where a ray enters the body and where it leaves: inside, like joints."""
        stretch = self.interval(origin, direction)
        return None if stretch is None else stretch.mean(axis=0)

    def nearest(self, point: np.ndarray) -> np.ndarray:
        """Find the place on the surface, or the point, nearest to a point (3,)."""
        point = np.asarray(point, dtype=float)
        if self.has_surface:
            return self._surface.closest(point[None]).points[0]
        return self.points[int(np.linalg.norm(self.points - point, axis=1).argmin())].copy()
