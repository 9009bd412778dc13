"""A scan as a target, and matches between it and a deforming template in both directions."""
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from ..geometry.mesh import Mesh
from ..geometry.surface import OrientedPoints
from ..geometry.thinning import thin
from ..threads import search_threads
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
    marks : (n, q) float, optional
        Where a point lies on the body (see `paths.path_marks`).
    """

    points: np.ndarray
    normals: np.ndarray
    border: np.ndarray
    oriented: bool
    marks: np.ndarray | None = None

    def thinned(self, cell: float) -> Target:
        """One point for each cubic cell (metres)."""
        keep = thin(self.points, cell)
        return Target(self.points[keep], self.normals[keep], self.border[keep], self.oriented,
                      None if self.marks is None else self.marks[keep])


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
    near = cKDTree(points).query(points, min(neighbours, len(points)), workers=search_threads(len(points)))[1]
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
    for way in (1, -1):
        index = tree.match(target.points, way * target.normals, min_cosine=-1.0).index
        apart = ((tree.points[index] - target.points) ** 2).sum(axis=1)
        cost.append(apart + scale**2 * ((tree.normals[index] - way * target.normals) ** 2).sum(axis=1))
    sign = np.where(cost[0] <= cost[1], 1, -1)[:, None]
    return replace(target, normals=sign * target.normals)


@dataclass(frozen=True)
class Likeness:
    """What a match is sought by, each as the distance in metres that a difference of one is worth.

    Attributes
    ----------
    place : float
        Of positions: 1, or less where the template does not lie near yet; 0 seeks by marks alone.
    normals : float, metres
    marks : float, metres
    mark_limit : float
        Marks that differ by more than this do not match.
    """

    place: float = 1.0
    normals: float = 0.05
    marks: float = 0.0
    mark_limit: float = 0.3


def match_both_ways(deformed: Mesh, sample: np.ndarray, area: float, target: Target, reach: float, slide: float,
                    like: Likeness, marks: np.ndarray | None = None) -> Matching:
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
    like : Likeness
    marks : (N, q) float, optional
        Of the template's vertices, to be compared with the target's.
    """
    target = orient(target, deformed, max(like.normals, 1e-6))
    x, normals, N = deformed.vertices, deformed.vertex_normals, len(deformed.vertices)
    mine = Described(x, normals, marks)
    theirs = Described(target.points, target.normals, target.marks)
    p, apart = mine.of(sample).matched(theirs, reach, like)
    good = (p >= 0) & ~target.border[p]
    v, p = sample[good], p[good]
    weights = area / len(sample) * tukey(apart[good], reach)
    wanted = pull(N, v, target.points[p], weights, target.normals[p], slide)
    distances = np.full(N, np.nan)
    distances[v] = np.abs(np.einsum("nd,nd->n", target.normals[p], x[v] - target.points[p]))

    chosen, apart = theirs.matched(mine, reach, like)
    p = np.flatnonzero(chosen >= 0)
    weights = area / len(target.points) * tukey(apart[p], reach)
    wanted += pull(N, chosen[p], target.points[p], weights, target.normals[p], slide)
    return Matching(wanted, np.isfinite(distances), distances)


@dataclass(frozen=True, eq=False)
class Described:
    """Points with what they are matched by."""

    points: np.ndarray
    normals: np.ndarray
    marks: np.ndarray | None = None

    def of(self, sample: np.ndarray) -> Described:
        """Some of the points."""
        return Described(self.points[sample], self.normals[sample],
                         None if self.marks is None else self.marks[sample])

    def columns(self, like: Likeness) -> np.ndarray:
        parts = [like.place * self.points, like.normals * self.normals] if like.place else []
        if like.marks and self.marks is not None:
            parts.append(like.marks * self.marks)
        return np.hstack(parts)

    def matched(self, others: Described, reach: float, like: Likeness) -> tuple[np.ndarray, np.ndarray]:
        """For each point the best of others, -1 where it is beyond the limits; and how far apart they are."""
        mine, theirs = self.columns(like), others.columns(like)
        _, index = cKDTree(theirs).query(mine, workers=search_threads(len(mine)))
        apart = np.linalg.norm(others.points[index] - self.points, axis=1)
        good = apart <= reach
        if like.place:
            good &= np.einsum("nd,nd->n", others.normals[index], self.normals) >= 0.5
        if like.marks and self.marks is not None and others.marks is not None:
            good &= np.linalg.norm(others.marks[index] - self.marks, axis=1) <= like.mark_limit
        return np.where(good, index, -1), apart


def tukey(distances: np.ndarray, reach: float) -> np.ndarray:
    """Tukey's weight: one at zero distance, zero at `reach`."""
    return np.maximum(1 - (distances / reach) ** 2, 0) ** 2


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-300)
