"""A scan prepared as a target: points with smooth normals, and which of them are on a border."""
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from ..threads import search_threads
from .farthest_points import thin
from .mesh import Mesh
from .places import distinct_places
from .sanitise import sanitise
from .sparse import unique_integers
from .surface import OrientedPoints, check_points


@dataclass(frozen=True, eq=False)
class Target:
    """Points of a scan with smooth normals."""

    points: np.ndarray                          # (n, 3), metres
    normals: np.ndarray                         # (n, 3)
    border: np.ndarray                          # (n,) bool: on the edge of a hole, where the data end
    oriented: bool                              # the normals are known to point outward
    descriptors: np.ndarray | None = None       # (n, q) path descriptors, see `registration.paths`
    index: np.ndarray | None = None             # (n,) number of each point in the scan

    def thin(self, cell: float) -> Target:
        """Return the target with one point per cubic cell (metres)."""
        keep = thin(self.points, cell)
        return Target(self.points[keep], self.normals[keep], self.border[keep], self.oriented,
                      None if self.descriptors is None else self.descriptors[keep],
                      None if self.index is None else self.index[keep])


def target_of(scan: Mesh | np.ndarray, name: str = "scan") -> Target:
    """Prepare a scan: drop repeated points, average normals over neighbours, and find borders.

    Every point has a normal. ValueError for fewer than four distinct points.
    """
    points = check_points(scan.vertices if isinstance(scan, Mesh) else scan, name)
    index, normals = distinct_places(points), None
    if isinstance(scan, Mesh) and len(scan.faces):
        scan = sanitise(scan, name)
        index = unique_integers(scan.faces)
        index = index[distinct_places(points[index])]
        normals = scan.vertex_normals[index]
    if len(index) < 4:
        raise ValueError(f"{name}: expected at least 4 distinct points, got {len(index)}")
    points = points[index]
    # normals are averaged over 16 points, about two rings
    near = cKDTree(points).query(points, min(16, len(points)), workers=search_threads(len(points)))[1]
    if normals is not None:
        return Target(points, _average_normals(points, normals, near), _one_sided(points, near), True, index=index)
    return Target(points, spread_normals(points[near]), _one_sided(points, near), False, index=index)


def _average_normals(points: np.ndarray, normals: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Average unit normals (n, 3) over the neighbours (n, k) that face the same way.

    Where the triangles around a point cancel, for example back to back, the plane of its neighbours is used.
    """
    agree = np.einsum("nkd,nd->nk", normals[near], normals) > 0
    mean = np.einsum("nk,nkd->nd", agree, normals[near])
    length = np.linalg.norm(mean, axis=1)
    lost = length < 1e-9                     # otherwise at least its own unit normal is in the sum
    if lost.any():
        plane = spread_normals(points[near[lost]])
        against = np.einsum("nd,nd->n", plane, normals[near[lost]].sum(axis=1)) < 0
        mean[lost], length[lost] = np.where(against[:, None], -plane, plane), 1.0
    mean /= length[:, None]
    return mean


def spread_normals(near: np.ndarray) -> np.ndarray:
    """Estimate unit normals (n, 3) by the least spread of each point's neighbours (n, k, 3); signs are arbitrary."""
    offset = near - near.mean(axis=1, keepdims=True)
    return np.linalg.eigh(np.matmul(offset.transpose(0, 2, 1), offset))[1][:, :, 0]


def _one_sided(points: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Find border points (n,) bool: their neighbours lie to one side. Single missing points do not make a border."""
    offset = points[near] - points[:, None]
    reach = np.linalg.norm(offset, axis=2).max(axis=1)
    return np.linalg.norm(offset.mean(axis=1), axis=1) > 0.3 * reach


def orient_by_mesh(target: Target, deformed: Mesh, scale: float) -> Target:
    """Orient the normals of a target by the nearest part of a mesh on it; `scale` as for `OrientedPoints`."""
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
