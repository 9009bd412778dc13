"""A scan as a target, and matches between it and a deforming template in both directions."""
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from ..geometry.mesh import Mesh
from ..geometry.surface import OrientedPoints
from .energies import Pull, pull


@dataclass(frozen=True, eq=False)
class Target:
    """Points of a scan with smooth normals.

    Attributes
    ----------
    points, normals : (n, 3) float
    border : (n,) bool
        On the edge of a hole: such a point says where data end, not where the surface is.
    oriented : bool
        Whether the normals are known to point outward.
    """

    points: np.ndarray
    normals: np.ndarray
    border: np.ndarray
    oriented: bool

    def thinned(self, cell: float) -> Target:
        """One point for each cubic cell (metres)."""
        keep = thin(self.points, cell)
        return Target(self.points[keep], self.normals[keep], self.border[keep], self.oriented)


def target_of(scan: Mesh | np.ndarray, neighbours: int = 16, name: str = "scan") -> Target:
    """Prepare a scan: normals averaged over neighbours, borders marked.

    Raises
    ------
    ValueError
        Too few points, a wrong shape, or values that are not finite.
    """
    points = scan.vertices if isinstance(scan, Mesh) else np.asarray(scan, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"{name}: expected a Mesh or points of shape (n, 3), got shape {points.shape}")
    if len(points) < 4:
        raise ValueError(f"{name}: expected at least 4 points, got {len(points)}")
    if not np.isfinite(points).all():
        raise ValueError(f"{name}: {(~np.isfinite(points).all(axis=1)).sum()} points are not finite")
    normals = None
    if isinstance(scan, Mesh) and len(scan.faces):
        used = np.unique(scan.faces)
        points, normals = points[used], scan.vertex_normals[used]
    oriented = normals is not None
    near = cKDTree(points).query(points, min(neighbours, len(points)), workers=-1)[1]
    if normals is not None:
        agree = np.einsum("nkd,nd->nk", normals[near], normals) > 0
        normals = _unit(np.einsum("nk,nkd->nd", agree, normals[near]))
    else:
        normals = spread_normals(points[near])
    return Target(points, normals, _one_sided(points, near), oriented)


def spread_normals(near: np.ndarray) -> np.ndarray:
    """Unit normals (n, 3) by the spread of each point's neighbours (n, k, 3); their sign is arbitrary."""
    offset = near - near.mean(axis=1, keepdims=True)
    return np.linalg.eigh(np.matmul(offset.transpose(0, 2, 1), offset))[1][:, :, 0]


def _one_sided(points: np.ndarray, near: np.ndarray, limit: float = 0.3) -> np.ndarray:
    """(n,) bool: the neighbours lie to one side, as at the edge of a hole; single missing points do not count."""
    offset = points[near] - points[:, None]
    reach = np.linalg.norm(offset, axis=2).max(axis=1)
    return np.linalg.norm(offset.mean(axis=1), axis=1) > limit * reach


def thin(points: np.ndarray, cell: float) -> np.ndarray:
    """Indices of one point for each cubic cell (metres) that holds any: even density, and less work."""
    key = np.floor((points - points.min(axis=0)) / cell).astype(np.int64)
    key = (key[:, 0] * (key[:, 1].max() + 1) + key[:, 1]) * (key[:, 2].max() + 1) + key[:, 2]
    return np.sort(np.unique(key, return_index=True)[1])


@dataclass(frozen=True, eq=False)
class Matching:
    """What matches want of the vertices, and how far those with data are from them.

    Attributes
    ----------
    wanted : Pull
    seen : (N,) bool
        Vertices with an acceptable point of the scan near them.
    distances : (N,) float, metres
        From each vertex to the plane of the scan at its match; NaN without one.
    """

    wanted: Pull
    seen: np.ndarray
    distances: np.ndarray


def orient(target: Target, deformed: Mesh, scale: float) -> Target:
    """The same target with the sign of its normals taken from the nearest part of the template."""
    if target.oriented:
        return target
    tree = OrientedPoints(deformed.vertices, deformed.vertex_normals, scale)
    cost = []
    for sign in (1, -1):
        index = tree.match(target.points, sign * target.normals, min_cosine=-1.0).index
        apart = ((tree.points[index] - target.points) ** 2).sum(axis=1)
        cost.append(apart + scale**2 * ((tree.normals[index] - sign * target.normals) ** 2).sum(axis=1))
    return replace(target, normals=np.where(cost[0] <= cost[1], 1, -1)[:, None] * target.normals)


def match_both_ways(deformed: Mesh, sample: np.ndarray, area: float, target: Target, reach: float, slide: float,
                    scale: float) -> Matching:
    """Match template to scan and scan to template, and weigh the matches by their distance.

    Parameters
    ----------
    deformed : Mesh
        The template as it lies now.
    sample : (n,) int
        Vertices that look for a match; points of the scan may choose any vertex.
    area : float, square metres
        Of the template; either direction weighs as much as this.
    reach : float, metres
        Matches farther apart than this do not count; the weight falls to zero towards it.
    slide : float
        Force along the surface as a share of the force across it.
    scale : float, metres
        How much distance opposite normals weigh, halved.
    """
    target = orient(target, deformed, scale)
    x, normals, N = deformed.vertices, deformed.vertex_normals, len(deformed.vertices)
    forward = OrientedPoints(target.points, target.normals, scale).match(x[sample], normals[sample], reach)
    good = forward.valid & ~target.border[forward.index]
    v, p = sample[good], forward.index[good]
    weights = area / len(sample) * _robust(forward.distances[good], reach)
    wanted = pull(N, v, target.points[p], weights, target.normals[p], slide)
    distances = np.full(N, np.nan)
    distances[v] = np.abs(np.einsum("nd,nd->n", target.normals[p], x[v] - target.points[p]))

    backward = OrientedPoints(x, normals, scale).match(target.points, target.normals, reach)
    p = np.flatnonzero(backward.valid)
    weights = area / len(target.points) * _robust(backward.distances[p], reach)
    wanted += pull(N, backward.index[p], target.points[p], weights, target.normals[p], slide)
    return Matching(wanted, np.isfinite(distances), distances)


def _robust(distances: np.ndarray, reach: float) -> np.ndarray:
    """Tukey's weight: one at zero distance, zero at `reach`."""
    return np.maximum(1 - (distances / reach) ** 2, 0) ** 2


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-300)
