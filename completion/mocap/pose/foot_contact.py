"""Feet on the floor: what touches it neither sinks nor slides."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from scanprep.geometry.farthest_points import farthest_points
from scanprep.geometry.least_squares import Dense

from .marked_body import MarkedBody, point_system, stretches
from .part_shapes import part_shapes

TOUCH = 0.025                        # metres above the floor below which a point may stand


@dataclass(frozen=True, eq=False)
class Floor:
    """A plane to stand on: its unit normal (3,) points up, its height along that is in metres."""

    normal: np.ndarray
    height: float

    @staticmethod
    def from_numbers(numbers: tuple[float, float, float, float]) -> Floor:
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
        flat, support = np.delete(vertices, axis, axis=2), []
        for sign, end in ((1.0, low), (-1.0, high)):
            # how far the feet, or the top of the head, reach sideways, on average over the frames
            height = sign * vertices[..., axis] - (sign * vertices[..., axis]).min(axis=1, keepdims=True)
            near = height < 0.06 * height.max()
            breadth = np.mean([np.linalg.norm(np.ptp(v[some], axis=0)) for v, some in zip(flat, near, strict=True)])
            support.append(float(breadth) / (np.subtract(*np.percentile(end[:, axis], [75, 25])) + 0.005))
        sign = 1.0 if support[0] >= support[1] else -1.0
        end = low[:, axis] if sign > 0 else -high[:, axis]
        return Floor(sign * np.eye(3)[axis], float(np.percentile(end, 20)))

    def above(self, points: np.ndarray) -> np.ndarray:
        """Height (...) of points (..., 3) above the floor, metres."""
        return points @ self.normal - self.height


class FootContact:
    """The soles of a body over a motion x (T, P), and where they stand, on the floor of `AnimateConfig.floor`.

    A floor that is not given is found below the body.
    """

    def __init__(self, body: MarkedBody, x: np.ndarray, rate: float,
                 floor: tuple[float, float, float, float] | None = None) -> None:
        self.body, subject = body, body.body.subject
        pose, trans, _ = body.body.split(x[np.unique(np.linspace(0, len(x) - 1, 150).astype(int))])
        vertices = subject.vertices(pose, trans)
        self.floor = Floor.below(vertices) if floor is None else Floor.from_numbers(floor)
        # the soles: at most 24 vertices spread over what comes near the floor, and the lowest of every frame, as heels
        # are round
        rest, height = subject.template.vertices, self.floor.above(vertices)
        near = np.flatnonzero((height < TOUCH).mean(axis=0) > 0.05)
        near = near if len(near) else np.array([int(height.min(axis=0).argmin())])
        spread = farthest_points(rest[near], 24, height[:, near].mean(axis=0).argmin())
        self.shapes = part_shapes(subject.points(near[np.union1d(spread, height[:, near].argmin(axis=1))]))
        self.stands = self._standing_places(self._points(x), rate)

    def target_positions(self, x: np.ndarray) -> np.ndarray:
        """Where the soles are held (T, K, 3), metres: where they stand, and out of the floor if they sank into it.

        NaN where they are free, at unknowns (T, P).
        """
        points = self._points(x)
        height = self.floor.above(points)
        lifted = points - height[..., None] * self.floor.normal
        return np.where(np.isnan(self.stands) & (height < 0)[..., None], lifted, self.stands)

    def system(self, x: np.ndarray, targets: np.ndarray, weights: np.ndarray, places: np.ndarray) -> Dense:
        """As `MarkedBody.system`, with the soles at places (B, K, 3) or, where NaN, free."""
        return self.hold(self.body.system(x, targets, weights), x, places)

    def hold(self, equations: Dense, x: np.ndarray, places: np.ndarray) -> Dense:
        """Equations of frames x (B, P), and those of soles that are at places (B, K, 3)."""
        # metres that a standing point may be from its place
        more = point_system(*self.shapes.columns(*self.body.body.split(x)[:2]), places,
                            np.full(places.shape[:2], 0.002**-2))
        return Dense(*(mine + added for mine, added in zip(equations, more, strict=True)))

    def _points(self, x: np.ndarray) -> np.ndarray:
        """The soles (T, K, 3), metres."""
        pose, trans, _ = self.body.body.split(x)
        return self.shapes.evaluate(pose, trans).swapaxes(-1, -2)

    def _standing_places(self, points: np.ndarray, rate: float) -> np.ndarray:
        """Places (T, K, 3) where points stand, NaN where they move freely."""
        held = np.full(points.shape, np.nan)
        # places are averaged over 0.15 s to tell their speed; who stands does so for 0.08 s at least, below 0.2 m/s
        calm = uniform_filter1d(points, max(1, round(0.15 * rate)), axis=0, mode="nearest")
        speed = np.linalg.norm(np.gradient(calm, axis=0), axis=2) * rate
        stands = (self.floor.above(calm) < TOUCH) & (speed < 0.2)
        for k in range(points.shape[1]):
            for mine in stretches(np.flatnonzero(stands[:, k])):
                if len(mine) >= 0.08 * rate:
                    place = np.median(points[mine, k], axis=0)
                    held[mine, k] = place - min(0.0, float(self.floor.above(place))) * self.floor.normal
        return held
