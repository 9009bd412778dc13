"""The discrete medial axis of a body: how deep a joint lies behind a click."""
from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import checked_surface

INSIDE = 0.5                     # winding number; around a hole it falls smoothly from 1 to 0
MOST = 60_000_000                # voxels that are still worked on


class MedialAxis:
    """Voxels inside a mesh, thinned to their medial axis.

    The winding number tells inside from outside although a scan has holes. Thinning leaves curves along limbs and
    trunk, which serve as a guide only: a joint does not have to lie on them.

    Parameters
    ----------
    mesh : Mesh
        Roughly closed, seen from outside.
    voxel : float, metres
        Width of a voxel.

    Attributes
    ----------
    points : (n, 3) float, metres
        Centres of the voxels of the medial axis.

    Raises
    ------
    ValueError
        A mesh without triangles, or without an inside of the width of a voxel; far too small voxels.

    [Statues]
    """

    def __init__(self, mesh: Mesh, voxel: float = 0.01) -> None:
        import igl
        from skimage.morphology import skeletonize

        vertices, faces = checked_surface(mesh)
        if not voxel > 0:
            raise ValueError(f"voxel: expected a width above 0, got {voxel}")
        self.voxel = float(voxel)
        self._origin = vertices.min(axis=0) - 1.5 * voxel
        shape = np.ceil(np.ptp(vertices, axis=0) / voxel) + 4
        if np.prod(shape) > MOST:
            raise ValueError(f"voxel: {voxel} m gives {np.prod(shape):.3g} voxels, at most {MOST:.0e} are worked "
                             "on; is the mesh in metres?")
        cells = np.indices(shape.astype(int)).reshape(3, -1).T
        winding = igl.fast_winding_number(vertices, faces, self._origin + voxel * (cells + 0.5))
        self.inside = (np.asarray(winding) > INSIDE).reshape(shape.astype(int))
        self.points = self._origin + voxel * (np.argwhere(skeletonize(self.inside, method="lee")) + 0.5)
        if not len(self.points):
            raise ValueError(f"mesh: no voxel of {voxel} m is inside; is it open, inside out, or in another unit?")
        self._tree = cKDTree(self.points)

    def nearest_to_ray(self, origin: np.ndarray, direction: np.ndarray, depth: float | None = None) -> np.ndarray:
        """The point on a ray that is nearest to the medial axis, where the ray first passes through the body.

        Parameters
        ----------
        origin, direction : (3,) float
            Of the view through the click.
        depth : float, metres, optional
            Moves the point farther along the ray.

        Returns
        -------
        (3,) float, metres

        Raises
        ------
        ValueError
            A ray that misses the body; a direction without length.
        """
        origin, along = np.asarray(origin, dtype=np.float64), np.asarray(direction, dtype=np.float64)
        if not (np.isfinite(origin).all() and np.isfinite(along).all() and np.linalg.norm(along) > 0):
            raise ValueError(f"origin, direction: expected finite numbers and a length, got {origin} and {along}")
        along = along / np.linalg.norm(along)
        t = self._stretch(origin, along)
        apart, nearest = self._tree.query(origin + t[:, None] * along)
        point = self.points[nearest[apart.argmin()]]
        t_point = np.clip((point - origin) @ along, t[0], t[-1])
        return np.asarray(origin + (t_point + (depth or 0.0)) * along)

    def _stretch(self, origin: np.ndarray, along: np.ndarray) -> np.ndarray:
        """Distances along a ray, a quarter of a voxel apart, at which it first is inside the body."""
        shape = np.array(self.inside.shape)
        middle = self._origin + 0.5 * self.voxel * shape
        radius = 0.5 * self.voxel * float(np.linalg.norm(shape))
        t = np.arange(max((middle - origin) @ along - radius, 0), (middle - origin) @ along + radius, 0.25 * self.voxel)
        cells = np.floor((origin + t[:, None] * along - self._origin) / self.voxel).astype(int)
        held = ((cells >= 0) & (cells < shape)).all(axis=1)
        held[held] = self.inside[tuple(cells[held].T)]
        if not held.any():
            raise ValueError("origin, direction: the ray does not meet the body")
        first = int(held.argmax())
        last = first + int(np.append(~held[first:], True).argmax())
        return np.asarray(t[first:last])
