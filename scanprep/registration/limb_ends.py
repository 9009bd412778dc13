"""Ends of a body rotated about themselves: a head that looks elsewhere is out of reach of nearest points."""
from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.spatial import cKDTree

from ..geometry import rotations
from ..geometry.geodesics import SurfaceGraph
from ..geometry.mesh import Mesh
from ..geometry.target import Target
from .matches import NORMALS


@dataclass(frozen=True, eq=False)
class End:
    """An end of a body: its vertices, and the direction in which it points away from the rest."""

    vertices: np.ndarray
    axis: np.ndarray


@lru_cache(maxsize=4)
def find_ends(template: Mesh, count: int, radius: float) -> tuple[End, ...]:
    """The `count` places farthest from all others along the surface, with all within `radius` (metres)."""
    surface = SurfaceGraph(template)
    tips = surface.farthest_points(count, first=int(surface.farthest_points(2)[1]))
    ends = []
    for distance in surface.distances(tips):
        inside = np.flatnonzero(distance <= radius)
        rim = inside[distance[inside] > 0.8 * radius]
        axis = template.vertices[inside].mean(axis=0) - template.vertices[rim].mean(axis=0) if len(rim) else np.zeros(3)
        if np.linalg.norm(axis) > 1e-3 * radius:
            ends.append(End(inside, axis / np.linalg.norm(axis)))
    return tuple(ends)


def rotated_end(template: Mesh, end: End, x: np.ndarray, scan: RigidFit, moved: float = 0.01
                ) -> np.ndarray | None:
    """Places (n, 3) of the vertices of an end after the rotation that fits best as a rigid piece.

    None where that is no farther than `moved`, a share of the template's size, from where they are.
    """
    rest, middle = template.vertices[end.vertices], x[end.vertices].mean(axis=0)
    R, _ = rotations.procrustes(rest, x[end.vertices])
    sample = np.linspace(0, len(rest) - 1, min(120, len(rest))).astype(int)
    local, normals = rest - rest.mean(axis=0), template.vertex_normals[end.vertices]
    found = []
    for angle in (0.0, 0.5, 1.0, -0.5, -1.0):        # radians: nearest points find what is half a step away
        start = rotations.exp(angle * (R @ end.axis)) @ R
        rotation, place, error = scan.fitted(local[sample], normals[sample], start, middle)
        found.append((error, local @ rotation.T + place))
    best = int(np.argmin([error for error, _ in found]))
    apart = np.linalg.norm(found[best][1] - x[end.vertices], axis=1).mean()
    return found[best][1] if apart > moved * scan.size else None


def bending(rest: np.ndarray, now: np.ndarray, weights: np.ndarray | None = None) -> tuple[float, float]:
    """How far points (n, 3) are from the nearest enlarged copy of others, metres RMS; and the logarithm of its growth.

    Weights (n,) by default are alike.
    """
    w = np.full(len(rest), 1 / len(rest)) if weights is None else weights / weights.sum()
    rest, now = rest - w @ rest, now - w @ now
    turned = rest @ rotations.procrustes(rest, now)[0].T
    growth = np.einsum("n,nd,nd->", w, turned, now) / np.einsum("n,nd,nd->", w, turned, turned)
    return float(np.sqrt(w @ ((now - growth * turned) ** 2).sum(axis=1))), float(np.log(max(growth, 1e-3)))


class RigidFit:
    """A scan that rigid pieces of a template of some size are laid on; errors do not grow beyond `cap`, metres."""

    def __init__(self, target: Target, size: float) -> None:
        self.target, self.size, self.scale, self.cap = target, size, NORMALS * size, 0.035 * size
        self.tree = cKDTree(np.hstack([target.points, self.scale * target.normals]))

    def nearest(self, x: np.ndarray, n: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Points and normals (n, 3) of the scan nearest to others, and which of them are near and on no border."""
        index = self.tree.query(np.hstack([x, self.scale * n]))[1]
        y, m = self.target.points[index], self.target.normals[index]
        near = np.linalg.norm(y - x, axis=1) <= 2 * self.cap
        return y, m, near & ~self.target.border[index]

    def error(self, x: np.ndarray, n: np.ndarray) -> np.ndarray:
        """Squared error (n,) of points with normals: across the surface and of the normals, at most `cap`²."""
        y, m, good = self.nearest(x, n)
        off = np.einsum("nd,nd->n", m, x - y) ** 2 + self.scale**2 * ((n - m) ** 2).sum(axis=1)
        return np.where(good, np.minimum(off, self.cap**2), self.cap**2)

    def fitted(self, local: np.ndarray, normals: np.ndarray, R: np.ndarray, place: np.ndarray
               ) -> tuple[np.ndarray, np.ndarray, float]:
        """A rigid piece after some rounds of nearest points: its rotation, its place, its mean error."""
        for _ in range(8):
            x, n = local @ R.T + place, normals @ R.T
            y, m, good = self.nearest(x, n)
            if good.sum() < 6:
                break
            arm = x - place
            J = np.hstack([np.cross(arm, m), m])[good]
            H = J.T @ J
            step = -np.linalg.solve(H + 1e-6 * np.trace(H) * np.eye(6),
                                    J.T @ np.einsum("nd,nd->n", m, x - y)[good])
            R, place = rotations.exp(step[:3]) @ R, place + step[3:]
        return R, place, float(self.error(local @ R.T + place, normals @ R.T).mean())
