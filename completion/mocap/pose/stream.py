"""Markers as they come: one frame in, one pose out, from nothing but the frames before."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.linear import Subject
from scanprep.geometry.least_squares import Dense, Minimum, levenberg_marquardt

from ..marker_sets.layout import MarkerLayout
from .initialise import search_pose
from .marked_body import AnimateConfig, MarkedBody, judge_markers, marker_misfit, marker_weights
from .swaps import LabelWatch

STEPS = 3                            # most for a frame
LOST = 0.08                          # metres, median residual of a frame above which it is searched anew
PATIENCE = 0.25                      # seconds from a search that found nothing to the next; then twice as many


@dataclass(frozen=True, eq=False)
class PoseFrame:
    """What one frame of markers tells.

    Attributes
    ----------
    pose : (J, 3) float, radians
        NaN as long as no frame has shown enough markers to begin with.
    trans : (3,) float, metres
    residuals : (L,) float, metres
        Distance of each marker from where the body puts it; NaN where it was not seen or is in no layout.
    trusted : (L,) bool
        Seen, and believed under its own label; none in a frame that no body explains.
    converged : bool
        The solution settled. It did not where a frame that no body makes was passed over: the pose is the expected one.
    """

    pose: np.ndarray
    trans: np.ndarray
    residuals: np.ndarray
    trusted: np.ndarray
    converged: bool


class MarkerStream:
    """The motion of a body from markers, frame by frame as they arrive.

    Parameters
    ----------
    subject : Subject
        The person, of known shape.
    layout : MarkerLayout
        Where on the body the markers sit.
    labels : strings
        Of the markers that `push` will be given, in this order; those that the layout does not know are left out.
    rate : float, frames per second
    config : AnimateConfig, optional

    Raises
    ------
    ValueError
        Fewer than 3 labels in the layout, a layout of another body, a rate that is not above zero, settings
        that need later frames.

    [SCAPE] §8
    """

    def __init__(self, subject: Subject, layout: MarkerLayout, labels: Sequence[str], rate: float,
                 config: AnimateConfig | None = None) -> None:
        config = config or AnimateConfig()
        if config.ground or config.low_pass:
            raise ValueError("config: expected ground=False and low_pass=0 for a stream, both need later frames")
        if not rate > 0:
            raise ValueError(f"rate: expected a number above 0, got {rate}")
        self.rows, worn = layout.match_columns(labels)
        self.n_labels = len(labels)
        body = MarkedBody(subject, worn, config.prior_weight, config.prior_shrinkage)
        self.tracker = MarkerTracker(body, config, rate)

    def push(self, positions: np.ndarray) -> PoseFrame:
        """The next frame.

        Parameters
        ----------
        positions : (L, 3) float, metres
            NaN where a marker is out of sight, as one is that is infinitely far.
        """
        positions = np.asarray(positions, dtype=np.float64)
        if positions.shape != (self.n_labels, 3):
            raise ValueError(f"positions: expected shape ({self.n_labels}, 3), got {positions.shape}")
        positions = np.where((np.abs(positions) < 1e6).all(axis=1, keepdims=True), positions, np.nan)
        tracker, targets = self.tracker, positions[self.rows]
        x, converged = tracker.push(targets)
        residuals, trusted = np.full(self.n_labels, np.nan), np.zeros(self.n_labels, dtype=bool)
        residuals[self.rows], trusted[self.rows] = judge_markers(tracker.places, targets, tracker.watch.order,
                                                        tracker.config.outlier)
        pose, trans, _ = tracker.body.body.split(x)
        return PoseFrame(pose, trans, residuals, trusted & tracker.believed, converged)


class KalmanPrediction:
    """A Kalman filter over rotations and velocities, the Gauss-Newton matrix of the markers as information.

    Where markers are missing, what the last ones told about the joints together is not lost at once.
    """

    momentum = 0.95                  # share of the velocity that is kept

    def __init__(self, body: MarkedBody, config: AnimateConfig, rate: float) -> None:
        self.body = body
        self.noise = 1 / config.inertia(rate, body.n_unknowns)

    def begin(self, x: np.ndarray) -> None:
        self.x, self.velocity = x, np.zeros_like(x)
        # covariances (P, P) of place, both, velocity; variances of two uncertain frames, against the acceleration's
        self.place = self.speed = np.diag(10.0 * self.noise)
        self.cross = 0 * self.place

    def expect(self) -> tuple[np.ndarray, np.ndarray]:
        m = self.momentum
        kept = m * m * self.speed
        place = self.place + m * (self.cross + self.cross.T) + kept
        cross, speed = m * self.cross + kept, kept
        for block, share in ((place, 0.25), (cross, 0.5), (speed, 1.0)):  # after one frame of constant acceleration
            block[np.diag_indices(len(block))] += share * self.noise
        self._ahead, self.covariance = (cross, speed), place            # (P, P) of what is expected
        self._expected = self.body.retract(self.x, m * self.velocity)
        information = np.linalg.inv(place)
        self._information = 0.5 * (information + information.T)
        return self._expected, self._information

    def update(self, x: np.ndarray, measured: np.ndarray) -> None:
        cross, speed = self._ahead
        gain = self._information @ cross                                # of the velocity, by the place
        self.velocity = self.momentum * self.velocity + self.body.step_to(self._expected, x) @ gain
        place = np.linalg.inv(self._information + measured)
        self.place = 0.5 * (place + place.T)
        known = self.place @ gain
        speed = speed - cross.T @ gain + gain.T @ known
        self.speed = 0.5 * (speed + speed.T)                            # rounding grows where it is not symmetric
        self.cross = known
        self.x = x


class MarkerTracker:
    """The state of a stream of markers (L, 3) that all belong to the body, `rate` frames a second."""

    def __init__(self, body: MarkedBody, config: AnimateConfig, rate: float, steps: int = STEPS) -> None:
        self.body, self.config, self.rate, self.steps = body, config, rate, steps
        self.watch = LabelWatch(body.count, config.outlier)
        self.prediction = KalmanPrediction(body, config, rate)
        self.wait, self.patience, self.started = 0, PATIENCE * rate, False
        self.places = np.full((body.count, 3), np.nan)                  # of the markers on the body of the last frame
        self.believed, self.since, self.passed = False, 0, 0            # frames since one was believed, passed over
        self.leapt = self.places                                        # where the last frame would have had the body

    def begin(self, x: np.ndarray) -> None:
        """Continue from these unknowns (P,), at rest."""
        self.prediction.begin(x)
        self.watch.order = np.arange(self.body.count)
        self.started, self.since, self.passed = True, 0, 0

    def push(self, targets: np.ndarray) -> tuple[np.ndarray, bool]:
        """Unknowns (P,) of the next frame, NaN before the first that could be solved, and whether it converged."""
        there = int((~np.isnan(targets[:, 0])).sum())
        enough = there >= max(3, 0.5 * self.body.count)                 # for a search
        self.wait, self.since, self.believed = max(0, self.wait - 1), self.since + 1, False
        fresh = not self.started
        if fresh:
            if not enough:
                return np.full(self.body.n_unknowns, np.nan), False
            passed = self.passed
            self.begin(search_pose(self.body, targets, self.config))
            self.passed = passed
        expected, information = self.prediction.expect()
        self.places = before = self.body.positions(expected)
        if not there:
            self.prediction.update(expected, 0 * information)
            return expected, False
        order = self.watch.order.copy()
        taken = targets[self.watch.update(before, targets)]
        end = self._solve(taken, expected, information)
        x, converged, found = end.x[0], bool(end.converged[0]), None
        self.places = self.body.positions(x)
        # the body may have lost its markers, or a fifth of those seen
        off = np.linalg.norm(self.places - taken, axis=1)
        off = off[~np.isnan(off)]
        astray = bool(np.median(off) > LOST or (off > self.config.outlier).mean() > 0.2)
        if not self.wait and enough and not fresh and astray:
            found = self._search_again(taken)
            x, converged = (x, converged) if found is None else (found, True)
            self.places = self.body.positions(x)
        if self._to_pass_over(taken, before):
            self.watch.order, self.places = order, before
            if fresh:
                self.started = False
                return np.full(self.body.n_unknowns, np.nan), False
            self.prediction.update(expected, 0 * information)
            return expected, False
        if found is not None:
            self.begin(x)
        else:
            self.prediction.update(x, end.equations.hessian[0] - information)
        return x, converged

    def _solve(self, targets: np.ndarray, expected: np.ndarray, information: np.ndarray) -> Minimum[np.ndarray]:
        """The best unknowns of a frame near the expected ones, which put the markers where `places` says."""
        body, config = self.body, self.config
        weights, _ = marker_weights(self.places, targets, config.marker_sd, config.outlier)

        def system(x: np.ndarray) -> Dense:
            cost, gradient, hessian = body.system(x, targets[None], weights[None])
            step = body.step_to(expected, x[0])
            pull = information @ step
            return Dense(cost + step @ pull, gradient + pull, hessian + information)

        return levenberg_marquardt(system, expected[None], self.steps, 1e-2, 1e-4, retract=body.retract)

    def _search_again(self, targets: np.ndarray) -> np.ndarray | None:
        """Unknowns (P,) that a search finds and that fit much better than the body at `places`, or None."""
        found = search_pose(self.body, targets, self.config)
        apart = np.linalg.norm(np.stack([self.body.positions(found), self.places]) - targets, axis=2)
        new, old = marker_misfit(apart, self.config.outlier)
        if new < 0.7 * old:
            self.patience = PATIENCE * self.rate
            return found
        self.wait, self.patience = round(self.patience), 2 * self.patience
        return None

    def _to_pass_over(self, targets: np.ndarray, before: np.ndarray) -> bool:
        """Whether the markers (L, 3) are to be passed over, the body at `places` having been expected at `before`.

        No body explains them, or it leapt there: that is believed when the next frame says the same, or it goes on for
        long.
        """
        # the markers of a body stray at most 10 m/s together from where they are expected
        near = LOST + 10.0 * self.since / self.rate
        lost = bool(np.nanmedian(np.linalg.norm(self.places - targets, axis=1)) > LOST)
        leapt, self.leapt = self.leapt, np.full_like(before, np.nan) if lost else self.places
        # not where some places are not known
        self.believed = not lost and any(np.median(np.linalg.norm(self.places - of, axis=1)) <= near
                                         for of in (before, leapt))
        if self.believed:
            self.since = self.passed = 0
            return False
        self.passed += 1
        return self.passed <= 0.25 * self.rate                          # for so many seconds they are taken for wrong
