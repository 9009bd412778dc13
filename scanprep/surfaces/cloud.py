"""Point clouds made meshes: what a scanner without triangles gives, for everything that needs a surface."""
from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from ..geometry.files import PointCloud, read_points, read_scan
from ..geometry.mesh import Mesh
from ..repair.manifold import repair

MOST = 40_000                          # points that are meshed: 7 mm apart on a person, as the triangles of a template
AWAY = 2.5                             # metres from which cameras look at people


def mesh_of_cloud(cloud: PointCloud | np.ndarray) -> Mesh:
    """The surface through the points of a whole body; open where nothing was scanned.

    By screened Poisson reconstruction; what lies farther from the points than their spacing lets expect is trimmed
    off.

    Parameters
    ----------
    cloud : PointCloud or (n, 3) float, metres
        Normals are taken where there are any, else estimated.

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
    from ..adapters.open3d_filters import estimate_oriented_normals, reconstruct_screened_poisson

    points, normals = _thin(cloud)
    spacing = spacing_of(points)
    surface = reconstruct_screened_poisson(points, estimate_oriented_normals(points) if normals is None else normals,
                                           spacing)
    away = cKDTree(points).query(surface.vertices)[0]
    # spacings from the nearest point, beyond which nothing was measured
    surface = surface.submesh((away <= 2.5 * spacing)[surface.faces].all(axis=1))[0]
    if not len(surface.faces):
        raise ValueError("cloud: no surface lies between its points; are they of a surface?")
    surface = repair(surface, 0.02)
    if surface.with_vertices(surface.vertices - np.median(surface.vertices, axis=0)).volume < 0:
        surface = Mesh(surface.vertices, np.ascontiguousarray(surface.faces[:, ::-1]))
    return surface


def read_sound_surface(path: Path, unit: str | None = None) -> Mesh:
    """The mesh of a scan, made sound; of a file without triangles the surface through its points, with a warning."""
    found = read_scan(path, unit)
    if isinstance(found, Mesh):
        return found
    warnings.warn(f"{path} has no triangles: its points are meshed, and left open where there are none", stacklevel=2)
    try:
        return mesh_of_cloud(read_points(path, unit))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def mesh_of_view(view: PointCloud | np.ndarray) -> tuple[Mesh, np.ndarray]:
    """The surface that one camera saw as points, by rolling balls over them, and about where the camera was (3,).

    All normals face the camera. On people they lie around the direction to it, so their mean is that direction, and
    what they enclose is behind them. The camera is taken to be 2.5 m away.
    """
    from ..adapters.open3d_filters import ball_pivoting, estimate_oriented_normals

    points, normals = _thin(view)
    if normals is None:
        normals = estimate_oriented_normals(points)
        # from the axis along which normals are longest to the direction around which they lie
        ahead = np.linalg.eigh(normals.T @ normals)[1][:, -1]
        for _ in range(10):
            normals *= np.where(normals @ ahead < 0, -1.0, 1.0)[:, None]
            ahead = normals.mean(axis=0) / np.linalg.norm(normals.mean(axis=0))
        middle = points - points.mean(axis=0)
        if np.einsum("nd,nd->", middle, normals) < 0:                 # the shell would be hollow towards the camera
            normals = -normals
    mesh = repair(ball_pivoting(points, normals, spacing_of(points)), 0.02)
    ahead = mesh.vertex_normals.mean(axis=0)
    return mesh, mesh.vertices.mean(axis=0) + AWAY * ahead / np.linalg.norm(ahead)


def spacing_of(points: np.ndarray) -> float:
    """How far apart the points (n, 3) of a surface are, metres: the root of the area that each has to itself.

    From the distance to the sixth neighbour, which noise and pairs of overlapping views hardly change.
    """
    few = points[np.random.default_rng(0).permutation(len(points))[:4000]]
    return float(np.sqrt(np.pi / 6) * np.median(cKDTree(points).query(few, 7)[0][:, 6]))


def _thin(cloud: PointCloud | np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Points at different places, so many as a template needs, and their normals if they have any."""
    points = cloud.points if isinstance(cloud, PointCloud) else np.asarray(cloud, dtype=np.float64)
    normals = cloud.normals if isinstance(cloud, PointCloud) else None
    rows = np.unique(points, axis=0, return_index=True)[1]
    least = 100  # points of anything that has a surface
    if len(rows) < least:
        raise ValueError(f"cloud: expected at least {least} points at different places, got {len(rows)}")
    rows = np.random.default_rng(0).permutation(rows)[:MOST]
    return points[rows], None if normals is None else normals[rows]
