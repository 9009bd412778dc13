"""Clicked features: joint centres and surface points, and the depth of a joint behind a click."""
from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from scanprep.geometry.format_common import metres_of
from scanprep.geometry.landmarks import read_landmarks
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.storage import numbers, read_json, taking_apart
from scanprep.geometry.surface import check_surface

from ..control.model import ControlModel


def read_features(path: Path, control: ControlModel, scan: Mesh, unit: str | None = None,
                  scale: float = 1.0) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Read joint centres and surface points, metres, by the names of the control model's joints and landmarks.

    Any landmark file is read, in its `unit`. In JSON a joint may also be a click, `{"ray": [origin, direction],
    "depth": d}`: its centre is then on the ray, where that is nearest to the medial axis of the scan, and d farther.
    `scale` is by how much the scan is larger than in its file.
    """
    rays, places = _read_clicks(path, unit) if path.suffix == ".json" else ({}, {})
    if not rays:
        places = read_landmarks(path, scan.with_vertices(scan.vertices / scale), unit)
    known = {*control.skeleton.names, *control.landmarks}
    strange = [name for name in [*rays, *places] if name not in known]
    if strange:
        raise ValueError(f"{path}: the control model has no joint or landmark '{strange[0]}'; its joints are "
                         f"{', '.join(control.skeleton.names)}; its landmarks {', '.join(control.landmarks)}")
    places = {name: scale * place for name, place in places.items()}
    joints = {name: place for name, place in places.items() if name in control.skeleton.names}
    if rays:
        medial = MedialAxis(scan)
        for name, (origin, direction, depth) in rays.items():
            try:
                joints[name] = medial.nearest_to_ray(scale * origin, direction, scale * depth)
            except ValueError as error:
                raise ValueError(f"{path}: {name}: {error}") from None
    return joints, {name: place for name, place in places.items() if name in control.landmarks}


def _read_clicks(path: Path, unit: str | None) -> tuple[dict[str, tuple[np.ndarray, np.ndarray, float]],
                                                        dict[str, np.ndarray]]:
    """Read origin, direction and depth of the clicks in a file, and its plain points; nothing without clicks."""
    wanted = 'features {name: [x, y, z]} or {name: {"ray": [[x, y, z], [x, y, z]], "depth": d}}'
    tree, metre = read_json(path, wanted), metres_of(unit)
    with taking_apart(path, wanted):
        if not isinstance(tree, dict) or not any(isinstance(one, dict) and "ray" in one for one in tree.values()):
            return {}, {}
        rays, places = {}, {}
        for name, one in tree.items():
            if isinstance(one, dict) and "ray" in one:
                origin, direction = numbers({name: np.array(one["ray"], dtype=np.float64)}, name, 2, 3)
                rays[name] = (metre * origin, direction, metre * float(one.get("depth", 0.0)))
            else:
                places[name] = metre * numbers({name: np.array(one, dtype=np.float64)}, name, 3)
        return rays, places


class MedialAxis:
    """Voxels inside a mesh, thinned to their medial axis, whose `points` (n, 3) are the centres. [Statues]

    The winding number tells inside from outside although a scan has holes. Thinning leaves curves along limbs and
    trunk, where the paper's leaves surfaces; they serve as a guide only: a joint does not have to lie on them.
    """

    def __init__(self, mesh: Mesh, voxel: float = 0.01) -> None:
        import igl
        from skimage.morphology import skeletonize

        vertices, faces = check_surface(mesh)
        self.voxel = voxel
        self._origin = vertices.min(axis=0) - 1.5 * voxel
        shape = np.ceil(np.ptp(vertices, axis=0) / voxel) + 4
        if np.prod(shape) > 60_000_000:
            raise ValueError(f"voxel: {voxel} m gives {np.prod(shape):.3g} voxels, at most {60_000_000:.0e} are worked "
                             "on; is the mesh in metres?")
        cells = np.indices(shape.astype(int)).reshape(3, -1).T
        winding = igl.fast_winding_number(vertices, faces, self._origin + voxel * (cells + 0.5))
        # the winding number falls smoothly from 1 to 0 around a hole
        self.inside = (np.asarray(winding) > 0.5).reshape(shape.astype(int))
        self.points = self._origin + voxel * (np.argwhere(skeletonize(self.inside, method="lee")) + 0.5)
        if not len(self.points):
            raise ValueError(f"mesh: no voxel of {voxel} m is inside; is it open, inside out, or in another unit?")
        self._tree = cKDTree(self.points)

    def nearest_to_ray(self, origin: np.ndarray, direction: np.ndarray, depth: float = 0.0) -> np.ndarray:
        """Find the point (3,) of a ray nearest to the medial axis, where it first is in the body; `depth` farther."""
        if not np.linalg.norm(direction) > 0:
            raise ValueError(f"direction: expected a length, got {direction}")
        along = direction / np.linalg.norm(direction)
        t = self._stretch(origin, along)
        apart, nearest = self._tree.query(origin + t[:, None] * along)
        point = self.points[nearest[apart.argmin()]]
        t_point = np.clip((point - origin) @ along, t[0], t[-1])
        return np.asarray(origin + (t_point + depth) * along)

    def _stretch(self, origin: np.ndarray, along: np.ndarray) -> np.ndarray:
        """Sample the first stretch of a ray inside the body: distances a quarter of a voxel apart."""
        shape = np.array(self.inside.shape)
        middle = (self._origin + 0.5 * self.voxel * shape - origin) @ along
        radius = 0.5 * self.voxel * float(np.linalg.norm(shape))
        t = np.arange(max(middle - radius, 0), middle + radius, 0.25 * self.voxel)
        cells = np.floor((origin + t[:, None] * along - self._origin) / self.voxel).astype(int)
        held = ((cells >= 0) & (cells < shape)).all(axis=1)
        held[held] = self.inside[tuple(cells[held].T)]
        if not held.any():
            raise ValueError("origin, direction: the ray does not meet the body")
        first = int(held.argmax())
        last = first + int(np.append(~held[first:], True).argmax())
        return np.asarray(t[first:last])
