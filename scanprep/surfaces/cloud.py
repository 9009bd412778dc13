"""Point clouds made meshes: what a scanner without triangles gives, for everything that needs a surface."""
from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ..geometry.files import PointCloud
from ..geometry.mesh import Mesh
from ..repair.manifold import repair

MOST = 60_000                          # points that are meshed: a third of a body's pores, and seconds, not minutes
TRIM = 3.0                             # spacings from the nearest point, beyond which nothing was measured
LEAST = 100                            # points of anything that has a surface


def mesh_of_cloud(cloud: PointCloud | np.ndarray, whole: bool = True) -> Mesh:
    """The surface through a point cloud; open where nothing was scanned.

    A whole body is meshed by screened Poisson reconstruction, what lies farther from the points than three times their
    spacing is trimmed off. One view of it is meshed by rolling balls over the points, which closes nothing.

    Parameters
    ----------
    cloud : PointCloud or (n, 3) float, metres
        Normals are taken where there are any, else estimated.
    whole : bool
        Seen from all sides, or by one camera.

    Returns
    -------
    Mesh
        Manifold, its normals outward; without colours.

    Raises
    ------
    ValueError
        Too few points, or points with no surface between them.
    MissingLibrary
        open3d, or the system's libraries it stands on.
    """
    from ..adapters.open3d_filters import ball_pivoting, oriented_normals, screened_poisson

    points = cloud.points if isinstance(cloud, PointCloud) else np.asarray(cloud, dtype=np.float64)
    normals = cloud.normals if isinstance(cloud, PointCloud) else None
    points, rows = np.unique(points, axis=0, return_index=True)
    if len(points) < LEAST:
        raise ValueError(f"cloud: expected at least {LEAST} points at different places, got {len(points)}")
    chosen = np.random.default_rng(0).permutation(len(points))[:MOST]
    points, rows = points[chosen], rows[chosen]
    spacing = spacing_of(points)
    normals = oriented_normals(points) if normals is None else normals[rows]
    if whole:
        surface = screened_poisson(points, normals, spacing)
        away = cKDTree(points).query(surface.vertices)[0]
        surface = surface.submesh((away <= TRIM * spacing)[surface.faces].all(axis=1))[0]
    else:
        surface = ball_pivoting(points, normals, spacing)
    if not len(surface.faces):
        raise ValueError("cloud: no surface lies between its points; are they of a surface?")
    surface = repair(surface, 0.02)
    return outward(surface)


def outward(mesh: Mesh) -> Mesh:
    """The mesh with its normals away from its middle, by signed volume: also for most of a body, seen from one side."""
    centred = Mesh(mesh.vertices - np.median(mesh.vertices, axis=0), mesh.faces, mesh.colors)
    return mesh if centred.volume >= 0 else Mesh(mesh.vertices, np.ascontiguousarray(mesh.faces[:, ::-1]), mesh.colors)


def spacing_of(points: np.ndarray) -> float:
    """The median distance (metres) from a point (n, 3) to the nearest one elsewhere."""
    few = points[np.random.default_rng(0).permutation(len(points))[:4000]]
    return float(np.median(cKDTree(points).query(few, 2)[0][:, 1]))
