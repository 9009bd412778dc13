"""The ends of a body turned about themselves: a head that looks elsewhere is out of reach of nearest points."""
from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.spatial import cKDTree

from ..geometry import rotations
from ..geometry.geodesics import SurfaceGraph
from ..geometry.mesh import Mesh
from ..ranges import Count, Positive, Settings
from .matches import Target


@dataclass(frozen=True)
class TwistConfig(Settings):
    """Settings of the search for ends that are turned about themselves.

    Attributes
    ----------
    ends : int
        How many of the places farthest from all others are tried; 0 leaves the search out.
    radius : float
        Size of an end along the surface, as a multiple of the template's size.
    angles : floats, radians
        Turns that are tried both ways.
    points : int
        Vertices of an end that are compared with the scan.
    rounds : int
        Of nearest points after each turn.
    cap : float
        Distance beyond which an error does not grow, as a multiple of the size.
    moved : float
        An end is followed up when as a rigid piece it lies this far from where it is, as a multiple of the size.
    """

    ends: int = 5
    radius: Positive = 0.14
    angles: tuple[Positive, ...] = (0.5, 1.0)
    points: Count = 120
    rounds: int = 8
    cap: Positive = 0.035
    moved: float = 0.01


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


def mismatch(deformed: Mesh, sample: np.ndarray, target: Target, scale: float, cap: float) -> np.ndarray:
    """Squared error (n,) of vertices against the scan: across the surface and of the normals, at most `cap`²."""
    return _Scan(target, scale, cap).error(deformed.vertices[sample], deformed.vertex_normals[sample])


def turned_end(template: Mesh, end: End, x: np.ndarray, target: Target, scale: float, config: TwistConfig,
               size: float) -> np.ndarray | None:
    """Where the vertices of an end lie after the turn that fits best as a rigid piece, if that is elsewhere.

    Returns
    -------
    (n, 3) float, metres, or None
    """
    scan = _Scan(target, scale, config.cap * size)
    rest, middle = template.vertices[end.vertices], x[end.vertices].mean(axis=0)
    R, _ = rotations.procrustes(rest, x[end.vertices])
    sample = np.linspace(0, len(rest) - 1, min(config.points, len(rest))).astype(int)
    local, normals = rest - rest.mean(axis=0), template.vertex_normals[end.vertices]
    found = []
    for angle in (0.0, *config.angles, *(-a for a in config.angles)):
        turn = rotations.exp(angle * (R @ end.axis)) @ R
        turn, place, error = scan.settled(local[sample], normals[sample], turn, middle, config.rounds)
        found.append((error, local @ turn.T + place))
    best = int(np.argmin([error for error, _ in found]))
    moved = np.linalg.norm(found[best][1] - x[end.vertices], axis=1).mean()
    return found[best][1] if moved > config.moved * size else None


class _Scan:
    """A scan that rigid pieces are laid on."""

    def __init__(self, target: Target, scale: float, cap: float) -> None:
        self.target, self.scale, self.cap = target, scale, cap
        self.tree = cKDTree(np.hstack([target.points, scale * target.normals]))

    def nearest(self, x: np.ndarray, n: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        index = self.tree.query(np.hstack([x, self.scale * n]))[1]
        y, m = self.target.points[index], self.target.normals[index]
        near = np.linalg.norm(y - x, axis=1) <= 2 * self.cap
        return y, m, near & ~self.target.border[index]

    def error(self, x: np.ndarray, n: np.ndarray) -> np.ndarray:
        y, m, good = self.nearest(x, n)
        off = np.einsum("nd,nd->n", m, x - y) ** 2 + self.scale**2 * ((n - m) ** 2).sum(axis=1)
        return np.where(good, np.minimum(off, self.cap**2), self.cap**2)

    def settled(self, local: np.ndarray, normals: np.ndarray, R: np.ndarray, place: np.ndarray, rounds: int
                ) -> tuple[np.ndarray, np.ndarray, float]:
        """A rigid piece after some rounds of nearest points: its turn, its place, its mean error."""
        for _ in range(rounds):
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
