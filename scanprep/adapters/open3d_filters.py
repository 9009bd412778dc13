"""Filters of Open3D, which needs the graphics libraries of the system even for geometry."""
from __future__ import annotations

import importlib
from typing import Any

import numpy as np

from ..geometry.mesh import Mesh


class MissingLibraryError(ImportError):
    """A library that a setting asks for, or a system library it needs, is missing."""


def estimate_oriented_normals(points: np.ndarray) -> np.ndarray:
    """Estimate unit normals (n, 3) of points (n, 3), metres, with one orientation, inward or outward."""
    o3d = library("open3d")
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.array(points)))
    neighbours = 20  # for the normal and for its orientation; about the first two rings
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(neighbours))
    cloud.orient_normals_consistent_tangent_plane(neighbours)
    return np.asarray(cloud.normals).copy()


def reconstruct_screened_poisson(points: np.ndarray, normals: np.ndarray, spacing: float) -> Mesh:
    """Reconstruct a surface by screened Poisson reconstruction, with cells of about the point spacing, metres."""
    o3d = library("open3d")
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.array(points)))
    cloud.normals = o3d.utility.Vector3dVector(np.array(normals))
    # octree depth for cells of one spacing; between 6 and 10, where cells are 2 mm on a person
    depth = int(np.clip(np.ceil(np.log2(1.1 * np.ptp(points, axis=0).max() / spacing)), 6, 10))
    found, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=depth, n_threads=1)
    return Mesh(np.asarray(found.vertices), np.asarray(found.triangles).astype(np.int64))


def ball_pivoting(points: np.ndarray, normals: np.ndarray, spacing: float) -> Mesh:
    """Mesh points by ball pivoting, with balls of 1.5, 2.5 and 4 times their spacing, metres."""
    o3d = library("open3d")
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.array(points)))
    cloud.normals = o3d.utility.Vector3dVector(np.array(normals))
    radii = o3d.utility.DoubleVector([1.5 * spacing, 2.5 * spacing, 4.0 * spacing])
    found = o3d.geometry.TriangleMesh.create_from_point_cloud_ball_pivoting(cloud, radii)
    return Mesh(np.asarray(found.vertices), np.asarray(found.triangles).astype(np.int64))


def library(name: str) -> Any:
    """Import open3d or pymeshlab; MissingLibrary with advice if that fails."""
    try:
        return importlib.import_module(name)
    except (ImportError, OSError) as error:
        raise MissingLibraryError(
            f"{name} cannot be imported ({error}). Install it with `pip install {name}`; on Debian it also needs "
            "`apt-get install libegl1 libgl1 libx11-6 libusb-1.0-0`") from None
