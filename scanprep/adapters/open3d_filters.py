"""Filters of open3d, which needs the graphics libraries of the system even for geometry."""
from __future__ import annotations

import importlib
from typing import Any

import numpy as np

from ..geometry.mesh import Mesh
from ..geometry.surface import Surface


class MissingLibrary(ImportError):
    """A library that a setting asks for is not there, or not the system's libraries it stands on."""


def open3d_decimation(mesh: Mesh, faces: int) -> Mesh:
    """Fewer triangles by open3d's quadric error collapses."""
    o3d = library("open3d")
    whole = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(np.array(mesh.vertices)),      # it wants its own
                                      o3d.utility.Vector3iVector(mesh.faces.astype(np.int32)))
    smaller = whole.simplify_quadric_decimation(faces)
    return Mesh(np.asarray(smaller.vertices), np.asarray(smaller.triangles))


def open3d_poisson(mesh: Mesh, depth: int = 8) -> Mesh:
    """A closed surface near the mesh by screened Poisson reconstruction from its vertices and normals."""
    o3d = library("open3d")
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.array(mesh.vertices)))
    cloud.normals = o3d.utility.Vector3dVector(np.array(mesh.vertex_normals))
    closed, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=depth, n_threads=1)
    return recolor(Mesh(np.asarray(closed.vertices), np.asarray(closed.triangles)), mesh)


def estimate_oriented_normals(points: np.ndarray) -> np.ndarray:
    """Unit normals (n, 3) of points (n, 3), metres, that face the same way along the surface; inward or outward."""
    o3d = library("open3d")
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.array(points)))
    neighbours = 20  # points that tell a normal, and to which it is oriented
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(neighbours))
    cloud.orient_normals_consistent_tangent_plane(neighbours)
    return np.asarray(cloud.normals).copy()


def reconstruct_screened_poisson(points: np.ndarray, normals: np.ndarray, spacing: float) -> Mesh:
    """A surface by screened Poisson reconstruction, its cells as large as the spacing of the points, metres."""
    o3d = library("open3d")
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.array(points)))
    cloud.normals = o3d.utility.Vector3dVector(np.array(normals))
    # octree of Poisson reconstruction: cells of 2 mm on a person
    depth = int(np.clip(np.ceil(np.log2(1.1 * np.ptp(points, axis=0).max() / spacing)), 6, 10))
    found, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=depth, n_threads=1)
    return Mesh(np.asarray(found.vertices), np.asarray(found.triangles).astype(np.int64))


def ball_pivoting(points: np.ndarray, normals: np.ndarray, spacing: float) -> Mesh:
    """Triangles between the points where balls of 1.5, 2.5 and 4 times their spacing come to rest on three of them."""
    o3d = library("open3d")
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.array(points)))
    cloud.normals = o3d.utility.Vector3dVector(np.array(normals))
    radii = o3d.utility.DoubleVector([1.5 * spacing, 2.5 * spacing, 4.0 * spacing])
    found = o3d.geometry.TriangleMesh.create_from_point_cloud_ball_pivoting(cloud, radii)
    return Mesh(np.asarray(found.vertices), np.asarray(found.triangles).astype(np.int64))


def recolor(mesh: Mesh, source: Mesh) -> Mesh:
    """The mesh with the colours of the closest points of another one, when that has any."""
    if source.colors is None:
        return mesh
    at = Surface(source).closest(mesh.vertices)
    return Mesh(mesh.vertices, mesh.faces, np.clip(at.transfer(source.colors, source.faces), 0, 1))


def library(name: str) -> Any:
    """The module open3d or pymeshlab, or MissingLibrary."""
    try:
        return importlib.import_module(name)
    except (ImportError, OSError) as error:
        raise MissingLibrary(f"{name} cannot be imported ({error}). Install it with `pip install {name}`; on Debian it "
                             "also needs `apt-get install libegl1 libgl1 libx11-6 libusb-1.0-0`") from None
