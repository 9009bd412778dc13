"""Turn point clouds into meshes, for everything that needs a surface."""
from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from ..geometry.files import PointCloud, read_points, read_scan
from ..geometry.mesh import Mesh
from ..repair.manifold import repair

MOST = 40_000                          # points to mesh: 7 mm apart on a person, like the triangles of a template
AWAY = 2.5                             # metres: usual distance of a camera from a person


def mesh_of_cloud(cloud: PointCloud | np.ndarray) -> Mesh:
    """Mesh the points of a whole body; the surface is open where nothing was scanned.

    Screened Poisson reconstruction; surface far from any point is removed.

    Parameters
    ----------
    cloud : PointCloud or (n, 3) float, metres
        Normals are used if there are any, else estimated.

    Returns
    -------
    Mesh
        Manifold, its normals outward; without colours.

    Raises
    ------
    ValueError
        Too few points, or points with no surface between them.
    MissingLibrary
        Open3D, or a system library it needs.
    """
    from ..adapters.open3d_filters import estimate_oriented_normals, reconstruct_screened_poisson

    points, normals = _thin(cloud)
    spacing = spacing_of(points)
    surface = reconstruct_screened_poisson(points, estimate_oriented_normals(points) if normals is None else normals,
                                           spacing)
    away = cKDTree(points).query(surface.vertices)[0]
    # farther than 2.5 spacings from every point nothing was measured
    surface = surface.submesh((away <= 2.5 * spacing)[surface.faces].all(axis=1))[0]
    if not len(surface.faces):
        raise ValueError("cloud: no surface lies between its points; are they of a surface?")
    # drop specks, and make the volume positive: normals outward
    surface = repair(surface, 0.02)
    if surface.with_vertices(surface.vertices - np.median(surface.vertices, axis=0)).volume < 0:
        surface = Mesh(surface.vertices, np.ascontiguousarray(surface.faces[:, ::-1]))
    return surface


def read_sound_surface(path: Path, unit: str | None = None) -> Mesh:
    """Read the mesh of a scan; mesh the points of a file without triangles, with a warning."""
    scan = read_scan(path, unit)
    if isinstance(scan, Mesh):
        return scan
    warnings.warn(f"{path} has no triangles: its points are meshed, and left open where there are none", stacklevel=2)
    try:
        return mesh_of_cloud(read_points(path, unit))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def mesh_of_view(view: PointCloud | np.ndarray) -> tuple[Mesh, np.ndarray]:
    """Mesh the points that one camera saw, by ball pivoting; estimate the camera's position (3,), metres.

    All normals face the camera, and on people their mean is the direction to it. The camera is assumed 2.5 m away.
    """
    from ..adapters.open3d_filters import ball_pivoting, estimate_oriented_normals

    points, normals = _thin(view)
    if normals is None:
        normals = estimate_oriented_normals(points)
        # direction to the camera: start with the main axis of the normals, then alternate signs and mean
        ahead = np.linalg.eigh(normals.T @ normals)[1][:, -1]
        for _ in range(10):
            normals *= np.where(normals @ ahead < 0, -1.0, 1.0)[:, None]
            ahead = normals.mean(axis=0) / np.linalg.norm(normals.mean(axis=0))
        middle = points - points.mean(axis=0)
        if np.einsum("nd,nd->", middle, normals) < 0:             # else it would be concave towards the camera
            normals = -normals
    mesh = repair(ball_pivoting(points, normals, spacing_of(points)), 0.02)
    ahead = mesh.vertex_normals.mean(axis=0)
    return mesh, mesh.vertices.mean(axis=0) + AWAY * ahead / np.linalg.norm(ahead)


def spacing_of(points: np.ndarray) -> float:
    """Estimate the spacing of points (n, 3) of a surface, metres: the root of the area per point.

    From the distance to the sixth neighbour, which noise and overlapping views hardly change.
    """
    sample = points[np.random.default_rng(0).permutation(len(points))[:4000]]
    return float(np.sqrt(np.pi / 6) * np.median(cKDTree(points).query(sample, 7)[0][:, 6]))


def _thin(cloud: PointCloud | np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Choose distinct points, as many as a template needs, with their normals if they have any."""
    points = cloud.points if isinstance(cloud, PointCloud) else np.asarray(cloud, dtype=np.float64)
    normals = cloud.normals if isinstance(cloud, PointCloud) else None
    rows = np.unique(points, axis=0, return_index=True)[1]
    least = 100  # fewer points do not make a surface
    if len(rows) < least:
        raise ValueError(f"cloud: expected at least {least} points at different places, got {len(rows)}")
    rows = np.random.default_rng(0).permutation(rows)[:MOST]
    return points[rows], None if normals is None else normals[rows]
