"""Latent markers: how a marker is attached to the skin, and follows it from the latent pose into other poses.

A marker is attached to three supports, points of the skin, by three coefficients. Only the supports depend on betas, so
the coefficients are the unknowns: the place in the latent coordinate system follows from them.
"""
from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from model.fitting.energy import MovingPoints
from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface, barycentric

from ..pose.marked_body import pad_combinations, ring_around

Attachment = Literal["triangle", "neighbourhood"]


@dataclass(frozen=True, eq=False)
class LatentMarkers:
    """Attached markers: three supports each, as combinations of vertices (3L, k), and the nearest triangle (L, 3)."""

    kind: Attachment
    ids: np.ndarray
    weights: np.ndarray
    corners: np.ndarray

    def supports(self, vertices: np.ndarray) -> np.ndarray:
        """Compute the supports (..., 3L, 3) on a surface with vertices (..., N, 3)."""
        return np.einsum("lk,...lkd->...ld", self.weights, vertices[..., self.ids, :])

    def coefficients(self, vertices: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Solve for coefficients (L, 3) that put markers at points (L, 3), metres, in the latent pose. [MoSh] Eq. 16"""
        origin, frame = _frames(self.kind, self.supports(vertices))
        return np.linalg.solve(frame, (points - origin)[..., None])[..., 0]

    def places(self, vertices: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
        """Compute the places (..., L, 3) of the markers on a surface with vertices (..., N, 3). [MoSh] Eq. 16"""
        origin, frame = _frames(self.kind, self.supports(vertices))
        return origin + (frame @ coefficients[..., None])[..., 0]


def latent_markers(mesh: Mesh, points: np.ndarray, kind: Attachment = "triangle") -> LatentMarkers:
    """Attach points (L, 3), metres, to the nearest places of a mesh, the body in the latent pose.

    "triangle" uses the frame of the nearest triangle: edge, normal and their cross product. "neighbourhood" uses sums
    of the edges of the nearest vertex.

    [MoSh] Eq. 1, Eq. 15
    """
    closest = Surface(mesh).closest(points)
    corners = np.asarray(mesh.faces[closest.faces])
    if kind == "triangle":
        return LatentMarkers(kind, corners.reshape(-1, 1), np.ones((corners.size, 1)), corners)
    if kind != "neighbourhood":
        raise ValueError(f"attachment: expected triangle or neighbourhood, got {kind!r}")
    # the nearest corner of each triangle, and the supports from its ring
    distance = np.linalg.norm(mesh.vertices[corners] - points[:, None], axis=2)
    nearest = np.take_along_axis(corners, distance.argmin(axis=1)[:, None], axis=1)[:, 0]
    # the vertex, and two sums of its edges, of least norm, that are unit vectors of its plane [MoSh] Eq. 2, Eq. 3
    rows = []
    for centre in nearest.tolist():
        ring, plane = ring_around(mesh, centre)
        shares = np.linalg.pinv(plane).T                                                             # (n, 2)
        ids = np.concatenate([[centre], ring])
        rows += [(ids[:1], np.ones(1)), *((ids, np.concatenate([[1 - share.sum()], share])) for share in shares.T)]
    return LatentMarkers(kind, *pad_combinations(rows), corners)


def _frames(kind: Attachment, supports: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute origins (..., L, 3) and frames (..., L, 3, 3), axes in columns, from supports (..., 3L, 3)."""
    p = supports.reshape(*supports.shape[:-2], -1, 3, 3)
    a, b = p[..., 1, :] - p[..., 0, :], p[..., 2, :] - p[..., 0, :]
    c = np.cross(a, b)
    n = c / np.linalg.norm(c, axis=-1, keepdims=True)
    if kind == "triangle":
        a = a / np.linalg.norm(a, axis=-1, keepdims=True)
        b = np.cross(n, a)
    return p[..., 0, :], np.stack([a, b, n], axis=-1)


def simulate_markers(kind: Attachment, supports: MovingPoints, coefficients: np.ndarray) -> tuple[MovingPoints,
                                                                                                  np.ndarray]:
    """Compute simulated markers on 3L supports, and their derivative (..., L, 3, 3) by their own coefficients.

    [MoSh] Eq. 4, Eq. 16
    """
    origin, frame = _frames(kind, supports.positions)
    by_supports = _by_supports(kind, supports.positions, frame, coefficients)
    J = supports.jacobian
    J = by_supports @ J.reshape(*J.shape[:-3], -1, 9, J.shape[-1])
    return MovingPoints(origin + (frame @ coefficients[..., None])[..., 0], J), frame


def _by_supports(kind: Attachment, supports: np.ndarray, frame: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Compute the derivative (..., L, 3, 9) of the markers by their three supports (..., 3L, 3)."""
    p = supports.reshape(*supports.shape[:-2], -1, 3, 3)
    a, b = p[..., 1, :] - p[..., 0, :], p[..., 2, :] - p[..., 0, :]
    eye, n = np.eye(3), frame[..., :, 2]
    area = np.linalg.norm(np.cross(a, b), axis=-1)[..., None, None]
    # the unit normal n = a × b / |a × b|: its derivatives by the edges a and b
    tangent = (eye - n[..., :, None] * n[..., None, :]) / area
    n_a, n_b = -tangent @ rotations.hat(b), tangent @ rotations.hat(a)
    # m̂ = p + c1 e1 + c2 e2 + c3 n, with e1 = a / |a|, e2 = n × e1 for a triangle, else e1 = a, e2 = b
    c1, c2, c3 = (c[..., i, None, None] for i in range(3))
    if kind == "triangle":
        e = frame[..., :, 0]
        e_a = (eye - e[..., :, None] * e[..., None, :]) / np.linalg.norm(a, axis=-1)[..., None, None]
        lift = c3 * eye - c2 * rotations.hat(e)                                          # n × e by n is -hat(e)
        by_a = (c1 * eye + c2 * rotations.hat(n)) @ e_a + lift @ n_a
        by_b = lift @ n_b
    else:
        by_a, by_b = c1 * eye + c3 * n_a, c2 * eye + c3 * n_b
    return np.concatenate([eye - by_a - by_b, by_a, by_b], axis=-1)


def above_triangles(points: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute signed distances (n,) of points (n, 3) from triangles (n, 3, 3), one each, and their derivatives.

    The nearest point keeps its barycentric weights to first order, so each corner moves it by its weight. [MoSh] Eq. 18
    """
    share = barycentric(points, corners)
    nearest = np.einsum("nc,ncd->nd", share, corners)
    best = np.where((share >= 0).all(axis=1), np.linalg.norm(points - nearest, axis=1), np.inf)
    inside = np.isfinite(best)
    # outside the triangle the nearest point lies on one of its three edges
    for i, j in ((0, 1), (1, 2), (2, 0)):
        edge = corners[:, j] - corners[:, i]
        t = np.einsum("nd,nd->n", points - corners[:, i], edge) / np.einsum("nd,nd->n", edge, edge)
        t = np.clip(t, 0, 1)
        far = np.linalg.norm(points - corners[:, i] - t[:, None] * edge, axis=1)
        better = (far < best) & ~inside
        best = np.where(better, far, best)
        share[better] = 0
        share[better, i], share[better, j] = 1 - t[better], t[better]
    # positive on the side of the normal; on the surface itself the direction is the normal
    off = points - np.einsum("nc,ncd->nd", share, corners)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    values = np.where(np.einsum("nd,nd->n", off, normal) < 0, -best, best)
    far = best > 1e-9
    direction = np.where(far[:, None], off / np.where(far, values, 1.0)[:, None], normal)
    return values, direction, -share[..., None] * direction[:, None]
