"""Try other rotations of the ends of a body: rolled about their axis or bent at their base.

Nearest points cannot correct a head that looks elsewhere. Nor can they correct a hand bent at the wrist whose fingers
have no landmark.
"""
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
    """An end of a body (head, hand, foot): its vertices, those at its base, and the axis (3,) away from the body."""

    vertices: np.ndarray
    base: np.ndarray
    axis: np.ndarray


@lru_cache(maxsize=4)
def find_ends(template: Mesh, count: int, radius: float) -> tuple[End, ...]:
    """Find `count` ends of a body: the points farthest apart along the surface, and all within `radius` (metres)."""
    surface = SurfaceGraph(template)
    tips = surface.farthest_points(count, first=int(surface.farthest_points(2)[1]))
    ends = []
    for distance in surface.distances(tips):
        inside = np.flatnonzero(distance <= radius)
        # the base is the outer fifth; a piece without a clear axis is no end
        rim = inside[distance[inside] > 0.8 * radius]
        axis = template.vertices[inside].mean(axis=0) - template.vertices[rim].mean(axis=0) if len(rim) else np.zeros(3)
        if np.linalg.norm(axis) > 1e-3 * radius:
            ends.append(End(inside, rim, axis / np.linalg.norm(axis)))
    return tuple(ends)


def rotate_ends(template: Mesh, end: End, x: np.ndarray, scan: RigidFit) -> list[np.ndarray]:
    """Fit an end of the body rigidly to the scan from several rotations: at most two candidate positions (n, 3) each.

    One candidate may slide along the body, the other is attached to its base. When a bent hand is mostly hidden, a
    freely sliding hand fits the arm best. Candidates within a hundredth of the template's size of the current
    position or of each other are left out.
    """
    rest, middle = template.vertices[end.vertices], x[end.vertices].mean(axis=0)
    R, _ = rotations.procrustes(rest, x[end.vertices])
    # 120 points are enough for six unknowns and keep the many starts fast
    sample = np.linspace(0, len(rest) - 1, min(120, len(rest))).astype(int)
    local, normals = rest - rest.mean(axis=0), template.vertex_normals[end.vertices]
    base, local_base = x[end.base].mean(axis=0), template.vertices[end.base].mean(axis=0) - rest.mean(axis=0)
    kept = [x[end.vertices]]
    # weight of the base against all other points: first free to slide, then attached
    for weight in (0.0, 0.5):
        fits = []
        for turn, pivot in _starts(R @ end.axis, middle, base):
            start = rotations.exp(turn)
            place = pivot + start @ (middle - pivot)
            rotation, place, error = scan.fit(local[sample], normals[sample], start @ R, place, local_base, base,
                                              weight)
            fits.append((error, local @ rotation.T + place))
        best = fits[int(np.argmin([error for error, _ in fits]))][1]
        if all(np.linalg.norm(best - other, axis=1).mean() > 0.01 * scan.size for other in kept):
            kept.append(best)
    return kept[1:]


def _starts(axis: np.ndarray, middle: np.ndarray, base: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return rotation vectors (3,) to start from, each with its fixed point (3,): rolls, then bends at the base.

    Steps are half a radian, so that nearest points only have to find what is a quarter of a radian away.
    """
    across = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    across /= np.linalg.norm(across)
    around = [np.cos(angle) * across + np.sin(angle) * np.cross(axis, across) for angle in np.arange(4) * np.pi / 2]
    rolls = [(angle * axis, middle) for angle in (0.0, 0.5, 1.0, -0.5, -1.0)]
    # bends of 0.8 radians at the base, to four sides
    return [*rolls, *((0.8 * way, base) for way in around)]


def bending(rest: np.ndarray, now: np.ndarray, weights: np.ndarray | None = None) -> tuple[float, float]:
    """Measure how far points (n, 3) are from a scaled rigid copy of others: metres RMS, and the log of the scale.

    Weights (n,) are equal by default.
    """
    w = np.full(len(rest), 1 / len(rest)) if weights is None else weights / weights.sum()
    # best similarity: centroids, Procrustes rotation, then the least-squares scale
    rest, now = rest - w @ rest, now - w @ now
    turned = rest @ rotations.procrustes(rest, now)[0].T
    growth = np.einsum("n,nd,nd->", w, turned, now) / np.einsum("n,nd,nd->", w, turned, turned)
    return float(np.sqrt(w @ ((now - growth * turned) ** 2).sum(axis=1))), float(np.log(max(growth, 1e-3)))


class RigidFit:
    """Rigid ICP of pieces of a template, of some size, to a scan; errors are capped at `cap`, metres."""

    def __init__(self, target: Target, size: float) -> None:
        # errors are capped at 3.5% of the size, about 5 cm on a person, so that missing data cannot dominate
        self.target, self.size, self.scale, self.cap = target, size, NORMALS * size, 0.035 * size
        self.tree = cKDTree(np.hstack([target.points, self.scale * target.normals]))

    def nearest(self, x: np.ndarray, n: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Find the nearest points and normals (n, 3) of the scan, and which are near and on no border."""
        index = self.tree.query(np.hstack([x, self.scale * n]))[1]
        y, m = self.target.points[index], self.target.normals[index]
        near = np.linalg.norm(y - x, axis=1) <= 2 * self.cap
        return y, m, near & ~self.target.border[index]

    def error(self, x: np.ndarray, n: np.ndarray) -> np.ndarray:
        """Return squared errors (n,) of points with normals: across the surface plus of the normals, at most `cap`²."""
        y, m, good = self.nearest(x, n)
        off = np.einsum("nd,nd->n", m, x - y) ** 2 + self.scale**2 * ((n - m) ** 2).sum(axis=1)
        return np.where(good, np.minimum(off, self.cap**2), self.cap**2)

    def fit(self, local: np.ndarray, normals: np.ndarray, R: np.ndarray, place: np.ndarray, local_base: np.ndarray,
            base: np.ndarray, weight: float) -> tuple[np.ndarray, np.ndarray, float]:
        """Fit a rigid piece by point-to-plane ICP: its rotation, its place, its mean error.

        Its own point `local_base` (3,) should stay at `base` (3,), metres. `weight` is the weight of that against all
        its other points together.
        """
        held = np.sqrt(weight * len(local))
        # Gauss-Newton on the six unknowns of a rigid motion; eight rounds, fewer when too few points are near
        for _ in range(8):
            x, n = local @ R.T + place, normals @ R.T
            y, m, good = self.nearest(x, n)
            if good.sum() < 6:
                break
            J = np.vstack([np.hstack([np.cross(x - place, m), m])[good],
                           held * np.hstack([np.cross(R @ local_base, np.eye(3)), np.eye(3)])])
            off = np.append(np.einsum("nd,nd->n", m, x - y)[good], held * (R @ local_base + place - base))
            H = J.T @ J
            step = -np.linalg.solve(H + 1e-6 * np.trace(H) * np.eye(6), J.T @ off)
            R, place = rotations.exp(step[:3]) @ R, place + step[3:]
        slid = weight * ((R @ local_base + place - base) ** 2).sum()
        return R, place, float(self.error(local @ R.T + place, normals @ R.T).mean() + slid)
