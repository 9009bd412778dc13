"""A scan as a target of registration: its points with smooth normals, and which of them end at a hole."""
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from ..threads import search_threads
from .farthest_points import thin
from .mesh import Mesh
from .surface import OrientedPoints, checked_points

NEIGHBOURS = 16                  # points of a scan over which its normals are averaged


@dataclass(frozen=True, eq=False)
class Target:
    """Points of a scan with smooth normals."""

    points: np.ndarray                          # (n, 3), metres
    normals: np.ndarray                         # (n, 3)
    border: np.ndarray                          # (n,) bool: on the edge of a hole, where data end, not the surface
    oriented: bool                              # the normals are known to point outward
    descriptors: np.ndarray | None = None       # (n, q) what else a point is matched by (see `path_descriptors`)

    def thinned(self, cell: float) -> Target:
        """One point for each cubic cell (metres)."""
        keep = thin(self.points, cell)
        return Target(self.points[keep], self.normals[keep], self.border[keep], self.oriented,
                      None if self.descriptors is None else self.descriptors[keep])


def target_of(scan: Mesh | np.ndarray, name: str = "scan") -> Target:
    """Prepare a scan: normals averaged over neighbours, borders found; ValueError for fewer than four points."""
    points = checked_points(scan.vertices if isinstance(scan, Mesh) else scan, name)
    if len(points) < 4:
        raise ValueError(f"{name}: expected at least 4 points, got {len(points)}")
    normals = None
    if isinstance(scan, Mesh) and len(scan.faces):
        used = np.unique(scan.faces)
        points, normals = points[used], scan.vertex_normals[used]
    oriented = normals is not None
    near = cKDTree(points).query(points, min(NEIGHBOURS, len(points)), workers=search_threads(len(points)))[1]
    if normals is not None:
        agree = np.einsum("nkd,nd->nk", normals[near], normals) > 0
        normals = np.einsum("nk,nkd->nd", agree, normals[near])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    else:
        normals = _spread_normals(points[near])
    return Target(points, normals, _one_sided(points, near), oriented)


def _spread_normals(near: np.ndarray) -> np.ndarray:
    """Unit normals (n, 3) by the spread of each point's neighbours (n, k, 3); their sign is arbitrary."""
    offset = near - near.mean(axis=1, keepdims=True)
    return np.linalg.eigh(np.matmul(offset.transpose(0, 2, 1), offset))[1][:, :, 0]


def _one_sided(points: np.ndarray, near: np.ndarray) -> np.ndarray:
    """(n,) bool: the neighbours lie to one side, as at the edge of a hole; single missing points do not count."""
    offset = points[near] - points[:, None]
    reach = np.linalg.norm(offset, axis=2).max(axis=1)
    return np.linalg.norm(offset.mean(axis=1), axis=1) > 0.3 * reach


def orient(target: Target, deformed: Mesh, scale: float) -> Target:
    """The same target with the sign of its normals from the nearest part of a mesh on it; `scale` as `OrientedPoints`.
    """
    if target.oriented:
        return target
    tree = OrientedPoints(deformed.vertices, deformed.vertex_normals, scale)
    cost = []
    for way in (1, -1):
        index = tree.match(target.points, way * target.normals, min_cosine=-1.0).index
        apart = ((tree.points[index] - target.points) ** 2).sum(axis=1)
        cost.append(apart + scale**2 * ((tree.normals[index] - way * target.normals) ** 2).sum(axis=1))
    sign = np.where(cost[0] <= cost[1], 1, -1)[:, None]
    return replace(target, normals=sign * target.normals)
