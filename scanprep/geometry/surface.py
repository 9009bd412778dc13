"""Closest points on a surface, matches with compatible normals, ray casting, and free space of views."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from ..threads import search_threads
from .budget import spend
from .mesh import Mesh


def check_points(points: np.ndarray, name: str = "points") -> np.ndarray:
    """Check query points (n, 3), and return them as contiguous float64; ValueError for points that are too far away."""
    points = np.ascontiguousarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"{name}: expected points of shape (n, 3), got shape {points.shape}")
    farthest = 1e30  # beyond it squares, or float32, overflow
    bad = np.flatnonzero(~(np.abs(points) < farthest).all(axis=1))
    if len(bad):
        raise ValueError(f"{name}: {len(bad)} points are not finite, or beyond {farthest:g} m; the first is number "
                         f"{bad[0]}: {points[bad[0]].tolist()}")
    return points


def check_surface(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and faces of a mesh as contiguous arrays; ValueError without triangles."""
    if not len(mesh.faces):
        raise ValueError(f"mesh: expected at least one triangle, got {mesh}")
    return check_points(mesh.vertices, "mesh"), np.ascontiguousarray(mesh.faces)


@dataclass(frozen=True)
class SurfacePoints:
    """Points on the triangles of a mesh."""

    points: np.ndarray          # (n, 3), metres
    faces: np.ndarray           # (n,)
    bary: np.ndarray            # (n, 3) barycentric coordinates
    distances: np.ndarray       # (n,) metres, from the query points

    def transfer(self, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """Return the same surface points (n, 3) on other vertices of the same triangulation."""
        return np.einsum("nc,ncd->nd", self.bary, vertices[faces[self.faces]])


class Surface:
    """Closest-point queries on one mesh with triangles; the search tree is built once."""

    def __init__(self, mesh: Mesh) -> None:
        import igl

        self.mesh = mesh
        self._vertices, self._faces = check_surface(mesh)
        self._tree = igl.AABB()
        self._tree.init(self._vertices, self._faces)

    def closest(self, points: np.ndarray) -> SurfacePoints:
        """Find the closest surface point to each query point (n, 3); ValueError for points that are not finite."""
        points = check_points(points)
        squared, face, closest = self._tree.squared_distance(self._vertices, self._faces, points)[:3]
        squared, face = np.asarray(squared).reshape(-1), np.asarray(face, dtype=np.int64).reshape(-1)
        closest = np.asarray(closest).reshape(-1, 3)
        return SurfacePoints(closest, face, barycentric(closest, self.mesh.corners[face]),
                             np.sqrt(np.maximum(squared, 0)))


def barycentric(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Compute barycentric coordinates (n, 3) of points (n, 3) in the planes of triangles (n, 3, 3).

    For a degenerate triangle, all weight is on its first corner.
    """
    u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    w = points - corners[:, 0]
    uu, uv, vv = (np.einsum("nd,nd->n", a, b) for a, b in ((u, u), (u, v), (v, v)))
    wu, wv = np.einsum("nd,nd->n", w, u), np.einsum("nd,nd->n", w, v)
    det = uu * vv - uv * uv
    flat = det <= 1e-30
    det = np.where(flat, 1.0, det)
    b1 = np.where(flat, 0.0, (vv * wu - uv * wv) / det)
    b2 = np.where(flat, 0.0, (uu * wv - uv * wu) / det)
    return np.stack([1 - b1 - b2, b1, b2], axis=1)


@dataclass(frozen=True)
class Matches:
    """For each query point the match among the targets, or none."""

    index: np.ndarray           # (n,) index of the target, -1 for none
    distances: np.ndarray       # (n,) metres; inf for none

    @property
    def valid(self) -> np.ndarray:
        """(n,) bool: the query has a match."""
        return self.index >= 0


class OrientedPoints:
    """Nearest neighbours among points with compatible normals.

    Points and normals are searched together in six dimensions: the squared distance is |x - y|² + scale² |n - m|²
    (scale in metres). So a point on the near side of a thin limb wins over a closer one on the far side.
    """

    def __init__(self, points: np.ndarray, normals: np.ndarray, scale: float = 0.05) -> None:
        if not len(points):
            raise ValueError("points: expected at least one to search among, got none")
        self.points, self.normals, self.scale = check_points(points), check_points(normals, "normals"), scale
        self._tree = cKDTree(np.hstack([points, scale * normals]))

    def match(self, points: np.ndarray, normals: np.ndarray, max_distance: float = np.inf,
              min_cosine: float = 0.5) -> Matches:
        """Find the best target of each query (n, 3) with normals (n, 3); ValueError for values that are not finite."""
        points, normals = check_points(points), check_points(normals, "normals")
        # a match farther than this in six dimensions is too far, or faces away: the search may stop there
        reach = np.hypot(max_distance, self.scale * np.sqrt(2 - 2 * min_cosine)) * (1 + 1e-9)
        _, index = self._tree.query(np.hstack([points, self.scale * normals]), distance_upper_bound=reach,
                                    workers=search_threads(len(points)))
        index = np.minimum(index, len(self.points) - 1)            # nothing within reach; rejected below
        distances = np.linalg.norm(self.points[index] - points, axis=1)
        cosine = np.einsum("nd,nd->n", self.normals[index], normals)
        good = (distances <= max_distance) & (cosine >= min_cosine)
        return Matches(np.where(good, index, -1), np.where(good, distances, np.inf))


class Rays:
    """Ray casting against one mesh with Embree."""

    def __init__(self, mesh: Mesh) -> None:
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh

        # Embree works in float32: centre the mesh, so that no accuracy is lost far from the origin
        self._origin = mesh.vertices.mean(axis=0) if len(mesh.vertices) else np.zeros(3)
        self._scene = rtcore_scene.EmbreeScene()
        self._mesh = TriangleMesh(self._scene, (mesh.vertices - self._origin).astype(np.float32),
                                  mesh.faces.astype(np.int32))

    def cast(self, origins: np.ndarray, directions: np.ndarray, reach: float = 1e6
             ) -> tuple[np.ndarray, np.ndarray]:
        """Cast rays (n, 3) with unit directions: first triangle (n,), -1 for none, and distance (n,), NaN for none.

        ValueError for a ray that is not finite, because it would seem to hit nothing.
        """
        origins = check_points(origins, "origins")
        along = check_points(np.broadcast_to(directions, origins.shape), "directions").astype(np.float32)
        start = np.ascontiguousarray(origins - self._origin, dtype=np.float32)
        face, distance = np.empty(len(start), np.int64), np.empty(len(start))
        for first in range(0, len(start), 4096):     # where a file is read, its budget is looked at between them
            some = slice(first, first + 4096)
            hit = self._scene.run(start[some], along[some], np.full(len(start[some]), reach, np.float32), output=True)
            face[some], distance[some] = hit["primID"], hit["tfar"]
            spend()
        return face, np.where(face >= 0, distance, np.nan)

    def test_occlusion(self, origins: np.ndarray, directions: np.ndarray, reach: float = 1e6) -> np.ndarray:
        """Test whether something lies within `reach` along each ray (n,)."""
        return self.cast(origins, directions, reach)[0] >= 0


def mesh_and_camera(view: Any) -> tuple[Mesh, np.ndarray]:
    """Return surface and camera position (3,), metres, of a RangeView or a pair."""
    mesh, camera = view if isinstance(view, tuple) else (view.mesh, view.camera)
    camera = np.asarray(camera, dtype=float)
    if not isinstance(mesh, Mesh) or camera.shape != (3,) or not np.isfinite(camera).all():
        raise ValueError("views: expected RangeViews or pairs of a Mesh and a camera position (3,)")
    return mesh, camera


class SeenSpace:
    """Free space of views: between the camera and the surface that it saw.

    [VRIP] space carving
    """

    def __init__(self, views: Sequence[Any]) -> None:
        self._views = [(Rays(mesh), camera) for mesh, camera in map(mesh_and_camera, views)]

    def ahead(self, points: np.ndarray) -> np.ndarray:
        """Compute the largest free-space violation over all views: how far points (n, 3) are in front of the surface,
        metres.

        Negative behind the surface of every view, -inf where no line of sight through the point ends on a surface.
        """
        best = np.full(len(points), -np.inf)
        for rays, camera in self._views:
            along = points - camera
            depth = np.linalg.norm(along, axis=1)
            along = along / np.maximum(depth, 1e-12)[:, None]
            _, hit = rays.cast(np.broadcast_to(camera, points.shape), along)
            best = np.maximum(best, np.nan_to_num(hit - depth, nan=-np.inf))
        return best
