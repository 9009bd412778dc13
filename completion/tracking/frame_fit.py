"""Fit a body of known shape to one frame, from its expected pose; and find the shape from several frames at once."""
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
from .settings import BODY_POINTS, TrackConfig

REACH, FINAL_REACH = 0.1, 0.03       # metres: largest distance of a match in the first round, and from the third on
SETTLED = 1e-3                       # metres, RMS over the vertices: a round that moves the body less is the last
ROUNDS = 5                           # most matchings of a frame: two of few vertices, then up to three of all
ROUGH, VERTICES = 2, 2000            # rounds with few vertices, while the body is still far off; their number
NEAR, EXPLAINED = 0.05, 0.7          # metres within which a point is explained by the body; least share of the points
NOTHING = (np.zeros(0, dtype=np.int64), np.zeros((0, 3)))


@dataclass(frozen=True, eq=False)
class Refined:
    """Result of the fit to one frame.

    `gradient` and `precision` are those of half the energy there, without the prediction. Derivatives are by small
    rotations of every joint from the right.
    """

    x: np.ndarray                    # (P,) pose and place
    gradient: np.ndarray             # (P,)
    precision: np.ndarray            # (P, P)
    residual: float                  # metres, mean distance of the points to the surface
    explained: float                 # share of the points within NEAR of the surface


def frame_inertia(n_unknowns: int, rate: float) -> np.ndarray:
    """Compute the information (P,) of the change of velocity per frame."""
    # standard deviations of accelerations: 60 radians/s² of the joints, 15 m/s² of the place
    return inertia(n_unknowns, rate, 60.0, 15.0)


class FrameFit:
    """A body of known shape, and all that stays the same from frame to frame."""

    def __init__(self, body: FixedBody, cloud: ScanPoints, config: TrackConfig, rate: float) -> None:
        self.body, self.config = body, config
        self.scan = scan_fit(body, cloud, *NOTHING, config.scan)
        self.few = self.scan.some(spread_points(body.template.vertices, VERTICES), BODY_POINTS)
        self.inertia = frame_inertia(body.n_angles + 3, rate)

    def good(self, result: Refined) -> bool:
        """Tell whether a frame is tracked, not lost."""
        return result.residual <= self.config.lost and result.explained >= EXPLAINED

    def refine(self, fit: ScanFit, x: np.ndarray, expected: np.ndarray | None = None) -> Refined:
        """Refine the unknowns x (P,), with the expected ones as a prior if given: one step a round of matches."""
        # 10: a prediction from two uncertain frames has ten times the variance that acceleration alone gives
        held = 0 * self.inertia if expected is None else self.inertia / 10.0
        goal, n, few = x if expected is None else expected, self.body.n_angles, self.few.on(fit.cloud)
        for i in range(ROUNDS):
            # match points and body, first with few vertices
            now, at = few if i < ROUGH else fit, x[None]
            places = now.skin(x).places
            frame = by_rotations(now.match_at(x, fit.cloud, _reach(i)).equations(at).dense, at, n)
            # one damped Gauss-Newton step on data and prediction; 1e-3 of the diagonal is added to the matrix
            off = step_between(goal, at, n)
            step, _ = Dense(frame.energy + (off**2) @ held, frame.gradient + held * off,
                            frame.hessian + np.diag(held)).step(np.array([1e-3]))
            x = retract_pose(n)(x, step[0])
            if i >= ROUGH and np.sqrt(((now.skin(x).places - places)**2).sum(axis=1).mean()) < SETTLED:
                break
        gradient = frame.gradient[0] + frame.hessian[0] @ step[0]    # of the data after the last step, to first order
        distance = Surface(self.body.template.with_vertices(fit.skin(x).places)).closest(fit.cloud.points).distances
        return Refined(x, gradient, frame.hessian[0], float(distance.mean()), float((distance < NEAR).mean()))

    def again(self, fit: ScanFit, starts: Sequence[np.ndarray], scratch: bool) -> Refined:
        """Search a lost frame from given starts (P,), and from scratch if wanted; the best explanation is refined."""
        few = fit.few()
        if scratch:
            starts = [*starts, best_starts(few, first_starts(fit, few))[0]]
        # lay every start on the points, approach, and keep the one with the least misfit
        ends = [approach(few, _laid(self.body, x, fit.cloud)) for x in starts]
        best = ends[int(np.argmin([few.misfit(x) for x in ends]))]
        return self.refine(fit, reinitialise_limbs(few, best) if scratch else best)


def fit_shared_shape(body: ShapedBody, clouds: Sequence[ScanPoints], x: np.ndarray, betas: np.ndarray,
                     config: TrackConfig) -> tuple[np.ndarray, np.ndarray]:
    """Find the betas (K,) that explain frames together, and pose and place (n, P) of each, from a near start."""
    # each frame with a body of its own, which caches what it computed for its pose
    fits = [scan_fit(ShapedBody(body.model), cloud, *NOTHING, config.scan) for cloud in clouds]
    rows = np.concatenate([x, np.tile(betas, (len(x), 1))], axis=1)
    for i in range(4):  # rounds of matches; the reach of matches is least from the third on
        each = [one.match_at(row, one.thin, _reach(i)).equations(row[None]).dense
                for one, row in zip(fits, rows, strict=True)]
        # one step of all frames: poses are separate unknowns, betas are shared
        together = Dense(*(np.concatenate(part) for part in zip(*each, strict=True)))
        shape = normal_equations([energy.shape_prior(rows[:1, x.shape[1]:], 0)])
        # vectors are added: as rotations four rounds end 0.3505 sd from the true betas of the test, not 0.3496
        rows = rows + Arrow(together, len(betas), shape).step(np.zeros(1))[0]
    return rows[0, x.shape[1]:], rows[:, :x.shape[1]]


def spread_poses(vertices: np.ndarray, count: int) -> np.ndarray:
    """Return indices of the `count` bodies (n, N, 3) that differ most, in order, with the first among them."""
    shapes = vertices - vertices.mean(axis=1, keepdims=True)
    return np.sort(farthest_points(
        shapes, count, 0, lambda i, _: np.linalg.norm(shapes - shapes[i], axis=2).mean(axis=1)))


def _reach(i: int) -> float:
    """Compute the largest distance of matches in round i, metres: it falls geometrically over two rounds."""
    return REACH * (FINAL_REACH / REACH)**min(1.0, i / 2)


def _laid(body: FixedBody, x: np.ndarray, cloud: ScanPoints) -> np.ndarray:
    """Move a body x (P,) so that its middle lies at that of the points."""
    # between the 2nd and 98th percentile along each axis, so that stray points do not count
    def middle(points: np.ndarray) -> np.ndarray:
        return 0.5 * np.sum(np.percentile(points, [2, 98], axis=0), axis=0)

    out = x.copy()
    out[body.n_angles:body.n_angles + 3] += middle(cloud.points) - middle(body.vertices(x))
    return out
