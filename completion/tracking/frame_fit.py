"""One frame: the body near where it is expected, drawn to the points; and the shape from several frames at once."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.fitting import energy
from model.fitting.bodies import FixedBody, ShapedBody
from model.fitting.limbs import reinitialise_limbs
from model.fitting.scan import ScanPoints, spread_points
from model.fitting.scan_fit import ScanFit, scan_fit
from model.fitting.starts import approach, best_starts, first_starts
from scanprep.geometry.farthest_points import farthest_points
from scanprep.geometry.least_squares import (
    Arrow,
    Dense,
    by_rotations,
    normal_equations,
    retract_pose,
    step_between,
)
from scanprep.geometry.surface import Surface

from ..smoothing import inertia
from .settings import TrackConfig

REACH, FINAL_REACH = 0.1, 0.03       # metres: limits on the distance of matches in the first round and the third
SETTLED = 1e-3                       # metres, root mean square: a round that moves the body less is the last
ROUGH, VERTICES = 2, 2000            # rounds that take few vertices, and how many
NEAR, EXPLAINED = 0.05, 0.7          # metres: points that have the body within this are explained; share that must be
NOTHING = (np.zeros(0, dtype=np.int64), np.zeros((0, 3)))


@dataclass(frozen=True, eq=False)
class Refined:
    """Where the fit of a frame ended; gradient and matrix are of half the energy there, without the prediction.

    These are by small rotations of every joint from the right.
    """

    x: np.ndarray                    # (P,)
    gradient: np.ndarray             # (P,)
    precision: np.ndarray            # (P, P)
    residual: float                  # metres, mean distance of the points to the surface
    explained: float                 # share of the points that have the surface near


class FrameFit:
    """A body of known shape, and what stays the same from frame to frame."""

    def __init__(self, body: FixedBody, cloud: ScanPoints, config: TrackConfig, rate: float) -> None:
        self.body, self.config = body, config
        self.scan = scan_fit(body, cloud, *NOTHING, config.scan)
        self.few = self.scan.some(spread_points(body.template.vertices, VERTICES), config.body_points)
        self.inertia = inertia(body.n_angles + 3, rate, config.angle_acceleration, config.place_acceleration)

    def good(self, found: Refined) -> bool:
        """Whether a frame is not lost."""
        return found.residual <= self.config.lost and found.explained >= EXPLAINED

    def refine(self, fit: ScanFit, x: np.ndarray, expected: np.ndarray | None = None) -> Refined:
        """The best unknowns near x (P,), held by the expected ones where there are such: one step for each matching."""
        # variance of a prediction from two uncertain frames, against the acceleration's
        held = 0 * self.inertia if expected is None else self.inertia / 10.0
        goal, n, few = x if expected is None else expected, self.body.n_angles, self.few.on(fit.cloud)
        for i in range(self.config.rounds):
            now, at = few if i < ROUGH else fit, x[None]
            places = now.skin(x).places
            frame = by_rotations(now.match_at(x, fit.cloud, _reach(i)).equations(at).dense, at, n)
            off = step_between(goal, at, n)
            # share of the diagonal that is added to the matrix of a step
            step, _ = Dense(frame.energy + (off**2) @ held, frame.gradient + held * off,
                            frame.hessian + np.diag(held)).step(np.array([1e-3]))
            x = retract_pose(n)(x, step[0])
            if i >= ROUGH and np.sqrt(((now.skin(x).places - places)**2).sum(axis=1).mean()) < SETTLED:
                break
        gradient = frame.gradient[0] + frame.hessian[0] @ step[0]    # where the step led
        distance = Surface(self.body.template.with_vertices(fit.skin(x).places)).closest(fit.cloud.points).distances
        return Refined(x, gradient, frame.hessian[0], float(distance.mean()), float((distance < NEAR).mean()))

    def again(self, fit: ScanFit, starts: Sequence[np.ndarray], scratch: bool) -> Refined:
        """A lost frame anew from far starts (P,), or from scratch as well, whichever explains it best."""
        few = fit.few()
        if scratch:
            starts = [*starts, best_starts(few, first_starts(fit, few))[0]]
        ends = [approach(few, _laid(self.body, x, fit.cloud)) for x in starts]
        best = ends[int(np.argmin([few.misfit(x) for x in ends]))]
        return self.refine(fit, reinitialise_limbs(few, best) if scratch else best)


def fit_shared_shape(body: ShapedBody, clouds: Sequence[ScanPoints], x: np.ndarray, betas: np.ndarray,
                     config: TrackConfig) -> tuple[np.ndarray, np.ndarray]:
    """Betas (K,) that explain frames together, and pose and trans (n, P) of each, from such near the truth."""
    # each with a body of its own, which keeps what it has worked out for the pose of its frame
    fits = [scan_fit(ShapedBody(body.model), cloud, *NOTHING, config.scan) for cloud in clouds]
    rows = np.concatenate([x, np.tile(betas, (len(x), 1))], axis=1)
    for i in range(4):  # matchings of the frames that tell the shape
        each = [one.match_at(row, one.thin, _reach(i)).equations(row[None]).dense
                for one, row in zip(fits, rows, strict=True)]
        together = Dense(*(np.concatenate(part) for part in zip(*each, strict=True)))
        shape = normal_equations([energy.shape_prior(rows[:1, x.shape[1]:], 0)])
        # vectors are added: as rotations four rounds end 0.3505 sd from the true betas of the test, not 0.3496
        rows = rows + Arrow(together, len(betas), shape).step(np.zeros(1))[0]
    return rows[0, x.shape[1]:], rows[:, :x.shape[1]]


def spread_poses(vertices: np.ndarray, count: int) -> np.ndarray:
    """Indices of `count` of the bodies (n, N, 3) that are as unlike as possible, in order, the first among them."""
    shapes = vertices - vertices.mean(axis=1, keepdims=True)
    return np.sort(farthest_points(
        shapes, count, 0, lambda i, _: np.linalg.norm(shapes - shapes[i], axis=2).mean(axis=1)))


def _reach(i: int) -> float:
    """Limit on the distance of matches in round i, metres."""
    return REACH * (FINAL_REACH / REACH)**min(1.0, i / 2)


def _laid(body: FixedBody, x: np.ndarray, cloud: ScanPoints) -> np.ndarray:
    """A body (P,) moved so that its middle is that of the points."""
    def middle(points: np.ndarray) -> np.ndarray:
        return 0.5 * np.sum(np.percentile(points, [2, 98], axis=0), axis=0)

    out = x.copy()
    out[body.n_angles:body.n_angles + 3] += middle(cloud.points) - middle(body.vertices(x))
    return out
