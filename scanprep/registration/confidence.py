"""How sure it is that there were data at each vertex, and how much of the scan is off the template."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ..geometry.mesh import Mesh
from ..geometry.surface import OrientedPoints, Surface
from ..geometry.target import Target, orient


@dataclass(frozen=True, eq=False)
class Evidence:
    """What the scan says of every vertex of a template that lies on it.

    The confidence (N,) goes from 0, no data here, to 1: a scanned surface lies here, faces the same way, does not end
    here, and its points find this part of the template too. Distances (N,), metres, are to the plane of the scan at the
    nearest point that faces the same way; NaN where that is too far.
    """

    confidence: np.ndarray
    distances: np.ndarray


def evidence(deformed: Mesh, target: Target, reach: float, scale: float) -> Evidence:
    """The data near every vertex of the template on the scan, weighed; farther away than `reach` (metres) are none.

    A difference of normals of one counts like a distance of `scale` metres.
    """
    target = orient(target, deformed, scale)
    x, normals = deformed.vertices, deformed.vertex_normals
    found = OrientedPoints(target.points, target.normals, scale).match(x, normals, reach)
    v = np.flatnonzero(found.valid)
    p = found.index[v]
    off = np.abs(np.einsum("nd,nd->n", target.normals[p], x[v] - target.points[p]))
    noise = 1.4826 * float(np.median(off)) if len(v) else 0.0
    near = np.exp(-0.5 * (np.maximum(off - 2 * noise, 0) / max(2 * noise, 0.05 * reach)) ** 2)
    facing = _ramp(np.einsum("nd,nd->n", target.normals[p], normals[v]), 0.5, 0.8)
    confidence = np.zeros(len(x))
    confidence[v] = near * facing * (_within(target, x, normals) * _found_back(deformed, target, reach, scale))[v]
    distances = np.full(len(x), np.nan)
    distances[v] = off
    return Evidence(confidence, distances)


def _within(target: Target, x: np.ndarray, normals: np.ndarray, neighbours: int = 8) -> np.ndarray:
    """(N,) from 0 to 1: points that face the same way lie close by, and not at the edge of a hole."""
    tree = cKDTree(target.points)
    apart, near = tree.query(x, min(neighbours, len(target.points)))
    spacing = float(np.median(tree.query(target.points, 2)[0][:, 1]))
    alike = np.einsum("nkd,nd->nk", target.normals[near], normals) > 0.3
    nearest = np.where(alike, apart, np.inf).min(axis=1)
    edge = (alike * target.border[near]).sum(axis=1) / np.maximum(alike.sum(axis=1), 1)
    return np.exp(-0.5 * (np.maximum(nearest - 2 * spacing, 0) / (2 * spacing)) ** 2) * (1 - _ramp(edge, 0.3, 0.9))


def _found_back(deformed: Mesh, target: Target, reach: float, scale: float) -> np.ndarray:
    """(N,) from 0 to 1: the scan's points choose this vertex, or its neighbours, as theirs."""
    tree = OrientedPoints(deformed.vertices, deformed.vertex_normals, scale)
    back = tree.match(target.points, target.normals, reach)
    hits = (np.bincount(back.index[back.valid], minlength=len(deformed.vertices)) > 0).astype(float)
    A = deformed.vertex_adjacency
    degree = np.maximum(np.asarray(A.sum(axis=1)).ravel(), 1)
    around = np.maximum(hits, (A @ hits) / degree)
    return _ramp(around, 0.1, 0.4)


def _ramp(value: np.ndarray, low: float, high: float) -> np.ndarray:
    return np.clip((value - low) / (high - low), 0, 1)


def uncovered_share(scan: Mesh | np.ndarray, registered: Mesh, far: float, samples: int = 5000) -> float:
    """Share of the points of a scan that lie further than `far` (metres) from a mesh."""
    points = scan.vertices if isinstance(scan, Mesh) else scan
    points = points[:: max(1, len(points) // samples)]
    return float((Surface(registered).closest(points).distances > far).mean())


def stretched_share(template: Mesh, registered: Mesh, factor: float = 2.0) -> float:
    """Share of the template's area that is longer by `factor`, or shorter, in some direction than the template."""
    long, short = principal_stretches(template, registered)
    return float(template.face_areas @ ((long > factor) | (short < 1 / factor)) / template.face_areas.sum())


def principal_stretches(template: Mesh, registered: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """The largest and the smallest stretch (F,) of every triangle."""
    rest, now = (m.corners[:, 1:] - m.corners[:, :1] for m in (template, registered))
    # edges of the template in an orthonormal basis of its triangle, as a lower triangular matrix
    gram = np.einsum("fid,fjd->fij", rest, rest)
    basis = np.linalg.inv(np.linalg.cholesky(gram + 1e-18 * np.eye(2)))
    metric = np.einsum("fij,fjd,fkd,flk->fil", basis, now, now, basis)
    squared = np.linalg.eigvalsh(metric)
    return np.sqrt(np.maximum(squared[:, 1], 0)), np.sqrt(np.maximum(squared[:, 0], 0))
