"""Vertices that ride on the triangles of another mesh."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .mesh import Mesh
from .surface import Surface


@dataclass(frozen=True, eq=False)
class SurfaceCarrier:
    """The vertices of one triangulation (the riders) carried by another (the ridden); made by `mount`.

    Each has a triangle of vertices `corners` (n, 3), a point with barycentric coordinates `bary` (n, 3) in it, and lies
    `off` (n, 3), metres in the axes of the triangle, from that point.
    """

    corners: np.ndarray
    bary: np.ndarray
    off: np.ndarray

    def positions(self, vertices: np.ndarray) -> np.ndarray:
        """Compute the carried points (..., n, 3) for vertices (..., N, 3), metres."""
        corners = vertices[..., self.corners, :]
        return self._between(corners) + np.einsum("...nij,nj->...ni", _frames(corners), self.off)

    def carry(self, riders: np.ndarray, ridden: np.ndarray, moved: np.ndarray) -> np.ndarray:
        """Compute where riders (n, 3) on vertices `ridden` (N, 3) come to lie when these move to `moved` (N, 3).

        Each rider keeps its triangle of the template, and its own distance from it.
        """
        before, after = ridden[self.corners], moved[self.corners]
        off = np.einsum("nji,nj->ni", _frames(before), riders - self._between(before))
        return self._between(after) + np.einsum("nij,nj->ni", _frames(after), off)

    def displacements(self, fields: np.ndarray) -> np.ndarray:
        """Interpolate small displacements (..., N, 3), metres, at the carried points: (..., n, 3)."""
        return self._between(fields[..., self.corners, :])

    def values(self, values: np.ndarray) -> np.ndarray:
        """Interpolate values (N, k) of the vertices at the carried points: (n, k)."""
        return np.einsum("nc,nck->nk", self.bary, values[self.corners])

    def _between(self, corners: np.ndarray) -> np.ndarray:
        return np.einsum("nc,...ncd->...nd", self.bary, corners)


def mount(ridden: Mesh, rider: Mesh) -> SurfaceCarrier:
    """Mount the vertices of one triangulation on the nearest triangles of another, both at rest."""
    on = Surface(ridden).closest(rider.vertices)
    corners = ridden.faces[on.faces]
    off = np.einsum("nji,nj->ni", _frames(ridden.vertices[corners]), rider.vertices - on.points)
    return SurfaceCarrier(corners, on.bary, off)


def _frames(corners: np.ndarray) -> np.ndarray:
    """Compute an orthonormal frame (..., 3, 3), in columns, of each triangle (..., 3, 3)."""
    first, second = corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :]
    normal = np.cross(first, second)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    first = first / np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(normal, first), normal], axis=-1)
