"""Where the fit of a scan begins when no landmark is known: typical poses, turned every way."""
from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from scanprep.geometry import rotations
from scanprep.geometry.farthest_points import farthest_points

from ..priors import typical_poses
from ..starts import distinct
from .free_space import Sight, Sights
from .scan import ScanPoints, spread

if TYPE_CHECKING:
    from .fit import ScanFit

TURNS = 600                          # about 25 degrees between neighbours
POSES = 100                          # tried at most
VERTICES, POINTS = 500, 120          # of body and scan, in the first look at all turns
CAP = 0.15                           # metres: further off is as bad
NORMALS = 0.1                        # metres that a difference of normals of unit length weighs
CELL, MARGIN = 0.04, 0.3             # metres: of the table of what the camera must have seen
FACING = 0.15                        # cosine to the camera's direction from which a vertex counts as seen
PROMISING = 0.4                      # share of all placements, those least denied by the camera, that are compared
AT_ONCE = 1000                       # points that are compared at a time
POOL = 200                           # best placements that are kept
BLIND, APART = 24, 0.08              # of them, starts that differ by so many metres on average


def from_nothing(fit: ScanFit) -> np.ndarray:
    """The likeliest bodies (n, P) for a scan without landmarks, distinct and best first.

    Typical poses are turned in every direction, for no axis is known to be up, laid on the scan and compared
    with what it shows and with what its camera must have seen.
    """
    x, _ = placements(fit)
    places = fit.body.subject.points(fit.spread).evaluate(*fit.body.split(x)[:2])
    return x[distinct(places, BLIND, APART)]


def starting_poses(fit: ScanFit) -> np.ndarray:
    """Poses (M, J, 3) to try: those the model was trained on, or steps along the Gaussian's main directions."""
    body = fit.body
    if not len(body.pose_examples):
        return typical_poses(body.pose_mean, body.pose_covariance, fit.config.start_axes)
    mean = body.pose_mean.copy()
    mean[0] = 0
    return varied(np.concatenate([mean[None], body.pose_examples]), POSES)


def varied(poses: np.ndarray, count: int) -> np.ndarray:
    """Those `count` of the poses (M, J, 3), the first among them, that differ most from one another."""
    return poses if len(poses) <= count else poses[farthest_points(poses.reshape(len(poses), -1), count, 0)]


def all_turns(count: int) -> np.ndarray:
    """Rotations (count, 3, 3) spread evenly, with no axis preferred: the quaternions of two golden spirals."""
    i = np.arange(count) + 0.5
    r, R = np.sqrt(i / count), np.sqrt(1 - i / count)
    a, b = 2 * np.pi * i / np.sqrt(2), 2 * np.pi * i / 1.533751168755204288118041
    x, y, z, w = r * np.sin(a), r * np.cos(a), R * np.sin(b), R * np.cos(b)
    return np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
                     2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
                     2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], axis=1).reshape(-1, 3, 3)


class Outside:
    """A table of how far places stand where a camera would have seen them.

    `tolerance`, metres, see `Sight.trespass`.
    """

    def __init__(self, sight: Sight | Sights, tolerance: float) -> None:
        self.low = sight.points.min(axis=0) - MARGIN
        self.count = np.ceil((sight.points.max(axis=0) + MARGIN - self.low) / CELL).astype(np.int64)
        grid = np.stack(np.meshgrid(*[np.arange(n) for n in self.count], indexing="ij"), axis=-1).reshape(-1, 3)
        self.excess = np.minimum(sight.trespass(self.low + CELL * (grid + 0.5), tolerance)[0], CAP).astype(np.float32)

    def at(self, places: np.ndarray) -> np.ndarray:
        """(...) metres, for places (..., 3); beyond the table as at its end."""
        cell = np.clip(((places - self.low) / CELL).astype(np.int64), 0, self.count - 1)
        return self.excess[(cell[..., 0] * self.count[1] + cell[..., 1]) * self.count[2] + cell[..., 2]]


def placements(fit: ScanFit) -> tuple[np.ndarray, np.ndarray]:
    """The best of all poses in all turns, laid on the scan: unknowns (POOL, P) and costs, best first."""
    body, config = fit.body, fit.config
    poses, turns = starting_poses(fit), all_turns(TURNS)
    scan, ids = fit.cloud.thinned(POINTS), spread(body.template.vertices, VERTICES)
    places, normals = posed_points(fit, ids, poses)
    cameras = fit.sight.cameras if isinstance(fit.sight, Sights) else [fit.sight] if fit.sight else []
    toward = np.array([_unit(camera.viewpoint - scan.points.mean(axis=0)) for camera in cameras]).reshape(-1, 3)
    table = None if fit.sight is None else Outside(fit.sight, config.silhouette_tolerance)
    cost, shift = np.zeros((len(poses), TURNS)), np.empty((len(poses), TURNS, 3))
    for a, (y, n) in enumerate(zip(places, normals, strict=True)):
        shift[a] = scan.points.mean(axis=0) - (turns @ _shown(y, n, turns, toward)[:, :, None])[..., 0]
        if table is not None:
            out = table.at((y @ np.swapaxes(turns, 1, 2) + shift[a][:, None]).astype(np.float32))
            cost[a] = config.silhouette_weight * (out**2).mean(axis=1)
    doubtful = cost > (np.quantile(cost, PROMISING) if table is not None else np.inf)
    for a, (y, n) in enumerate(zip(places, normals, strict=True)):
        likely = ~doubtful[a]
        cost[a, likely] += _distances(y, n, turns[likely], shift[a, likely], scan)
    cost[doubtful] = np.inf
    order = np.argsort(cost, axis=None, kind="stable")[:POOL]
    which, turn = np.unravel_index(order, cost.shape)
    x = np.array([body.join(_turned(poses[a], turns[b]), np.zeros(3)) for a, b in zip(which, turn, strict=True)])
    stand = body.subject.origin
    x[:, body.n_angles:body.n_angles + 3] = (turns[turn] @ stand) + shift[which, turn] - stand
    return x, cost.ravel()[order]


def posed_points(fit: ScanFit, ids: np.ndarray, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Some vertices (B, L, 3) in poses (B, J, 3), and normals that turn with their parts."""
    R = fit.body.skeleton.part_rotations(poses)[:, fit.part[ids]]
    normals = (R @ fit.body.template.vertex_normals[ids][:, :, None])[..., 0]
    return fit.body.subject.points(ids).evaluate(poses), normals


def _shown(y: np.ndarray, n: np.ndarray, turns: np.ndarray, toward: np.ndarray) -> np.ndarray:
    """Centre (T, 3), in the body's frame, of the vertices that face a camera in direction (C, 3); of all without."""
    if not len(toward):
        return np.repeat(y.mean(axis=0)[None], len(turns), axis=0)
    facing = ((n @ np.swapaxes(turns, 1, 2) @ toward.T) > FACING).any(axis=2).astype(float)
    return facing @ y / np.maximum(facing.sum(axis=1, keepdims=True), 1)


def _distances(y: np.ndarray, n: np.ndarray, turns: np.ndarray, shift: np.ndarray, scan: ScanPoints) -> np.ndarray:
    """Mean squared distance (T,) of the scan to one pose turned every way; places and normals in one space."""
    points, directions = (scan.points - shift[:, None]) @ turns, scan.normals @ turns
    ask = np.concatenate([points, NORMALS * directions], axis=2).reshape(-1, 6).astype(np.float32)
    have = np.hstack([y, NORMALS * n]).astype(np.float32)
    squared = (have**2).sum(axis=1)[:, None]
    # |a - b|² = |a|² + (|b|² - 2 a·b); a piece at a time, so that it stays near the processor
    nearest = np.concatenate([(squared + have @ (-2 * some.T)).min(axis=0)
                              for some in np.array_split(ask, 1 + len(ask) // AT_ONCE)]) + (ask**2).sum(axis=1)
    return np.minimum(nearest, CAP**2).reshape(len(turns), -1).mean(axis=1)


def _turned(pose: np.ndarray, R: np.ndarray) -> np.ndarray:
    out = pose.copy()
    out[0] = rotations.log(R @ rotations.exp(pose[0]))
    return out


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v)
