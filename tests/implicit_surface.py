"""Implicit surfaces: lofted tubes, round cones and ellipsoids, joined smoothly, with soft bumps on top.

All functions take points (n, 3) in metres and give an approximate signed distance (n,), negative inside.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np


class Field(Protocol):
    """Anything that gives an approximate signed distance."""

    def __call__(self, points: np.ndarray) -> np.ndarray: ...


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
    widths: Sequence[float] | np.ndarray  # (3,) float, metres: standard deviations along the rows of `frame`
    frame: np.ndarray | None = None  # (3, 3) float, optional

    def __call__(self, points: np.ndarray) -> np.ndarray:
        out = np.zeros(len(points))
        near = np.flatnonzero(np.abs(points[:, 2] - self.centre[2]) < 4.5 * max(self.widths))
        local = points[near] - self.centre
        if self.frame is not None:
            local = local @ self.frame.T
        local = local / np.asarray(self.widths)
        out[near] = self.height * np.exp(-0.5 * np.minimum((local * local).sum(axis=1), 60))
        return out


def smooth_union(a: np.ndarray, b: np.ndarray, k: float) -> np.ndarray:
    """The union of two fields (n,), the seam rounded over about `k` metres."""
    h = np.maximum(k - np.abs(a - b), 0) / k
    return np.minimum(a, b) - h * h * (k / 4)


class Group:
    """Fields joined one after the other, each seam rounded over its k metres, evaluated only near themselves.

    Points outside the capsule `bounds` (two ends and a radius) get their distance to it.
    """

    MARGIN = 0.06

    def __init__(self, members: Sequence[tuple[Field, float]], bumps: Sequence[Bump] = (),
                 bounds: tuple[np.ndarray, np.ndarray, float] | None = None) -> None:
        self.members, self.bumps, self.bounds = list(members), list(bumps), bounds

    def __call__(self, points: np.ndarray) -> np.ndarray:
        if self.bounds is None:
            return self._evaluate(points)
        a, b, radius = self.bounds
        d = RoundCone(a, b, radius, radius)(points) + self.MARGIN
        near = np.flatnonzero(d < self.MARGIN)
        if len(near):
            d[near] = self._evaluate(points[near])
        return d

    def _evaluate(self, points: np.ndarray) -> np.ndarray:
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
