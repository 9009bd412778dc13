"""Foot contact: points that touch the floor neither sink nor slide."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from scanprep.geometry.farthest_points import farthest_points
from scanprep.geometry.least_squares import Dense

from .marked_body import MarkedBody, point_system, stretches
from .part_shapes import part_shapes


@dataclass(frozen=True, eq=False)
class Floor:
    """The floor plane: a unit normal (3,) that points up, and its height along the normal, metres."""

    normal: np.ndarray
    height: float

    @staticmethod
    def below(vertices: np.ndarray) -> Floor:
        """Estimate the floor under a moving body (n, N, 3), metres, of somebody who stands or walks.

        Up is the world axis along which the body is longest. Down is the end with the broader support at a more
        constant height.
        """
        low, high = vertices.min(axis=1), vertices.max(axis=1)
        axis = int((high - low).mean(axis=0).argmax())
        flat, support = np.delete(vertices, axis, axis=2), []
        for sign, end in ((1.0, low), (-1.0, high)):
            # breadth of the lowest 6% of the body, feet or crown, over the spread of their height plus 5 mm
            height = sign * vertices[..., axis] - (sign * vertices[..., axis]).min(axis=1, keepdims=True)
            near = height < 0.06 * height.max()
            breadth = np.mean([np.linalg.norm(np.ptp(v[lowest], axis=0)) for v, lowest in zip(flat, near, strict=True)])
            support.append(float(breadth) / (np.subtract(*np.percentile(end[:, axis], [75, 25])) + 0.005))
        sign = 1.0 if support[0] >= support[1] else -1.0
        end = low[:, axis] if sign > 0 else -high[:, axis]
        return Floor(sign * np.eye(3)[axis], float(np.percentile(end, 20)))

    def above(self, points: np.ndarray) -> np.ndarray:
        """Compute the height (...) of points (..., 3) above the floor, metres."""
        return points @ self.normal - self.height


class FootContact:
    """The soles of a body over a motion x (T, P), and where they stand on the floor that is estimated below them."""

    TOUCH = 0.025                        # metres: a point may stand when it is this close to the floor

    def __init__(self, body: MarkedBody, x: np.ndarray, rate: float) -> None:
        self.body, subject = body, body.body.subject
        # some 150 bodies of the motion tell the floor and the vertices near it
        pose, trans, _ = body.body.split(x[np.unique(np.linspace(0, len(x) - 1, 150).astype(int))])
        vertices = subject.vertices(pose, trans)
        self.floor = Floor.below(vertices)
        # the soles: at most 24 vertices spread over all that come near the floor in 5% of the frames, and the lowest
        # vertex of every frame, as heels are round
        rest, height = subject.template.vertices, self.floor.above(vertices)
        near = np.flatnonzero((height < self.TOUCH).mean(axis=0) > 0.05)
        near = near if len(near) else np.array([int(height.min(axis=0).argmin())])
        spread = farthest_points(rest[near], 24, height[:, near].mean(axis=0).argmin())
        self.shapes = part_shapes(subject.points(near[np.union1d(spread, height[:, near].argmin(axis=1))]))
        self.stands = self._standing_places(self._points(x), rate)

    def target_positions(self, x: np.ndarray) -> np.ndarray:
        """Return targets (T, K, 3), metres, of the soles: standing places, or the floor for points below it.

        Points that move freely at the unknowns (T, P) are NaN.
        """
        points = self._points(x)
        height = self.floor.above(points)
        lifted = points - height[..., None] * self.floor.normal
        return np.where(np.isnan(self.stands) & (height < 0)[..., None], lifted, self.stands)

    def system(self, x: np.ndarray, targets: np.ndarray, weights: np.ndarray, places: np.ndarray) -> Dense:
        """Build the equations of `MarkedBody.system` with soles held at places (B, K, 3), free where NaN."""
        return self.hold(self.body.system(x, targets, weights), x, places)

    def hold(self, equations: Dense, x: np.ndarray, places: np.ndarray) -> Dense:
        """Add to equations of frames x (B, P) those of soles at places (B, K, 3)."""
        # 2 mm: standard deviation of a standing point from its place
        more = point_system(*self.shapes.columns(*self.body.body.split(x)[:2]), places,
                            np.full(places.shape[:2], 0.002**-2))
        return Dense(*(before + added for before, added in zip(equations, more, strict=True)))

    def _points(self, x: np.ndarray) -> np.ndarray:
        """Compute the points of the soles (T, K, 3), metres, at unknowns (T, P)."""
        pose, trans, _ = self.body.body.split(x)
        return self.shapes.evaluate(pose, trans).swapaxes(-1, -2)

    def _standing_places(self, points: np.ndarray, rate: float) -> np.ndarray:
        """Return places (T, K, 3) where points stand, NaN where they move freely."""
        held = np.full(points.shape, np.nan)
        # positions are averaged over 0.15 s for their speed; a point stands for at least 0.08 s, below 0.2 m/s
        calm = uniform_filter1d(points, max(1, round(0.15 * rate)), axis=0, mode="nearest")
        speed = np.linalg.norm(np.gradient(calm, axis=0), axis=2) * rate
        stands = (self.floor.above(calm) < self.TOUCH) & (speed < 0.2)
        for k in range(points.shape[1]):
            for stretch in stretches(np.flatnonzero(stands[:, k])):
                # the place is the median over the stretch, lifted out of the floor
                if len(stretch) >= 0.08 * rate:
                    place = np.median(points[stretch, k], axis=0)
                    held[stretch, k] = place - min(0.0, float(self.floor.above(place))) * self.floor.normal
        return held
