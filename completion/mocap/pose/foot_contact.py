"""Feet on the floor: what touches it neither sinks nor slides."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from scanprep.geometry.farthest_points import farthest_points
from scanprep.geometry.least_squares import Dense

from .marked_body import MarkedBody, point_system
from .part_shapes import PartShapes, part_shapes
from .robust import runs

TOUCH = 0.025                        # metres above the floor below which a point may stand
STILL = 0.2                          # metres per second below which it does


@dataclass(frozen=True, eq=False)
class Floor:
    """A plane to stand on: its unit normal (3,) points up, its height along that is in metres."""

    normal: np.ndarray
    height: float

    @staticmethod
    def given(numbers: tuple[float, float, float, float]) -> Floor:
        """From a normal, not zero, and a height."""
        length = float(np.linalg.norm(numbers[:3]))
        if not (length > 0 and np.isfinite(numbers).all()):
            raise ValueError(f"floor: expected a normal and a height, got {numbers}")
        return Floor(np.array(numbers[:3]) / length, float(numbers[3]))

    @staticmethod
    def below(vertices: np.ndarray) -> Floor:
        """The floor under a moving body (n, N, 3), metres; for who lies or sits it should be given.

        Up is the world axis along which the body is longest; down is the end that is broad and stays level, to 5 mm.
        """
        low, high = vertices.min(axis=1), vertices.max(axis=1)
        axis = int((high - low).mean(axis=0).argmax())
        support = [_breadth(sign * vertices, axis) / (np.subtract(*np.percentile(end[:, axis], [75, 25])) + 0.005)
                   for sign, end in ((1, low), (-1, high))]
        sign = 1.0 if support[0] >= support[1] else -1.0
        end = low[:, axis] if sign > 0 else -high[:, axis]
        return Floor(sign * np.eye(3)[axis], float(np.percentile(end, 20)))

    def above(self, points: np.ndarray) -> np.ndarray:
        """Height (...) of points (..., 3) above the floor, metres."""
        return points @ self.normal - self.height


def _breadth(vertices: np.ndarray, axis: int) -> float:
    """How far the low end of a body (n, N, 3) along an axis reaches sideways, on average over the frames, metres."""
    height = vertices[..., axis] - vertices[..., axis].min(axis=1, keepdims=True)
    near = height < 0.06 * height.max()                                 # the feet, or the top of the head
    flat = np.delete(vertices, axis, axis=2)
    return float(np.mean([np.linalg.norm(np.ptp(v[some], axis=0)) for v, some in zip(flat, near, strict=True)]))


@dataclass(frozen=True, eq=False)
class HeldPoints:
    """Points of a body that are to be at places (T, K, 3), metres; NaN where they are free."""

    shapes: PartShapes
    places: np.ndarray

    def of(self, frames: slice) -> HeldPoints:
        """Those of some frames."""
        return HeldPoints(self.shapes, self.places[frames])

    def system(self, pose: np.ndarray, trans: np.ndarray, frames: slice) -> Dense:
        """The equations of some frames."""
        places = self.places[frames]
        # metres that a standing point may be from its place
        return point_system(*self.shapes.columns(pose, trans), places, np.full(places.shape[:2], 0.002**-2))


class FootContact:
    """The soles of a body over a motion x (T, P), and where they stand; a floor that is not given is found below it."""

    def __init__(self, body: MarkedBody, x: np.ndarray, rate: float, floor: Floor | None = None) -> None:
        self.body, subject = body, body.body.subject
        pose, trans, _ = body.body.split(x[np.unique(np.linspace(0, len(x) - 1, 150).astype(int))])
        vertices = subject.vertices(pose, trans)
        self.floor = floor or Floor.below(vertices)
        self.shapes = part_shapes(subject.points(_soles(subject.template.vertices, self.floor.above(vertices))))
        self.stands = self._standing_places(self._points(x), rate)

    def held(self, x: np.ndarray) -> HeldPoints:
        """Where the soles are held at unknowns (T, P): where they stand, and out of the floor if they sank into it."""
        points = self._points(x)
        height = self.floor.above(points)
        lifted = points - height[..., None] * self.floor.normal
        return HeldPoints(self.shapes, np.where(np.isnan(self.stands) & (height < 0)[..., None], lifted, self.stands))

    def _points(self, x: np.ndarray) -> np.ndarray:
        """The soles (T, K, 3), metres."""
        pose, trans, _ = self.body.body.split(x)
        return self.shapes.evaluate(pose, trans).swapaxes(-1, -2)

    def _standing_places(self, points: np.ndarray, rate: float) -> np.ndarray:
        """Places (T, K, 3) where points stand, NaN where they move freely."""
        held = np.full(points.shape, np.nan)
        # places are averaged over 0.15 s to tell their speed; who stands does so for 0.08 s at least
        calm = uniform_filter1d(points, max(1, round(0.15 * rate)), axis=0, mode="nearest")
        speed = np.linalg.norm(np.gradient(calm, axis=0), axis=2) * rate
        stands = (self.floor.above(calm) < TOUCH) & (speed < STILL)
        for k in range(points.shape[1]):
            for mine in runs(stands[:, k]):
                if len(mine) >= 0.08 * rate:
                    place = np.median(points[mine, k], axis=0)
                    held[mine, k] = place - min(0.0, float(self.floor.above(place))) * self.floor.normal
        return held


def _soles(rest: np.ndarray, height: np.ndarray) -> np.ndarray:
    """At most 24 vertices (K,) spread over what comes near the floor, from heights (n, N) over it."""
    near = np.flatnonzero((height < TOUCH).mean(axis=0) > 0.05)
    if not len(near):
        near = np.array([int(height.min(axis=0).argmin())])
    return near[farthest_points(rest[near], 24, height[:, near].mean(axis=0).argmin())]
