"""Real-time motion from markers: one frame in, one pose out, from this and earlier frames only."""
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

STEPS = 3                            # most Gauss-Newton steps for a frame


@dataclass(frozen=True, eq=False)
class PoseFrame:
    """The result for one frame of markers.

    Attributes
    ----------
    pose : (J, 3) float, radians
        NaN until a frame has shown enough markers for the initialisation.
    trans : (3,) float, metres
    residuals : (L,) float, metres
        Distance of each marker from its simulated place; NaN where it was not seen or is not in the layout.
    trusted : (L,) bool
        Seen, and trusted under its own label; false in a frame that no body explains.
    converged : bool
        The solution converged. False also for a frame that no body explains: its pose is the prediction.
    """

    pose: np.ndarray
    trans: np.ndarray
    residuals: np.ndarray
    trusted: np.ndarray
    converged: bool


class MarkerStream:
    """Compute the motion of a body from markers, frame by frame as they arrive.

    Parameters
    ----------
    subject : Subject
        The person, of known shape.
    layout : MarkerLayout
        Where on the body the markers sit.
    labels : sequence of L strings
        Labels of the markers in the order of `push`; those that the layout does not know are left out.
    rate : float, frames per second
        Of the frames that `push` gets.
    config : AnimateConfig, optional
        Settings.

    Raises
    ------
    ValueError
        Fewer than 3 labels in the layout, a layout of another body, a rate that is not above zero, settings
        that need later frames.

    Examples
    --------
    >>> from completion import load_layout
    >>> from model import load_built_in_model
    >>> model = load_built_in_model()
    >>> layout = load_layout("cmu41", model)
    >>> stream = MarkerStream(model.subject(), layout, layout.labels, 120.0)
    >>> frame = stream.push(layout.place(model.template))
    >>> frame.pose.shape, bool(frame.residuals.max() < 0.005)
    ((16, 3), True)

    [SCAPE] §8
    """

    def __init__(self, subject: Subject, layout: MarkerLayout, labels: Sequence[str], rate: float,
                 config: AnimateConfig | None = None) -> None:
        config = config or AnimateConfig()
        if config.ground or config.low_pass:
            raise ValueError("config: expected ground=False and low_pass=0 for a stream, both need later frames")
        if not rate > 0:
            raise ValueError(f"rate: expected a number above 0, got {rate}")
        self.rows, known_layout = layout.match_columns(labels)
        self.n_labels = len(labels)
        body = MarkedBody(subject, known_layout, config.prior_weight, config.prior_shrinkage)
        self.tracker = MarkerTracker(body, config, rate)

    def push(self, positions: np.ndarray) -> PoseFrame:
        """Process the next frame.

        Parameters
        ----------
        positions : (L, 3) float, metres
            NaN for a marker that was not seen; positions beyond 1,000 km count as not seen.

        Returns
        -------
        PoseFrame
            Pose (J, 3) in radians, trans (3,) in metres, residuals (L,) in metres.
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
    """Kalman filter of pose and velocity, with the Gauss-Newton matrix of the markers as the measured information.

    So correlations between joints persist for a while where markers are missing.
    """

    momentum = 0.95                  # share of the velocity that a prediction keeps

    def __init__(self, body: MarkedBody, config: AnimateConfig, rate: float) -> None:
        self.body = body
        self.noise = 1 / config.inertia(rate, body.n_unknowns)

    def begin(self, x: np.ndarray) -> None:
        """Start at unknowns x (P,), at rest."""
        self.x, self.velocity = x, np.zeros_like(x)
        # covariances (P, P) of place, place with velocity, and velocity: 10 times the variance of the acceleration
        self.place = self.speed = np.diag(10.0 * self.noise)
        self.cross = 0 * self.place

    def expect(self) -> tuple[np.ndarray, np.ndarray]:
        """Predict the next frame: unknowns (P,) and their information (P, P)."""
        # covariance after one step with velocity m v, plus the noise of a constant acceleration over the frame
        m = self.momentum
        kept = m * m * self.speed
        place = self.place + m * (self.cross + self.cross.T) + kept
        cross, speed = m * self.cross + kept, kept
        for block, share in ((place, 0.25), (cross, 0.5), (speed, 1.0)):
            block[np.diag_indices(len(block))] += share * self.noise
        self._ahead, self.covariance = (cross, speed), place            # (P, P) of the prediction
        self._expected = self.body.retract(self.x, m * self.velocity)
        information = np.linalg.inv(place)
        self._information = 0.5 * (information + information.T)
        return self._expected, self._information

    def update(self, x: np.ndarray, measured: np.ndarray) -> None:
        """Correct the state by the solution x (P,) of a frame and its measured information (P, P)."""
        cross, speed = self._ahead
        gain = self._information @ cross                                # velocity by place
        self.velocity = self.momentum * self.velocity + self.body.step_to(self._expected, x) @ gain
        place = np.linalg.inv(self._information + measured)
        self.place = 0.5 * (place + place.T)
        known = self.place @ gain
        speed = speed - cross.T @ gain + gain.T @ known
        self.speed = 0.5 * (speed + speed.T)                            # kept symmetric, else rounding errors grow
        self.cross = known
        self.x = x


class MarkerTracker:
    """State of a stream of markers (L, 3) that all belong to the body, `rate` frames a second."""

    LOST = 0.08                          # metres: median residual above which a frame is searched from scratch
    PATIENCE = 0.25                      # seconds from a search without success to the next; doubled each time

    def __init__(self, body: MarkedBody, config: AnimateConfig, rate: float, steps: int = STEPS) -> None:
        self.body, self.config, self.rate, self.steps = body, config, rate, steps
        self.watch = LabelWatch(body.count, config.outlier)
        self.prediction = KalmanPrediction(body, config, rate)
        self.wait, self.patience, self.started = 0, self.PATIENCE * rate, False
        self.places = np.full((body.count, 3), np.nan)                  # simulated markers of the last frame
        self.believed, self.since, self.passed = False, 0, 0            # frames since a plausible one; frames ignored
        self.leapt = self.places                                        # simulated markers of the last solution

    def begin(self, x: np.ndarray) -> None:
        """Continue from unknowns x (P,), at rest."""
        self.prediction.begin(x)
        self.watch.order = np.arange(self.body.count)
        self.started, self.since, self.passed = True, 0, 0

    def push(self, targets: np.ndarray) -> tuple[np.ndarray, bool]:
        """Solve the next frame; return unknowns (P,), NaN before the initialisation, and whether it converged."""
        visible = int((~np.isnan(targets[:, 0])).sum())
        enough = visible >= max(3, 0.5 * self.body.count)                 # markers for a search
        self.wait, self.since, self.believed = max(0, self.wait - 1), self.since + 1, False
        # the first frame with enough markers is the initialisation
        fresh = not self.started
        if fresh:
            if not enough:
                return np.full(self.body.n_unknowns, np.nan), False
            passed = self.passed
            self.begin(search_pose(self.body, targets, self.config))
            self.passed = passed
        # predict; without any marker the prediction is the pose
        expected, information = self.prediction.expect()
        self.places = before = self.body.positions(expected)
        if not visible:
            self.prediction.update(expected, 0 * information)
            return expected, False
        # correct swapped labels, and solve from the prediction
        order = self.watch.order.copy()
        taken = targets[self.watch.update(before, targets)]
        end = self._solve(taken, expected, information)
        x, converged, found = end.x[0], bool(end.converged[0]), None
        self.places = self.body.positions(x)
        # search from scratch where the body has lost its markers, or a fifth of the visible ones
        away = np.linalg.norm(self.places - taken, axis=1)
        away = away[~np.isnan(away)]
        astray = bool(np.median(away) > self.LOST or (away > self.config.outlier).mean() > 0.2)
        if not self.wait and enough and not fresh and astray:
            found = self._search_again(taken)
            x, converged = (x, converged) if found is None else (found, True)
            self.places = self.body.positions(x)
        # ignore a frame that no body explains: undo, and keep the prediction
        if self._to_pass_over(taken, before):
            self.watch.order, self.places = order, before
            if fresh:
                self.started = False
                return np.full(self.body.n_unknowns, np.nan), False
            self.prediction.update(expected, 0 * information)
            return expected, False
        # update the filter, or start it again from the result of a search
        if found is not None:
            self.begin(x)
        else:
            self.prediction.update(x, end.equations.hessian[0] - information)
        return x, converged

    def _solve(self, targets: np.ndarray, expected: np.ndarray, information: np.ndarray) -> Minimum[np.ndarray]:
        """Solve a frame from the expected unknowns (P,), with their information (P, P) as a prior."""
        body, config = self.body, self.config
        weights, _ = marker_weights(self.places, targets, config.marker_sd, config.outlier)

        def system(x: np.ndarray) -> Dense:
            cost, gradient, hessian = body.system(x, targets[None], weights[None])
            step = body.step_to(expected, x[0])
            pull = information @ step
            return Dense(cost + step @ pull, gradient + pull, hessian + information)

        return levenberg_marquardt(system, expected[None], self.steps, 1e-2, 1e-4, retract=body.retract)

    def _search_again(self, targets: np.ndarray) -> np.ndarray | None:
        """Search from scratch; return unknowns (P,) that fit much better than the body at `places`, or None."""
        found = search_pose(self.body, targets, self.config)
        apart = np.linalg.norm(np.stack([self.body.positions(found), self.places]) - targets, axis=2)
        new, old = marker_misfit(apart, self.config.outlier)
        if new < 0.7 * old:
            self.patience = self.PATIENCE * self.rate
            return found
        self.wait, self.patience = round(self.patience), 2 * self.patience
        return None

    def _to_pass_over(self, targets: np.ndarray, before: np.ndarray) -> bool:
        """Tell whether to ignore the markers (L, 3) of a frame; `before` are simulated markers of the prediction.

        That is so where no body explains them, or where the body jumped. A jump is accepted when the next frame
        confirms it, or when it lasts.
        """
        # 10 m/s: most by which all markers together move away from the prediction
        near = self.LOST + 10.0 * self.since / self.rate
        lost = bool(np.nanmedian(np.linalg.norm(self.places - targets, axis=1)) > self.LOST)
        leapt, self.leapt = self.leapt, np.full_like(before, np.nan) if lost else self.places
        # a median is NaN, and not below the limit, where some places are unknown
        self.believed = not lost and any(np.median(np.linalg.norm(self.places - of, axis=1)) <= near
                                         for of in (before, leapt))
        if self.believed:
            self.since = self.passed = 0
            return False
        self.passed += 1
        return self.passed <= 0.25 * self.rate                          # ignored for at most a quarter of a second
