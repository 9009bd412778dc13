"""Implicit surfaces: lofted tubes, round cones and ellipsoids, joined smoothly, with soft bumps on top.

All functions take points (n, 3) in metres and give an approximate signed distance (n,), negative inside.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import igl
import numpy as np

from scanprep.geometry.mesh import Mesh

Field = Callable[[np.ndarray], np.ndarray]


class RoundCone:
    """The hull of two spheres."""

    def __init__(self, a: np.ndarray, b: np.ndarray, radius_a: float, radius_b: float) -> None:
        self.a, self.b, self.ra, self.rb = np.asarray(a), np.asarray(b), radius_a, radius_b
        self.axis = self.b - self.a
        self.squared = float(self.axis @ self.axis)

    def __call__(self, points: np.ndarray) -> np.ndarray:
        h = np.clip((points - self.a) @ self.axis / self.squared, 0, 1)
        away = points - self.a - h[:, None] * self.axis
        return np.sqrt((away * away).sum(axis=1)) - (self.ra + (self.rb - self.ra) * h)


class Ellipsoid:
    """An ellipsoid, its radii along the rows of a frame."""

    def __init__(self, centre: np.ndarray, radii: np.ndarray, frame: np.ndarray | None = None) -> None:
        self.centre, self.radii = np.asarray(centre), np.asarray(radii, dtype=np.float64)
        self.frame = np.eye(3) if frame is None else frame

    def __call__(self, points: np.ndarray) -> np.ndarray:
        local = (points - self.centre) @ self.frame.T / self.radii
        q = np.sqrt((local * local).sum(axis=1) + 1e-12)
        slope = np.sqrt(((local / self.radii)**2).sum(axis=1) + 1e-12)
        return np.where(q > 0.3, q * (q - 1) / slope, -self.radii.min() * (1 - q))


@dataclass(frozen=True)
class Bump:
    """A soft rise (height > 0) or hollow (height < 0) of the surface around a point."""

    centre: np.ndarray  # (3,) float, metres
    height: float  # metres
    widths: np.ndarray  # (3,) float, metres: standard deviations along the axes

    def __call__(self, points: np.ndarray) -> np.ndarray:
        out = np.zeros(len(points))
        near = np.flatnonzero(np.abs(points[:, 2] - self.centre[2]) < 4.5 * max(self.widths))
        local = (points[near] - self.centre) / self.widths
        out[near] = self.height * np.exp(-0.5 * np.minimum((local * local).sum(axis=1), 60))
        return out


def smooth_union(a: np.ndarray, b: np.ndarray, k: float) -> np.ndarray:
    """The union of two fields (n,), the seam rounded over about `k` metres."""
    h = np.maximum(k - np.abs(a - b), 0) / k
    return np.minimum(a, b) - h * h * (k / 4)


class Group:
    """Fields joined one after the other, each seam rounded over its k metres, with bumps on top."""

    def __init__(self, members: Sequence[tuple[Field, float]], bumps: Sequence[Bump] = ()) -> None:
        self.members, self.bumps = list(members), list(bumps)

    def __call__(self, points: np.ndarray) -> np.ndarray:
        d = self.members[0][0](points)
        for member, k in self.members[1:]:
            d = smooth_union(d, member(points), k)
        for bump in self.bumps:
            d = d - bump(points)
        return d


class Mirrored:
    """A field given for x >= 0, with its mirror image; rounded over `width` metres at x = 0."""

    def __init__(self, field: Field, width: float = 0.003) -> None:
        self.field, self.width = field, width

    def __call__(self, points: np.ndarray) -> np.ndarray:
        folded = points.copy()
        folded[:, 0] = np.sqrt(points[:, 0]**2 + self.width**2)
        return self.field(folded)


_TETRAHEDRON = np.array([[1, -1, -1], [-1, -1, 1], [-1, 1, -1], [1, 1, 1]], dtype=np.float64)


def value_and_gradient(field: Field, points: np.ndarray, step: float = 1e-4) -> tuple[np.ndarray, np.ndarray]:
    """Field (n,) and its gradient (n, 3) by differences over a small tetrahedron."""
    n = len(points)
    values = field((points[None] + step * _TETRAHEDRON[:, None]).reshape(-1, 3)).reshape(4, n)
    return values.mean(axis=0), np.einsum("kn,kd->nd", values, _TETRAHEDRON) / (4 * step)


def project(field: Field, points: np.ndarray, steps: int = 4, reach: float = 0.03) -> np.ndarray:
    """Points moved onto the zero surface along the gradient, Newton's method with a limited step."""
    points = points.copy()
    for _ in range(steps):
        value, gradient = value_and_gradient(field, points)
        squared = np.maximum((gradient * gradient).sum(axis=1), 0.05)
        step = -(value / squared)[:, None] * gradient
        length = np.linalg.norm(step, axis=1, keepdims=True)
        points += step * np.minimum(1, reach / np.maximum(length, 1e-12))
    return points


def polygonise(field: Field, low: np.ndarray, high: np.ndarray, step: float) -> Mesh:
    """The zero surface in a box by marching cubes, as a mesh; open where the box cuts it.

    Only cells near the surface are evaluated finely.
    """
    coarse = 6
    cells = np.ceil((high - low) / (coarse * step)).astype(int)
    axes = [low[d] + coarse * step * np.arange(cells[d] + 1) for d in range(3)]
    grid = np.stack(np.meshgrid(*axes[::-1], indexing="ij")[::-1], axis=-1)
    shape = grid.shape[:3]
    rough = field(grid.reshape(-1, 3)).reshape(shape)
    near = np.abs(rough) < 3.2 * coarse * step
    n = cells * coarse + 1
    fine_axes = [low[d] + step * np.arange(n[d]) for d in range(3)]
    index = [np.minimum((np.arange(n[d]) + coarse // 2) // coarse, cells[d]) for d in range(3)]
    pick = np.ix_(index[2], index[1], index[0])
    values, todo = rough[pick].copy(), near[pick]
    points = np.stack(np.meshgrid(*fine_axes[::-1], indexing="ij")[::-1], axis=-1)
    wanted = points[todo]
    values[todo] = np.concatenate([field(part) for part in np.array_split(wanted, max(1, len(wanted) // 200_000))])
    vertices, faces = igl.marching_cubes(values.reshape(-1), points.reshape(-1, 3), *n.tolist(), 0.0)[:2]
    mesh = Mesh(vertices, np.asarray(faces, dtype=np.int64))
    outside = field(mesh.corners.mean(axis=1) + 1e-3 * mesh.face_normals)
    return mesh if np.median(outside) > 0 else Mesh(vertices, mesh.faces[:, ::-1])
