"""A noisy scan as a smooth surface: noise is averaged out over small neighbourhoods before it is followed."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ..geometry.mesh import Mesh
from ..geometry.surface import OrientedPoints
from ..threads import search_threads
from .energies import Pull, pull
from .matches import Target, orient


@dataclass(frozen=True, eq=False)
class Skin:
    """Points of a scan, moved to the smooth surface that fits their neighbours.

    Attributes
    ----------
    points, normals : (n, 3) float
    border : (n,) bool
    noise : float, metres
        Standard deviation of the scan's points around the fitted surfaces.
    spacing : float, metres
        Between neighbouring points.
    """

    points: np.ndarray
    normals: np.ndarray
    border: np.ndarray
    noise: float
    spacing: float


def skin_of(target: Target, width: float, neighbours: int = 40) -> Skin:
    """Fit a quadratic surface around every point of a scan.

    Parameters
    ----------
    target : Target
        Oriented.
    width : float, metres
        Points count by a Gaussian of this standard deviation.
    """
    P, n = target.points, target.normals
    apart, near = cKDTree(P).query(P, min(neighbours, len(P)), workers=search_threads(len(P)))
    agree = np.einsum("nkd,nd->nk", n[near], n)
    w = np.exp(-0.5 * (apart / width) ** 2) * np.maximum(agree, 0)
    side = np.cross(n, np.eye(3)[np.argmin(np.abs(n), axis=1)])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    axes = np.stack([side, np.cross(n, side), n], axis=1)
    u, v, h = np.moveaxis(np.einsum("nad,nkd->nka", axes, P[near] - P[:, None]) / width, 2, 0)
    basis = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=2)
    weighed = basis * w[..., None]
    normal = np.matmul(weighed.transpose(0, 2, 1), basis)
    # Few points say little about curvature: near borders the fit falls back to a plane.
    normal += np.diag([1e-9, 1e-2, 1e-2, 0.3, 0.3, 0.3])
    fit = np.linalg.solve(normal, np.einsum("nkb,nk->nb", weighed, h)[..., None])[..., 0]
    rest = np.einsum("nkb,nb->nk", basis, fit) - h
    noise = width * np.sqrt(np.median(np.sum(w * rest**2, axis=1) / np.maximum(w.sum(axis=1), 1e-12)))
    normals = n - fit[:, 1:2] * axes[:, 0] - fit[:, 2:3] * axes[:, 1]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    spacing = np.median(apart[:, min(4, apart.shape[1] - 1)])
    return Skin(P + width * np.clip(fit[:, :1], -1, 1) * n, normals, target.border, float(noise), float(spacing))


@dataclass(frozen=True, eq=False)
class Touch:
    """What the data want of the vertices.

    Attributes
    ----------
    wanted : Pull
    seen : (N,) bool
        Vertices with data.
    distances : (N,) float, metres
        From each of these to the smoothed surface; NaN for the others.
    """

    wanted: Pull
    seen: np.ndarray
    distances: np.ndarray


def touch(deformed: Mesh, areas: np.ndarray, skin: Skin, reach: float, slide: float, scale: float,
          trust: np.ndarray) -> Touch:
    """Vertices drawn to the tangent planes of the nearest smoothed points with like normals.

    Parameters
    ----------
    deformed : Mesh
    areas : (N,) float, square metres
        Weight of every vertex.
    reach : float, metres
        Points farther away do not count; the weight falls to zero towards it.
    slide : float
        Force along the surface as a share of that across it.
    scale : float, metres
        How much distance a difference of normals is worth.
    trust : (N,) float
        Further weight of every vertex.
    """
    x = deformed.vertices
    found = OrientedPoints(skin.points, skin.normals, scale).match(x, deformed.vertex_normals, reach)
    # At the edge of a hole a point speaks for its own neighbourhood, not for what lies beyond the edge.
    beside = np.linalg.norm(np.cross(skin.normals[found.index], x - skin.points[found.index]), axis=1)
    v = np.flatnonzero(found.valid & (~skin.border[found.index] | (beside <= skin.spacing)))
    p = found.index[v]
    weights = areas[v] * trust[v] * np.maximum(1 - (found.distances[v] / reach) ** 2, 0) ** 2
    distances = np.full(len(x), np.nan)
    distances[v] = np.abs(np.einsum("nd,nd->n", skin.normals[p], x[v] - skin.points[p]))
    return Touch(pull(len(x), v, skin.points[p], weights, skin.normals[p], slide), np.isfinite(distances), distances)


def oriented(target: Target, deformed: Mesh, scale: float) -> Target:
    """The target with outward normals, from the template where the scan does not know."""
    return orient(target, deformed, scale)
