"""One frame: the body near where it is expected, drawn to the points."""
from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from scanprep.geometry.least_squares import Residual, levenberg_marquardt, normal_equations
from scanprep.geometry.surface import Surface

from .. import energy
from ..bodies import FixedBody
from ..partial.fit import Energy, ScanFit
from ..partial.reinitialise import approach, best_start, first_starts, redraw_limbs
from ..partial.scan import ScanPoints
from .dynamics import inertia
from .settings import TrackConfig

NEAR = 0.05                          # metres: points that have the body within this are explained
PREDICTION = 10.0                    # variance of a prediction from two uncertain frames, against the acceleration's
NOTHING = (np.zeros(0, dtype=np.int64), np.zeros((0, 3)))


@dataclass(frozen=True, eq=False)
class Settled:
    """Where the fit of a frame ended."""

    x: np.ndarray           # (P,)
    gradient: np.ndarray
    precision: np.ndarray
    residual: float         # metres, mean distance of the points to the surface
    explained: float        # share of the points that have the surface near


class FrameFit:
    """A body of known shape, and what stays the same from frame to frame."""

    def __init__(self, body: FixedBody, cloud: ScanPoints, config: TrackConfig, rate: float) -> None:
        self.body, self.config = body, config
        self._fit = ScanFit(body, cloud, *NOTHING, config.scan)
        self.inertia = inertia(body.n_angles + 3, rate, config.angle_acceleration, config.place_acceleration)

    def on(self, cloud: ScanPoints) -> ScanFit:
        """The same fit with another frame."""
        return self._fit.on(cloud)

    @property
    def draws(self) -> dict[str, Any]:
        """State of the random numbers of searches from scratch."""
        return dict(self._fit.rng.bit_generator.state)

    @draws.setter
    def draws(self, state: dict[str, Any]) -> None:
        self._fit.rng.bit_generator.state = state

    def good(self, found: Settled) -> bool:
        """Whether a frame is not lost."""
        return found.residual <= self.config.lost and found.explained >= self.config.explained

    def settle(self, fit: ScanFit, x: np.ndarray, expected: np.ndarray | None = None) -> Settled:
        """The best unknowns near x (P,), held by the expected ones where there are such."""
        config = self.config
        place = self.body.vertices(x)
        for i in range(config.rounds):
            reach = config.reach * (config.final_reach / config.reach)**min(1.0, i / 2)
            x, gradient, precision = self._round(fit, x, expected, reach)
            before, place = place, self.body.vertices(x)
            if i >= 2 and np.sqrt(((place - before)**2).sum(axis=1).mean()) < config.settled:
                break
        distance = Surface(self.body.template.with_vertices(place)).closest(fit.cloud.points).distances
        return Settled(x, gradient, precision, float(distance.mean()), float((distance < NEAR).mean()))

    def again(self, fit: ScanFit, starts: list[np.ndarray], scratch: bool) -> Settled:
        """A lost frame anew from far starts (P,), or from scratch as well, whichever explains it best."""
        if scratch:
            starts = [*starts, best_start(fit, first_starts(fit))]
        ends = [approach(fit, _laid(self.body, x, fit.cloud)) for x in starts]
        best = ends[int(np.argmin([fit.misfit(x) for x in ends]))]
        return self.settle(fit, redraw_limbs(fit, best) if scratch else best)

    def _round(self, fit: ScanFit, x: np.ndarray, expected: np.ndarray | None, reach: float
               ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """One matching, the best unknowns for it, and gradient and matrix of the data there."""
        data = scan_terms(fit, x, reach)
        held = 0 * self.inertia if expected is None else self.inertia / PREDICTION
        goal = x if expected is None else expected
        best = levenberg_marquardt(lambda at: normal_equations([*data(at), energy.stay_near(at, goal, held)]), x[None],
                                   iterations=1, tolerance=1e-3).x
        _, gradient, precision = normal_equations(data(best))
        return best[0], gradient[0], precision[0]


def _laid(body: FixedBody, x: np.ndarray, cloud: ScanPoints) -> np.ndarray:
    """A body (P,) moved so that its middle is that of the points."""
    out = x.copy()
    out[body.n_angles:body.n_angles + 3] += _middle(cloud.points) - _middle(body.vertices(x))
    return out


def _middle(points: np.ndarray) -> np.ndarray:
    return 0.5 * np.sum(np.percentile(points, [2, 98], axis=0), axis=0)


def scan_terms(fit: ScanFit, x: np.ndarray, reach: float) -> Energy:
    """The energies of one matching at x (P,), as a function of the unknowns (B, P)."""
    mesh = fit.mesh(x)
    ids, target, normal, weights = fit.matches(mesh, fit.thin, reach)
    out_ids, out_target, out_normal, out_weights = fit.trespasses(mesh)
    follow = fit.body.follow(np.concatenate([ids, out_ids]), x)
    count = len(ids)
    prior = fit.habit.near(fit.body.split(x)[0])

    def terms(at: np.ndarray) -> list[Residual]:
        points = follow(at)
        free, denied = points[:count], points[count:]
        return [energy.pose_prior(at, prior, fit.config.prior_weight),
                energy.point_to_plane(free, target, normal, weights),
                energy.point_to_point(free, target, 0.1 * weights),
                energy.point_to_plane(denied, out_target, out_normal, out_weights)]

    return terms
