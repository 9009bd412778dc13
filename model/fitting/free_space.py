"""Violations of space: vertices in free space that a camera saw through, outside clothing, or inside another part.

Each kind gives, for vertices (n, 3), a `Violation`: how deep they are there, and the plane that they should reach.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation, distance_transform_edt, minimum_filter
from scipy.spatial import cKDTree

from scanprep.depth_camera.person import PicturedPerson
from scanprep.geometry.surface import OrientedPoints
from scanprep.skeleton.tree import Skeleton

from ..human_poses import is_person
from .normals import faces, facing_point
from .scan import ScanPoints

TOLERANCE = 0.03                     # metres: scanners lose the rim of a body, and the viewpoint is not exact
INSIDE, PRESSED = 0.12, 0.015        # metres: half the thickest part of a body; how deep skin may press into skin
CELL, MARGIN, CAP = 0.05, 0.3, 0.15   # metres: cell and margin of the table of free space, and its largest value
CLOTHING, NOISE = 0.10, 0.003        # metres: how far hair or a skirt stands off the skin; noise of the scan


class Violation(NamedTuple):
    """Of n vertices: `excess` (n,), metres beyond what is allowed, and the plane to reach, `normal` and `target`."""

    excess: np.ndarray
    normal: np.ndarray
    target: np.ndarray


@dataclass(frozen=True, eq=False)
class CameraView:
    """A scan as one camera saw it: nothing stands beside or in front of what it saw."""

    viewpoint: np.ndarray            # (3,), metres
    points: np.ndarray               # (n, 3), metres

    @cached_property
    def _rays(self) -> tuple[np.ndarray, np.ndarray, cKDTree]:
        depth = np.linalg.norm(self.points - self.viewpoint, axis=1)
        direction = (self.points - self.viewpoint) / depth[:, None]
        return depth, direction, cKDTree(direction)

    def violation(self, vertices: np.ndarray) -> Violation:
        """Compute how far vertices (n, 3) are beside what the camera saw, or in front of it."""
        # the nearest rays, distance from the nearest one (beside), and how far in front of the surface there (ahead)
        depth, direction, tree = self._rays
        away = vertices - self.viewpoint
        far = np.linalg.norm(away, axis=1)
        chord, near = tree.query(away / far[:, None], 6)
        along = np.einsum("nd,nd->n", away, direction[near[:, 0]])
        beside = away - along[:, None] * direction[near[:, 0]]
        wide = np.linalg.norm(beside, axis=1)
        front = np.where(chord * far[:, None] < TOLERANCE, depth[near], np.inf).min(axis=1)
        ahead = np.where(np.isfinite(front), front - far, 0.0)
        # the shorter way out: sideways to the ray, or backwards along it
        outside = wide > np.maximum(TOLERANCE, ahead)
        normal = np.where(outside[:, None], beside / np.maximum(wide, 1e-12)[:, None], -away / far[:, None])
        excess = np.maximum(np.where(outside, wide, ahead) - TOLERANCE, 0)
        return Violation(excess, normal, vertices - excess[:, None] * normal)


class PictureView:
    """A person in a depth picture: nothing is in front of what was measured; beyond the border nothing is known."""

    def __init__(self, person: PicturedPerson) -> None:
        self.picture = person.picture
        self.points, self.viewpoint = person.picture.points()[person.mask], np.zeros(3)
        known = np.isfinite(person.picture.depth)
        # depth cameras lose about two pixels at the edge of a body: these are not counted as empty
        self._empty = known & ~binary_dilation(person.mask, np.ones((3, 3)), 2)
        measured = person.mask | self._empty
        nearest = minimum_filter(np.where(measured, person.picture.depth, np.inf), 3)     # an edge is good to a pixel
        self._depth = np.where(measured, nearest, 0.0)
        self._way, self._edge = distance_transform_edt(self._empty, return_indices=True)

    def violation(self, vertices: np.ndarray) -> Violation:
        """Compute how far vertices (n, 3) are beside the person, or in front of what was seen."""
        row, column, inside = self.picture.project(vertices)
        z = vertices[:, 2]
        ahead = np.where(inside, self._depth[row, column] - z, 0.0)
        far = np.maximum(np.linalg.norm(vertices, axis=1), 1e-9)
        target = self.picture.directions(self._edge[1][row, column], self._edge[0][row, column]) * z[:, None]
        beside = vertices - target
        wide = np.linalg.norm(beside, axis=1)
        outside = self._empty[row, column] & (wide < ahead)
        normal = np.where(outside[:, None], beside / np.maximum(wide, 1e-12)[:, None], -vertices / far[:, None])
        excess = np.maximum(np.where(outside, wide, ahead) - TOLERANCE, 0)
        return Violation(excess, normal, vertices - excess[:, None] * normal)


def free_space_violation(cameras: Sequence[CameraView | PictureView], vertices: np.ndarray) -> Violation:
    """Compute the largest free-space violation over cameras, at least one, for each of the vertices (n, 3)."""
    by_camera = [camera.violation(vertices) for camera in cameras]
    if len(by_camera) == 1:
        return by_camera[0]
    worst, each = np.argmax([one.excess for one in by_camera], axis=0), np.arange(len(vertices))
    return Violation(*(np.stack(part)[worst, each] for part in zip(*by_camera, strict=True)))


class Outside:
    """A table of free-space violations over the space around a scan, for at least one camera."""

    def __init__(self, cameras: Sequence[CameraView | PictureView]) -> None:
        points = np.concatenate([camera.points for camera in cameras])
        self.low = points.min(axis=0) - MARGIN
        self.count = np.ceil((points.max(axis=0) + MARGIN - self.low) / CELL).astype(np.int64)
        grid = np.stack(np.meshgrid(*[np.arange(n) for n in self.count], indexing="ij"), axis=-1).reshape(-1, 3)
        excess = free_space_violation(cameras, self.low + CELL * (grid + 0.5)).excess
        self.excess = np.minimum(excess, CAP).astype(np.float32)

    def at(self, places: np.ndarray) -> np.ndarray:
        """Look up violations (...), metres, of points (..., 3); beyond the table the value at its edge."""
        cell = ((places - self.low.astype(places.dtype)) / CELL).astype(np.int32)
        x, y, z = (np.clip(cell[..., axis], 0, count - 1) for axis, count in enumerate(self.count.tolist()))
        return self.excess[(x * int(self.count[1]) + y) * int(self.count[2]) + z]


def find_cameras(cloud: ScanPoints) -> tuple[CameraView | PictureView, ...]:
    """Find the cameras of the views that have a viewpoint, given or estimated; masked points were seen too."""
    if cloud.person is not None:
        return (PictureView(cloud.person),)
    seen = cloud.everything
    views = [seen.some(seen.view == number) for number in range(cloud.views)]
    places: Sequence[np.ndarray | None] = len(views) * (None,) if cloud.viewpoints is None else list(cloud.viewpoints)
    cameras = [find_camera(view, place) for view, place in zip(views, places, strict=True) if len(view.points)]
    return tuple(camera for camera in cameras if camera is not None)


def find_camera(cloud: ScanPoints, viewpoint: np.ndarray | None = None) -> CameraView | None:
    """Find the camera of a scan; None where no single viewpoint faces nearly all of it.

    An unknown viewpoint is estimated as the one from which the fewest normals turn away. Its direction is good to a few
    degrees; its distance is not reliable.
    """
    if viewpoint is None:
        viewpoint = facing_point(cloud.points, cloud.normals)
    facing = faces(viewpoint, cloud.points, cloud.normals)
    # 97% of the points must face the viewpoint; normals are never all right
    return CameraView(np.asarray(viewpoint, dtype=np.float64), cloud.points) if facing.mean() >= 0.97 else None


class Contact:
    """Self-contact of vertices, given the part (n,) of each: no part may enter another that is not its neighbour.

    `places` and `normals` (n, 3) are those at rest. Vertices that seem to be inside another part even there say
    nothing, as bones of a finger with a short one between. On a person those are the insides of thighs, which do press
    on each other.
    """

    def __init__(self, skeleton: Skeleton, part: np.ndarray, places: np.ndarray, normals: np.ndarray) -> None:
        apart = ~np.eye(len(skeleton.parents), dtype=bool)
        child = np.arange(1, len(skeleton.parents))
        apart[child, skeleton.parents[child]] = apart[skeleton.parents[child], child] = False
        self._order = np.argsort(part, kind="stable")
        used, self._starts = np.unique(part[self._order], return_index=True)
        self._mine, self._apart = np.split(self._order, self._starts[1:]), apart[np.ix_(used, used)]
        self._silent = np.zeros(len(part), dtype=bool)
        if not is_person(skeleton):
            self._silent = self.violation(places, normals).excess > 0

    def violation(self, places: np.ndarray, normals: np.ndarray) -> Violation:
        """Compute how deep vertices (n, 3) with normals (n, 3) are inside another part."""
        # only parts whose bounding boxes come near each other are compared
        depth, way = np.zeros(len(places)), np.zeros_like(places)
        low, high = (of.reduceat(places[self._order], self._starts) for of in (np.minimum, np.maximum))
        near = self._apart & (low[:, None] < high + INSIDE).all(axis=2) & (high[:, None] > low - INSIDE).all(axis=2)
        for p in np.flatnonzero(near.any(axis=1)):
            own, others = self._mine[p], np.concatenate([self._mine[q] for q in np.flatnonzero(near[p])])
            there = places[others]
            others = others[((there > low[p] - INSIDE) & (there < high[p] + INSIDE)).all(axis=1)]
            if not len(others):
                continue
            far, hit = cKDTree(places[others]).query(places[own], distance_upper_bound=INSIDE)
            close = np.isfinite(far) & ~self._silent[own]
            own, hit = own[close], others[hit[close]]
            # depth behind the tangent plane of the nearest vertex of the other parts
            inside = np.einsum("nd,nd->n", normals[hit], places[hit] - places[own]) - PRESSED
            depth[own], way[own] = np.maximum(inside, 0), normals[hit]
        return Violation(depth, way, places + depth[:, None] * way)


class Clothing:
    """Points of clothing and hair, which enclose the body.

    They say nothing more: with skin drawn to them even weakly, waists under coats were 20 and 38 cm too wide. Without,
    the body inside is as people are who have such hands, heads and whatever else is seen.
    """

    def __init__(self, scan: ScanPoints) -> None:
        self.scan = scan
        self._near = OrientedPoints(scan.points, scan.normals)

    def violation(self, places: np.ndarray, normals: np.ndarray) -> Violation:
        """Compute how far vertices (n, 3) with normals (n, 3) stick out; zero inside and where there is no clothing."""
        found = self._near.match(places, normals, CLOTHING, 0.3)
        normal = self.scan.normals[found.index]
        off = places - self.scan.points[found.index]
        out = np.einsum("nd,nd->n", off, normal)
        beside = np.sqrt(np.maximum((off**2).sum(axis=1) - out**2, 0))
        over = found.valid & (beside < 2 * self.scan.spacing + 0.3 * np.abs(out))
        depth = np.where(over, np.maximum(out - NOISE, 0), 0.0)
        return Violation(depth, normal, places - depth[:, None] * normal)
