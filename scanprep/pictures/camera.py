"""Cameras of pictures, also for bodies whose up and front are not known."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from ..geometry.format_glb import tallest
from ..geometry.mesh import Mesh
from ..geometry.target import spread_normals


@dataclass(frozen=True, eq=False)
class Camera:
    """A view of the scene; the picture is scaled so that `width` × `height` metres fit into it."""

    target: np.ndarray  # (3,) float, metres: point in the middle of the picture
    axes: np.ndarray  # (3, 3) float: rows: right, up and back (towards the camera), unit and perpendicular
    vertical: np.ndarray  # (3,) float: unit vector that points away from the ground
    width: float  # metres: visible extent at the target
    height: float  # metres: visible extent at the target
    distance: float  # metres: from the camera to the target

    @classmethod
    def around(cls, subject: Any, azimuth: float = 0.0, elevation: float = 8.0,
               up: int = 2, margin: float = 1.06) -> Camera:
        """Make a camera that sees the whole subject: meshes, solids, or points (n, 3); two points are corners of a box.

        Parameters
        ----------
        subject : Mesh, Solid, (n, 3) float in metres, or sequence of these
            What has to fit into the picture.
        azimuth : float, degrees
            Counter-clockwise about the axis `up`: from the +x side when z is up, from the +z side when y is up.
        elevation : float, degrees
            Height of the camera above the horizontal.
        up : 0, 1 or 2
            Axis that points up.
        margin : float
            Extent of the picture over that of the subject.

        Returns
        -------
        Camera
        """
        a = np.radians(azimuth)
        vertical, first, second = np.eye(3)[[up, (up + 1) % 3, (up + 2) % 3]]
        return cls.from_side(subject, np.cos(a) * first + np.sin(a) * second, vertical, elevation, margin)

    @classmethod
    def from_side(cls, subject: Any, side: np.ndarray, vertical: np.ndarray, elevation: float = 8.0,
                  margin: float = 1.06) -> Camera:
        """Make a camera as `around`, seen from the direction `side` (3,), with the unit vector `vertical` (3,) up."""
        lens = 6.0  # distance of the camera in sizes of the subject: little perspective, as of a long lens
        points, e = _points(subject), np.radians(elevation)
        middle = (points.min(axis=0) + points.max(axis=0)) / 2
        flat = side - (side @ vertical) * vertical
        flat = flat / np.linalg.norm(flat)
        # axes of the camera: the side without its vertical part, raised by the elevation
        back, right = np.cos(e) * flat + np.sin(e) * vertical, np.cross(vertical, flat)
        axes = np.stack([right, np.cross(back, right), back])
        size = max(float(np.linalg.norm(points.max(axis=0) - points.min(axis=0))), 1e-9)
        x, y, depth = ((points - middle) @ axes.T).T
        # perspective enlarges what is nearer; then centre the picture on what is visible
        nearer = lens * size / (lens * size - depth)
        x, y = x * nearer, y * nearer
        centre = middle + axes[0] * (x.min() + x.max()) / 2 + axes[1] * (y.min() + y.max()) / 2
        return cls(centre, axes, vertical, margin * max(float(np.ptp(x)), 1e-3 * size),
                   margin * max(float(np.ptp(y)), 1e-3 * size), lens * size)

    @property
    def position(self) -> np.ndarray:
        """(3,) float, metres: where the camera is."""
        return self.target + self.distance * self.axes[2]

    def rays(self, width: int, height: int, samples: int = 1) -> tuple[np.ndarray, np.ndarray]:
        """Compute origins, relative to the target, and unit directions of the rays of a picture, row by row.

        Both are (height·samples · width·samples, 3) float32.
        """
        # points on the plane through the target, one per sample
        pixel = max(self.width / width, self.height / height) / samples
        across = (np.arange(width * samples) + 0.5 - width * samples / 2) * pixel
        down = (height * samples / 2 - np.arange(height * samples) - 0.5) * pixel
        right, up, back = self.axes.astype(np.float32)
        on_plane = (down.astype(np.float32)[:, None, None] * up + across.astype(np.float32)[:, None] * right)
        directions = on_plane.reshape(-1, 3) - np.float32(self.distance) * back
        directions /= np.sqrt(np.einsum("nd,nd->n", directions, directions))[:, None]
        return np.broadcast_to(np.float32(self.distance) * back, directions.shape), directions

    def project(self, points: np.ndarray, width: int, height: int) -> np.ndarray:
        """Project points (n, 3) into a picture: (n, 2) column and row in pixels."""
        x, y, depth = ((np.asarray(points) - self.target) @ self.axes.T).T
        nearer = self.distance / (self.distance - depth)
        pixel = max(self.width / width, self.height / height)
        return np.stack([width / 2 + x * nearer / pixel, height / 2 - y * nearer / pixel], axis=1)


def _points(subject: Any) -> np.ndarray:
    """Return the points (n, 3) of a subject, finite ones only; two points become the corners of their box."""
    subject = getattr(subject, "mesh", subject)
    if isinstance(subject, Mesh):
        return subject.vertices
    if isinstance(subject, np.ndarray):
        points = np.asarray(subject, dtype=float).reshape(-1, 3)
        points = points[np.isfinite(points).all(axis=1)]
        if len(points) == 2:
            points = np.stack([corner.ravel() for corner in np.meshgrid(*points.T)], axis=1)
    else:
        points = np.concatenate([_points(one) for one in subject])
    if not len(points):
        raise ValueError("subject: expected a mesh or points to look at, found none")
    return points


def guess_upright(mesh: Mesh) -> tuple[int, float]:
    """Guess the axis that is up, and the azimuth, degrees, of a camera that sees the front; for pictures only.

    Up is what the mesh says, as the template of a model (`find_up`), else the axis of the largest extent, unless arms
    are spread wider (`tallest`). The front of a one-sided scan is the side that was seen (`outer_side`), else where the
    toes point. On each foot that is the direction from what lies within a tenth of the height to the lowest twentieth.
    Of 71 poses of a man it is off by more than 60 degrees in 8. Without feet it is the side from which the body is
    widest.
    """
    extent = np.ptp(mesh.vertices, axis=0)
    up = tallest(mesh.vertices) if mesh.up is None else mesh.up
    if extent[up] == 0:                                                     # a single point has no front
        return up, 0.0
    height = (mesh.vertices[:, up] - mesh.vertices[:, up].min()) / extent[up]
    flat = mesh.vertices[:, [(up + 1) % 3, (up + 2) % 3]]
    # the horizontal direction in which the body is thinnest; its sign is arbitrary
    weights = mesh.vertex_areas if len(mesh.faces) and mesh.face_areas.any() else np.ones(len(flat))
    _, directions = np.linalg.eigh(np.cov(flat.T, aweights=weights))
    forward, across = directions[:, 0], flat @ directions[:, 1]
    # feet point ahead: use them where they are clearly there
    low = height < 0.1
    left = across > np.average(across[low], weights=weights[low])
    toes = sum((_toes(flat[side], height[side], weights[side]) for side in (left, ~left)), np.zeros(2))
    if np.linalg.norm(toes) > 0.01 * extent[up]:
        forward = toes
    if (seen := outer_side(mesh, up)) is not None:
        forward = seen[[(up + 1) % 3, (up + 2) % 3]]
    return up, float(np.degrees(np.arctan2(forward[1], forward[0])))


def outer_side(mesh: Mesh, up: int) -> np.ndarray | None:
    """Find the horizontal direction (3,) from which a one-sided scan was seen; None for a body seen all around.

    Triangles face it. Points have no side: their normals come from their neighbours, and are turned to one of the two
    sides from which most face away. They diverge where this is the outside, as the body is rounder than hollow.
    """
    flat = np.arange(3) != up
    if len(mesh.faces):
        # mean normal: a ball seen from one side has a length of 0.5, from three quarters around 0.24
        mean = flat * (mesh.face_areas @ mesh.face_normals) / max(mesh.face_areas.sum(), 1e-12)
        length = float(np.linalg.norm(mean))
        return mean / length if length > 0.2 else None
    # 2000 points are 2 cm apart on a person, more than the noise of depth cameras; fewer than 500 may be markers
    points = mesh.vertices[np.random.default_rng(0).permutation(len(mesh.vertices))[:2000]]
    if len(points) < 500:
        return None
    near = cKDTree(points).query(points, 16)[1]
    normals = spread_normals(points[near])
    way = np.linalg.eigh((flat * normals).T @ (flat * normals))[1][:, -1]
    normals = np.where((normals @ way)[:, None] < 0, -normals, normals)
    step, change = points[near] - points[:, None], normals[near] - normals[:, None]
    length = np.linalg.norm(step, axis=2) * np.linalg.norm(change, axis=2)
    # cosine between the way to a neighbour and the change of the normal: of 21 half views at least 0.45, with 6 mm of
    # noise 0.35; of whole bodies below 0.06
    rounder = float(np.einsum("nkd,nkd->", step, change) / max(length.sum(), 1e-12))
    return np.sign(rounder) * way if abs(rounder) > 0.2 else None


def _toes(flat: np.ndarray, height: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Compute the vector from ankle to toes (2,), metres, of one foot; zero where there is none."""
    sole, ankle = height < 0.05, (height >= 0.05) & (height < 0.1)
    if not (sole.any() and ankle.any()):
        return np.zeros(2)
    lower, upper = (np.average(flat[part], axis=0, weights=weights[part]) for part in (sole, ankle))
    return lower - upper


def look_around(body: Mesh, poses: np.ndarray | None = None, turns: Sequence[float] = (0, 90, 180, 270),
                turned: np.ndarray | None = None, vertical: np.ndarray | None = None) -> list[Camera]:
    """Make cameras around a standing body: by default from its front, left, back and right.

    Parameters
    ----------
    body : Mesh
        The body at rest.
    poses : (..., 3) float, metres, optional
        Points that have to fit into the picture, if not the body's.
    turns : sequence of float, degrees
        Directions of the cameras from the front.
    turned : (..., 3, 3) float, optional
        Rotations of the body's root in the poses.
    vertical : (3,) float, optional
        What is up, where the rotations do not say: see `stance`.

    Returns
    -------
    list of Camera
    """
    vertical, ahead = stance(body, turned, vertical)
    subject = body.vertices if poses is None else np.asarray(poses, dtype=float).reshape(-1, 3)
    aside = np.cross(vertical, ahead)
    return [Camera.from_side(subject, np.cos(a) * ahead + np.sin(a) * aside, vertical) for a in np.radians(turns)]


def stance(body: Mesh, turned: np.ndarray | None = None, vertical: np.ndarray | None = None
           ) -> tuple[np.ndarray, np.ndarray]:
    """Find up, along an axis, and ahead of a standing body, as unit vectors (3,).

    `turned` (..., 3, 3) are rotations of its root. Up is the body's own axis unless these rotations, on average, lay it
    down: then it is the axis nearest to its head. For a single frame pass the `vertical` of the whole motion.
    """
    up, front = guess_upright(body)
    own, first, second = np.eye(3)[[up, (up + 1) % 3, (up + 2) % 3]]
    ahead = np.cos(np.radians(front)) * first + np.sin(np.radians(front)) * second
    turned = np.eye(3)[None] if turned is None else np.asarray(turned).reshape(-1, 3, 3)
    mean = turned.mean(axis=0)
    if vertical is None:
        now = mean @ own
        nearest = np.sign(now[np.abs(now).argmax()]) * np.eye(3)[np.abs(now).argmax()]
        # cosine of 53 degrees: a body that leans less is still upright
        vertical = own if now @ own > 0.6 else nearest
    # ahead: the mean front, else that of the first frame, else where the head points; horizontal part only
    ways = [way - (way @ vertical) * vertical for way in (mean @ ahead, turned[0] @ ahead, turned[0] @ own)]
    ahead = next(way for way in ways if np.linalg.norm(way) > 0.1)     # a full turn averages to nothing
    return vertical, ahead / np.linalg.norm(ahead)
