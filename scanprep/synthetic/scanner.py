"""A virtual range scanner: views around a body, noise along the rays, dropout, and real holes."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..geometry.mesh import Mesh
from ..geometry.surface import Rays
from ..ranges import Cell, Count, Settings, Signed

GRAZING = 12.0                       # degrees between ray and surface: at smaller angles real scanners measure nothing
DROPOUT = 0.005                      # probability that a perpendicular ray is lost; it grows towards GRAZING


@dataclass(frozen=True)
class ScannerConfig(Settings):
    """Settings of the scanner.

    Attributes
    ----------
    views : int
        Cameras, evenly spaced around the vertical.
    height : float, metres
        Of the cameras above the middle of the body; every other one as far below it, but above the feet.
    azimuth : float, degrees
        Of the first camera, from the front (-y) towards the left (+x).
    resolution : float, metres
        Spacing of the rays at the middle of the body.
    noise : float, metres
        Standard deviation along the ray.
    blind_reach : float, metres
        How near two surfaces that face each other must be to hide each other: armpits, and between the legs.
    """

    views: Count = 4
    height: Signed = 1.2
    azimuth: Signed = 45.0
    resolution: Cell = 0.0059
    noise: float = 0.002
    blind_reach: float = 0.05


@dataclass(frozen=True, eq=False)
class RangeView:
    """What one camera saw."""

    mesh: Mesh  # the triangulated range image; its vertices are `points`
    normals: np.ndarray  # (n, 3) float: of the triangulated points, unit, outwards
    camera: np.ndarray  # (3,) float, metres
    T_world_camera: np.ndarray  # (4, 4) float: camera axes are right, down, ahead
    depth: np.ndarray  # (H, W) float, metres: distance along the optical axis, NaN where nothing was measured
    intrinsics: np.ndarray  # (3, 3) float, pixels

    @property
    def points(self) -> np.ndarray:
        """(n, 3) float, metres: the measured points."""
        return self.mesh.vertices

@dataclass(frozen=True, eq=False)
class Scan:
    """All views of one body."""

    views: tuple[RangeView, ...]  # of every camera
    merged: Mesh  # the triangles of all views side by side


def pixel_rays(shape: tuple[int, ...], intrinsics: np.ndarray, R_world_camera: np.ndarray) -> np.ndarray:
    """Compute unit directions (H, W, 3) through the pixels of an image, in the world."""
    v, u = np.meshgrid(np.arange(shape[0]), np.arange(shape[1]), indexing="ij")
    local = np.stack([(u - intrinsics[0, 2]) / intrinsics[0, 0], (v - intrinsics[1, 2]) / intrinsics[1, 1],
                      np.ones(shape)], axis=-1)
    world = local @ R_world_camera.T
    return world / np.linalg.norm(world, axis=-1, keepdims=True)


def scan(mesh: Mesh, config: ScannerConfig | None = None, rng: np.random.Generator | None = None) -> Scan:
    """Scan a body that stands upright along z; noise and dropout are from `rng` (seed 0 by default)."""
    config = config or ScannerConfig()
    rng = rng or np.random.default_rng(0)
    if not len(mesh.faces):
        raise ValueError("mesh: expected a surface with triangles, got none")
    rays = Rays(mesh)
    views = tuple(_view(mesh, rays, config, k, rng) for k in range(config.views))
    offsets = np.cumsum([0] + [len(view.mesh.vertices) for view in views])
    merged = Mesh(np.vstack([view.mesh.vertices for view in views]),
                  np.vstack([view.mesh.faces + start for view, start in zip(views, offsets, strict=False)]))
    return Scan(views, merged)


def camera_pose(target: np.ndarray, camera: np.ndarray) -> np.ndarray:
    """Compute T_world_camera (4, 4) of a camera that looks at a point, z up; camera axes right, down, ahead."""
    ahead = (target - camera) / np.linalg.norm(target - camera)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 2], T[:3, 3] = right, np.cross(ahead, right), ahead, camera
    return T


def _view(mesh: Mesh, rays: Rays, config: ScannerConfig, number: int, rng: np.random.Generator) -> RangeView:
    """Scan a body from one camera."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    middle = 0.5 * (low + high)
    azimuth = np.radians(config.azimuth + 360.0 * number / config.views)
    lift = config.height * (1 if number % 2 == 0 else -1)
    distance = 2.5                                               # of the cameras from the middle of the body, metres
    # the camera, alternately above and below the middle of the body, never below the floor
    camera = middle + [distance * np.sin(azimuth), -distance * np.cos(azimuth), lift]
    camera[2] = max(camera[2], low[2] + 0.1)
    T = camera_pose(middle, camera)
    # an image just large enough for the body, at the wanted spacing of rays
    focal = distance / config.resolution
    local = (mesh.vertices - camera) @ T[:3, :3]
    extent = np.abs(local[:, :2] / local[:, 2:]).max(axis=0) * focal + 3
    width, height = (2 * np.ceil(extent) + 1).astype(int)
    K = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1.0]])
    directions = pixel_rays((height, width), K, T[:3, :3]).reshape(-1, 3)
    # cast the rays, add the errors of a scanner, and triangulate the image
    face, measured = rays.cast(np.broadcast_to(camera, directions.shape), directions)
    measured = _measure(mesh, rays, config, camera, directions, face, measured, rng)
    seen = np.isfinite(measured)
    triangles = _triangulate(measured.reshape(height, width), config)
    points = camera + np.where(seen, measured, 0)[:, None] * directions
    used, index = np.unique(triangles, return_inverse=True)
    surface = Mesh(points[used], index.reshape(-1, 3))
    # the depth image keeps only pixels that are part of a triangle
    depth = (measured * (directions @ T[:3, 2])).reshape(height, width)
    used_depth = np.full(height * width, np.nan)
    used_depth[used] = depth.reshape(-1)[used]
    return RangeView(surface, surface.vertex_normals, camera, T, used_depth.reshape(height, width), K)


def _measure(mesh: Mesh, rays: Rays, config: ScannerConfig, camera: np.ndarray, directions: np.ndarray,
             face: np.ndarray, distance: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Compute distances with noise; NaN where a ray missed, grazed, was lost or met a blind region."""
    hit = np.flatnonzero(face >= 0)
    normal = mesh.face_normals[face[hit]]
    cosine = np.abs(np.einsum("nd,nd->n", normal, directions[hit]))
    limit = np.sin(np.radians(GRAZING))
    margin = np.clip((cosine - limit) / max(1 - limit, 1e-9), 0, 1)
    # a ray is lost at grazing angles, and at random, more often the more it grazes
    lost = (cosine <= limit) | (rng.random(len(hit)) < DROPOUT + (1 - DROPOUT) * np.exp(-margin / 0.05))
    points = camera + distance[hit, None] * directions[hit]
    blind = np.zeros(len(hit), dtype=bool)
    # blind: another surface faces this one at close distance, as in an armpit
    if config.blind_reach > 0:
        opposite, _ = rays.cast(points + 1e-4 * normal, normal, config.blind_reach)
        facing = np.zeros(len(hit), dtype=bool)
        hits_other = opposite >= 0
        facing[hits_other] = np.einsum("nd,nd->n", mesh.face_normals[opposite[hits_other]], normal[hits_other]) < -0.3
        blind = facing
    out = np.full(len(face), np.nan)
    measured = distance[hit] + config.noise * rng.normal(size=len(hit))
    out[hit] = np.where(lost | blind, np.nan, measured)
    return out


def _triangulate(distance: np.ndarray, config: ScannerConfig) -> np.ndarray:
    """Triangulate neighbouring pixels, (F, 3) pixel numbers, unless depth jumps by five ray spacings or more."""
    height, width = distance.shape
    number = np.arange(height * width).reshape(height, width)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
    flat = distance.reshape(-1)
    with np.errstate(invalid="ignore"):
        # split each square of pixels along the diagonal with the smaller step in depth
        first = np.abs(flat[a] - flat[d]) <= np.abs(flat[b] - flat[c])
    first |= ~np.isfinite(flat[b] + flat[c])
    first &= np.isfinite(flat[a] + flat[d])
    one = np.where(first[..., None], np.stack([a, c, d], -1), np.stack([a, c, b], -1))
    two = np.where(first[..., None], np.stack([a, d, b], -1), np.stack([b, c, d], -1))
    triangles = np.concatenate([one.reshape(-1, 3), two.reshape(-1, 3)])
    corner = flat[triangles]
    with np.errstate(invalid="ignore"):
        continuous = corner.max(axis=1) - corner.min(axis=1) < 5 * config.resolution
    triangles = triangles[continuous]
    if not len(triangles):
        return triangles
    used, index = np.unique(triangles, return_inverse=True)
    surface = Mesh(np.zeros((len(used), 3)), index.reshape(-1, 3))
    island = surface.vertex_component[surface.faces[:, 0]]
    return triangles[np.bincount(island)[island] >= 30]          # fewer than 30 triangles are a speck
