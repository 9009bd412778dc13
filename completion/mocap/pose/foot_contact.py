"""Feet on the floor: what touches it neither sinks nor slides."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import label, uniform_filter1d

from scanprep.geometry.farthest_points import farthest_points

from .marked_body import MarkedBody, System, point_system
from .marker_points import PartShapes

SOLES = 24                           # points that may stand
TOUCH = 0.025                        # metres above the floor below which a point may stand
STILL = 0.2                          # metres per second below which it does
CALM = 0.15                          # seconds over which a place is averaged, to tell its speed
SHORTEST = 0.08                      # seconds that standing lasts at least
CONTACT_SD = 0.002                   # metres that a standing point may be from its place
LOOKED_AT = 150                      # frames in which the soles are sought
UNREST = 0.005                       # metres by which any end of a body rises and falls
FOOT = 0.06                          # of the height of a body are feet, or the top of its head
LEVEL = 20.0                         # percentile of the lowest point's height that is the floor


@dataclass(frozen=True, eq=False)
class Floor:
    """A plane to stand on.

    Attributes
    ----------
    normal : (3,) float
        Of unit length, points up.
    height : float, metres
        Along the normal.
    """

    normal: np.ndarray
    height: float

    @staticmethod
    def given(numbers: tuple[float, float, float, float]) -> Floor:
        """From a normal, not zero, and a height.

        Raises
        ------
        ValueError
            No direction.
        """
        length = float(np.linalg.norm(numbers[:3]))
        if not (length > 0 and np.isfinite(numbers).all()):
            raise ValueError(f"floor: expected a normal and a height, got {numbers}")
        return Floor(np.array(numbers[:3]) / length, float(numbers[3]))

    @staticmethod
    def below(vertices: np.ndarray) -> Floor:
        """The floor under a moving body.

        Vertical is the world axis along which the body is longest on average, down is the end that is broad and
        stays level, and the floor is where that end mostly is. For who lies or sits the floor should be given.

        Parameters
        ----------
        vertices : (n, N, 3) float, metres
        """
        low, high = vertices.min(axis=1), vertices.max(axis=1)
        axis = int((high - low).mean(axis=0).argmax())
        support = [_breadth(sign * vertices, axis) / (np.subtract(*np.percentile(end[:, axis], [75, 25])) + UNREST)
                   for sign, end in ((1, low), (-1, high))]
        sign = 1.0 if support[0] >= support[1] else -1.0
        end = low[:, axis] if sign > 0 else -high[:, axis]
        return Floor(sign * np.eye(3)[axis], float(np.percentile(end, LEVEL)))

    def above(self, points: np.ndarray) -> np.ndarray:
        """Height (...) of points (..., 3) above the floor, metres."""
        return points @ self.normal - self.height


def _breadth(vertices: np.ndarray, axis: int) -> float:
    """How far what is low (n, N, 3) along an axis reaches sideways, on average over the frames, metres."""
    height = vertices[..., axis] - vertices[..., axis].min(axis=1, keepdims=True)
    near = height < FOOT * height.max()
    flat = np.delete(vertices, axis, axis=2)
    return float(np.mean([np.linalg.norm(np.ptp(v[some], axis=0)) for v, some in zip(flat, near, strict=True)]))


class Standing:
    """The soles of a body over a motion, and the places where they are held.

    Parameters
    ----------
    body : MarkedBody
    x : (T, P) float
        The motion as it is known so far.
    rate : float, frames per second
    floor : Floor, optional
        Else it is found under the motion.
    """

    def __init__(self, body: MarkedBody, x: np.ndarray, rate: float, floor: Floor | None = None) -> None:
        self.body, subject = body, body.body.subject
        pose, trans, _ = body.body.split(x[np.unique(np.linspace(0, len(x) - 1, LOOKED_AT).astype(int))])
        vertices = subject.vertices(pose, trans)
        self.floor = floor or Floor.below(vertices)
        self.soles = _soles(subject.template.vertices, self.floor.above(vertices))
        self.shapes = PartShapes(subject.points(self.soles))
        points = self.points(x)
        self.held = self._held(points, rate)
        self.weights = np.full(self.held.shape[:2], CONTACT_SD**-2)
        self.refresh(points)

    def points(self, x: np.ndarray) -> np.ndarray:
        """The soles (T, K, 3) of unknowns (T, P), metres."""
        pose, trans, _ = self.body.body.split(x)
        return self.shapes.evaluate(pose, trans).swapaxes(-1, -2)

    def system(self, x: np.ndarray, frames: np.ndarray | slice) -> System:
        """Energy, half its gradient and Gauss-Newton matrix of some frames (B, P): soles at their places."""
        return point_system(self.shapes, *self.body.body.split(x)[:2], self.targets[frames], self.weights[frames])

    def refresh(self, points: np.ndarray) -> None:
        """Lift those points (T, K, 3) out of the floor that are held nowhere and have sunk into it."""
        height = self.floor.above(points)
        lifted = points - height[..., None] * self.floor.normal
        self.targets = np.where(np.isnan(self.held) & (height < 0)[..., None], lifted, self.held)

    def _held(self, points: np.ndarray, rate: float) -> np.ndarray:
        """Places (T, K, 3) where points stand, NaN where they move freely."""
        held = np.full(points.shape, np.nan)
        calm = uniform_filter1d(points, max(1, round(CALM * rate)), axis=0, mode="nearest")
        speed = np.linalg.norm(np.gradient(calm, axis=0), axis=2) * rate
        stands = (self.floor.above(calm) < TOUCH) & (speed < STILL)
        for k in range(points.shape[1]):
            runs, count = label(stands[:, k])
            for run in range(1, count + 1):
                mine = np.flatnonzero(runs == run)
                if len(mine) >= SHORTEST * rate:
                    place = np.median(points[mine, k], axis=0)
                    held[mine, k] = place - min(0.0, float(self.floor.above(place))) * self.floor.normal
        return held


def _soles(rest: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Vertices (K,) spread over what comes near the floor, from heights (n, N) over it."""
    near = np.flatnonzero((height < TOUCH).mean(axis=0) > 0.05)
    if not len(near):
        near = np.array([int(height.min(axis=0).argmin())])
    return near[farthest_points(rest[near], SOLES, height[:, near].mean(axis=0).argmin())]
