"""Real-time labelling: one frame of unlabelled points in, labels and pose out."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from model.linear import Subject

from ..marker_sets.layout import MarkerLayout
from ..pose.marked_body import AnimateConfig, MarkedBody, marker_weights, point_system
from ..pose.stream import KalmanPrediction
from .assignment import certainty
from .body_search import ALONE, JUDGED, BodySearch, Placement
from .follow_points import OWN_PERSON, take_points
from .label import FEWEST, FOUND
from .limb_watch import LimbWatch
from .live_matching import ALONE as UNMATCHED
from .live_matching import SEEN_SD, Expected, intersect, match, shift_groups
from .tracks import ACCELERATION, BRIDGE

ROUNDS = 3                           # most rounds of matching and solving; one is enough without doubtful labels
LABELS, GONE = 4, 0.5                # a body with fewer labels for that many seconds is gone
STRAINED, LOST = 0.2, 0.5            # mean strain above which the body is searched again, and above which it is lost
PATIENCE, LONGEST = 0.5, 8.0         # seconds from a search without success to the next, doubled up to LONGEST
SETTLED = 10                         # most steps in which a body that was found is refined


@dataclass(frozen=True, eq=False)
class LabelledFrame:
    """The result for one frame of points.

    Attributes
    ----------
    columns : (L,) int
        Point of each marker of the layout, -1 without one.
    confidence : (L,) float
        Of each label, 0 to 1; 0 without a point.
    pose : (J, 3) float, radians
        NaN where no body is followed.
    trans : (3,) float, metres
    found : bool
        A body is followed, also for half a second without points. If not, there are no labels.
    """

    columns: np.ndarray
    confidence: np.ndarray
    pose: np.ndarray
    trans: np.ndarray
    found: bool


class LabelStream:
    """Label points and compute the motion of a person of known shape, frame by frame as unlabelled points arrive.

    The motion so far predicts each marker, with its uncertainty, and points are matched within that. A body that was
    not found yet, or has left, is searched in the points of one frame. That takes about half a second, so there are
    pauses between searches. A limb that fits worse than usual is searched again in 30 ms.

    Parameters
    ----------
    subject : Subject
        The person, such as `label_markers(...).subject`.
    layout : MarkerLayout
        Where the markers sit on this person, such as `label_markers(...).layout`.
    rate : float, frames per second
        Of the frames that `push` gets.

    Raises
    ------
    ValueError
        Fewer than ten markers in the layout, a layout of another body, a rate that is not above zero.

    Examples
    --------
    >>> from completion import load_layout
    >>> from model import load_built_in_model
    >>> model = load_built_in_model()
    >>> layout = load_layout("cmu41", model)
    >>> stream = LabelStream(model.subject(), layout, 120.0)
    >>> frame = stream.push(layout.place(model.template)[::-1])         # (N, 3), metres, in any order
    >>> frame.found, frame.columns[:3].tolist()
    (True, [40, 39, 38])

    [SCAPE] §8
    """

    def __init__(self, subject: Subject, layout: MarkerLayout, rate: float) -> None:
        if not (np.isfinite(rate) and rate > 0):
            raise ValueError(f"rate: expected a number above 0, frames per second, got {rate}")
        if len(layout.labels) < FEWEST:
            raise ValueError(f"layout: expected at least {FEWEST} markers, got {len(layout.labels)}")
        self.config, self.rate = AnimateConfig(), float(rate)
        self.body = MarkedBody(subject, layout, self.config.prior_weight, self.config.prior_shrinkage)
        self.search = BodySearch(self.body, subject)
        self.watch = LimbWatch(self.search)
        self.prediction = KalmanPrediction(self.body, self.config, self.rate)
        self.memory = _Memory(self.body.count, self.rate)
        self.x, self.found = np.full(self.body.n_unknowns, np.nan), False
        self.belief = np.full(self.body.count, np.nan)                  # confidence so far, NaN where unknown
        self.empty, self.quiet, self.patience = 0.0, 0.0, PATIENCE      # seconds

    def push(self, points: np.ndarray) -> LabelledFrame:
        """Process the next frame.

        Parameters
        ----------
        points : (N, 3) float, metres
            In any order and any number; NaN where one is out of sight.

        Returns
        -------
        LabelledFrame
            Columns (L,) of the markers, confidence (L,), pose (J, 3) in radians, trans (3,) in metres.

        Raises
        ------
        ValueError
            Points of another shape.
        """
        points = np.asarray(points, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(f"points: expected shape (N, 3), metres, got {points.shape}; pass one frame at a time")
        # visible points: finite, and within 1,000 km
        seen = np.flatnonzero((np.abs(points) < 1e6).all(axis=1))
        visible, dt = points[seen], 1 / self.rate
        self.quiet -= dt
        self.memory.unseen += dt
        if not self.found and not self._begin(visible):
            return self._frame(np.full(self.body.count, -1), seen)

        # labels and pose, and their confidence
        chosen, sure, places = self._follow(visible)
        self.memory.update(visible, chosen, places)
        self.watch.update(visible, chosen, places, dt)
        self._believe(visible, chosen, places, sure)
        frame = self._frame(chosen, seen)

        # prepare the next frame: search a limb or the body again, or give the body up
        self.empty = self.empty + dt if (chosen >= 0).sum() < LABELS else 0.0
        if self.empty > GONE:
            self.found = False
        elif len(visible) >= self._enough and not self._replace_body(visible):
            self._replace_limb(visible)
        return frame

    @property
    def _enough(self) -> float:
        """Least number of points for a search."""
        return max(FEWEST, 0.5 * self.body.count)

    def _follow(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Match and solve a frame; return points (L,) of the markers, confidence (L,) and simulated markers (L, 3)."""
        body, prediction = self.body, self.prediction
        expected, information = prediction.expect()
        x, C, spread = expected, prediction.covariance, self.memory.spread()
        clear = 0.99  # with this confidence of every label one round is enough,
        small = 0.01  # if it moves no marker by more than 1 cm
        for i in range(ROUNDS):
            # predict markers: from the body at x with covariance C and their offsets, and from their tracks
            pose, trans, _ = body.body.split(x[None])
            y, columns = body.shapes.columns(pose, trans)
            places, slopes = y[0].T, columns[0].transpose(2, 0, 1).copy()                        # (L, 3), (L, P, 3)
            S = np.swapaxes(slopes, 1, 2) @ (C @ slopes) + spread[:, None, None] * np.eye(3)
            on_body = Expected(places + self.memory.offsets(), np.linalg.inv(S))
            chosen, sure = match(self.memory.with_tracks(on_body), points, len(points) < FEWEST)
            shifted = shift_groups(on_body, slopes, C, spread, points, chosen)
            doubt = bool((shifted != chosen).any())
            chosen, sure = shifted, np.where(shifted != chosen, 0.5, sure)
            if not (chosen >= 0).any():
                break
            # one Gauss-Newton step; doubtful markers have less weight at first
            targets = take_points(points, chosen)
            weights, _ = marker_weights(on_body.places, targets, self.config.marker_sd, self.config.outlier)
            if i == 0 and not doubt:
                weights = weights * np.maximum(2 * sure - 1, 0.0)
            equations = body.with_prior(point_system(y, columns, targets[None], weights[None]), pose)
            H = equations.hessian[0] + information
            pull = information @ body.step_to(expected, x) if i else 0.0                         # 0 at the prediction
            step = -np.linalg.solve(H, equations.gradient[0] + pull)
            x, moved = body.retract(x, step), step @ slopes
            places = places + moved
            if not doubt and (sure[chosen >= 0] > clear).all() and np.abs(moved).max() < small:
                break
            if i < ROUNDS - 1:
                C = np.linalg.inv(H)
        measured = H - information if (chosen >= 0).any() else np.zeros_like(information)
        prediction.update(x, measured)
        self.x = x
        return chosen, sure, places

    def _believe(self, points: np.ndarray, chosen: np.ndarray, places: np.ndarray, sure: np.ndarray) -> None:
        """Update the confidence: that of the match, limited by what the body alone has said over time."""
        there = chosen >= 0
        # 2 cm: standard deviation of a marker when the body alone tells the labels
        apart = ((points - places[:, None])**2).sum(axis=-1) / (2 * 0.02**2)
        alone = certainty(apart, chosen, UNMATCHED) * np.where(self.watch.doubtful(), 0.5, 1.0)
        # 0.5 s: time constant in which a doubtful label regains confidence
        earned = self.belief + (alone - self.belief) * min(1.0, 1 / (0.5 * self.rate))
        earned = np.where(np.isnan(earned), alone, earned)
        self.belief = np.where(there, np.minimum(earned, sure), self.belief)

    def _begin(self, points: np.ndarray) -> bool:
        """Search the body in the points (N, 3) of a frame; return whether it was found."""
        if len(points) < self._enough or self.quiet > 0:
            return False
        found = self._find(points)
        # hidden markers cost the right body as much as any other
        hidden = ALONE * max(0, self.body.count - len(points)) / self.body.count
        if self.search.judge(found.x, points, JUDGED).misfit - hidden > FOUND:
            self._wait()
            return False
        self._go_on_from(found)
        return True

    def _replace_body(self, points: np.ndarray) -> bool:
        """Search the body again where it has fitted badly for a while; return whether it moved or was lost."""
        if self.watch.mean_strain < STRAINED or self.quiet > 0:
            return False
        now, found = self.search.judge(self.x, points, OWN_PERSON.judged), self._find(points)
        # 1.0: gain in misfit, in markers, for which the new body is taken
        if (now.misfit - found.misfit) * self.body.count > 1.0:
            self._go_on_from(found)
            return True
        self._wait()
        self.found = self.watch.mean_strain < LOST
        return not self.found

    def _replace_limb(self, points: np.ndarray) -> None:
        """Continue with another pose of a limb where that fits better."""
        found = self.watch.seek(self.x, points)
        if found is None:
            return
        placement, rows, joints = found
        velocity = self.prediction.velocity.copy()
        velocity[[3 * joint + axis for joint in joints for axis in range(3)]] = 0.0
        self.prediction.begin(placement.x)
        self.prediction.velocity, self.x = velocity, placement.x
        self.memory.forget(rows)
        self.belief[rows] = np.nan

    def _find(self, points: np.ndarray) -> Placement:
        """Search the best body in a frame of points (N, 3) alone."""
        found = self.search.judge(self.search.find(points).x, points, OWN_PERSON.judged)
        found = self.search.restart_limbs(found, points, OWN_PERSON.judged)
        # refine it as closely as `_follow` will
        targets = take_points(points, found.matches)
        weights, _ = marker_weights(self.body.positions(found.x), targets, self.config.marker_sd, self.config.outlier)
        x = self.body.solve(found.x[None], targets, weights, SETTLED, 1e-4).x[0]
        return min(found, self.search.judge(x, points, OWN_PERSON.judged), key=lambda one: one.misfit)

    def _go_on_from(self, placement: Placement) -> None:
        """Continue from a body that was found, at rest."""
        self.prediction.begin(placement.x)
        self.x, self.found, self.empty = placement.x, True, 0.0
        self.memory.forget(np.arange(self.body.count))
        self.watch.begin()
        self.belief[:] = np.nan
        self.quiet = self.patience = PATIENCE

    def _wait(self) -> None:
        """Wait until the next search, twice as long every time."""
        self.quiet, self.patience = self.patience, min(2 * self.patience, LONGEST)

    def _frame(self, chosen: np.ndarray, seen: np.ndarray) -> LabelledFrame:
        """Return the result, in columns of the original points."""
        there = chosen >= 0
        columns = np.full(self.body.count, -1)
        columns[there] = seen[chosen[there]]
        pose, trans, _ = self.body.body.split(self.x if self.found else np.full_like(self.x, np.nan))
        return LabelledFrame(columns, np.where(there, self.belief, 0.0), pose.copy(), trans.copy(), self.found)


class _Memory:
    """Memory of each marker: last point, velocity, offset from the body."""

    FORGOTTEN = 0.25                     # seconds out of sight after which the offset of a marker is forgotten

    def __init__(self, count: int, rate: float) -> None:
        self.bridge = max(BRIDGE, 1.5 / rate)                           # seconds of extrapolation by constant velocity
        self.unseen = np.full(count, np.inf)                            # seconds since the last point
        self.last, self.velocity, self.off = (np.zeros((count, 3)) for _ in range(3))
        self.moving = np.zeros(count, dtype=bool)                       # the velocity is known

    def forget(self, rows: np.ndarray) -> None:
        """Forget some markers (n,)."""
        self.unseen[rows], self.moving[rows] = np.inf, False

    def offsets(self) -> np.ndarray:
        """Return offsets (L, 3), metres, of points from simulated markers, fading while a marker is out of sight."""
        return np.exp(-self.unseen / self.FORGOTTEN)[:, None] * self.off

    def spread(self) -> np.ndarray:
        """Compute the variance (L,), m², of each point about its simulated marker plus offset."""
        worn_sd = 0.025  # metres: standard deviation of a point whose offset is unknown
        return np.minimum(SEEN_SD**2 + worn_sd**2 * self.unseen / self.FORGOTTEN, worn_sd**2)

    def with_tracks(self, expected: Expected) -> Expected:
        """Combine predictions by the body with extrapolation at constant velocity, for recently seen markers."""
        rows = np.flatnonzero(self.moving & (self.unseen < self.bridge))
        if not len(rows):
            return expected
        dt = self.unseen[rows]
        # 4 mm plus the effect of acceleration; constant velocity misses by 0.6 mm at the median at 120 Hz
        sd = 0.004 + 0.5 * ACCELERATION * dt**2
        ahead = self.last[rows] + self.velocity[rows] * dt[:, None]
        return intersect(expected, Expected(ahead, np.eye(3) / sd[:, None, None]**2), rows)

    def update(self, points: np.ndarray, chosen: np.ndarray, places: np.ndarray) -> None:
        """Remember a frame: points (N, 3), the one of each marker (L,), and simulated markers (L, 3)."""
        rows = np.flatnonzero(chosen >= 0)
        at, dt = points[chosen[rows]], self.unseen[rows]
        # 0.015 s: time constant over which offsets are averaged
        share = np.where(dt < self.FORGOTTEN, 1 - np.exp(-dt / 0.015), 1.0)[:, None]
        self.off[rows] += share * (at - places[rows] - self.off[rows])
        self.moving[rows] = dt < self.bridge
        self.velocity[rows] = (at - self.last[rows]) / dt[:, None]
        self.last[rows], self.unseen[rows] = at, 0.0
