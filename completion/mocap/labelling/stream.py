"""Labels while the points come in: one frame without names in, labels and a pose out."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from model.linear import Subject

from ..marker_sets.layout import MarkerLayout
from ..pose.marked_body import AnimateConfig, MarkedBody
from ..pose.stream import Tracker
from .assignment import ALONE, AWAY
from .body_search import BodySearch, Placement, assign
from .follow_points import OWN_PERSON
from .label import FEWEST, FOUND

STEPS = 2                            # of the solution of a frame, which begins where it is expected; 3 label alike
PLACE_SD = 0.025                     # metres that a point lies from where the body is expected to have its marker
TRACK_SD = 0.008                     # metres, and from where constant velocity has its point; 0.6 mm at 120 Hz, 7 at 30
ACCELERATION = 15.0                  # m/s² that the latter may miss besides, half of it over the squared frame time
MEMORY = 0.1                         # seconds for which constant velocity is believed
GONE = 0.5                           # seconds with hardly a point after which the body is sought anew
PATIENCE, LONGEST = 0.5, 8.0         # seconds from a search to the next, doubled while nothing better is found
FEW = 0.85                           # share of markers, or points if those are fewer, below which it is sought anew
OFF = 0.02                           # metres, median distance from the body above which it is sought anew
BETTER = 0.3                         # markers of misfit that what is found has to gain


@dataclass(frozen=True, eq=False)
class LabelledFrame:
    """What one frame of points tells.

    Attributes
    ----------
    columns : (L,) int
        The point of each marker of the layout, -1 without one.
    confidence : (L,) float
        Of each label, 0 to 1; 0 without a point.
    pose : (J, 3) float, radians
        NaN as long as no body was found.
    trans : (3,) float, metres
    found : bool
        The body is where the points are; without it there are no labels.
    """

    columns: np.ndarray
    confidence: np.ndarray
    pose: np.ndarray
    trans: np.ndarray
    found: bool


class LabelStream:
    """Labels of a person of known shape, frame by frame as the points arrive.

    Where the body is expected, and where constant velocity has the points of the last frame, tell which point is which
    marker. A body that was not found yet, has left or fits badly is sought in the points of a frame; that takes about
    half a second, once, then after ever longer pauses.

    Parameters
    ----------
    subject : Subject
        The person, as of `label_markers(...).subject`.
    layout : MarkerLayout
        Where the markers sit on it, as of `label_markers(...).layout`.
    rate : float, frames per second

    Raises
    ------
    ValueError
        Fewer than ten markers in the layout, a rate that is not above zero.

    Examples
    --------
    >>> stream = LabelStream(labelled.subject, labelled.layout, 120.0)
    >>> frame = stream.push(points)                                     # (N, 3), metres, in any order
    >>> places = np.where(frame.columns[:, None] >= 0, points[frame.columns], np.nan)

    [SCAPE] §8
    """

    def __init__(self, subject: Subject, layout: MarkerLayout, rate: float) -> None:
        if not rate > 0:
            raise ValueError(f"rate: expected a number above 0, got {rate}")
        if len(layout.labels) < FEWEST:
            raise ValueError(f"layout: expected at least {FEWEST} markers, got {len(layout.labels)}")
        config = AnimateConfig()
        self.body = MarkedBody(subject, layout, config.prior_weight, config.prior_shrinkage)
        self.search, self.rate = BodySearch(self.body, subject), rate
        self.tracker = Tracker(self.body, config, rate, STEPS)
        L = self.body.count
        self.last, self.velocity = np.full((L, 3), np.nan), np.zeros((L, 3))
        self.age = np.full(L, np.inf)                                   # frames since each marker had a point
        self.empty, self.quiet, self.patience = 0, 0.0, PATIENCE

    def push(self, points: np.ndarray) -> LabelledFrame:
        """The next frame.

        Parameters
        ----------
        points : (N, 3) float, metres
            In any order; NaN where one is out of sight.
        """
        points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        seen = np.flatnonzero((np.abs(points) < 1e6).all(axis=1))
        visible, L = points[seen], self.body.count
        self.quiet -= 1 / self.rate
        self.age += 1
        self.empty = self.empty + 1 if len(seen) < FEWEST else 0
        if self.empty > GONE * self.rate:
            self.tracker.started = False
        if not self.tracker.started and not self._begin(visible):
            return self._frame(np.full(L, -1), np.zeros(L), seen, False)

        # labels by where markers are expected, then the body by its labelled points
        expected, _ = self.tracker.prediction.expect()
        chosen, sure = self._label(visible, self.body.positions(expected))
        self.tracker.wait = 1                                           # its own search knows labels only
        x, _ = self.tracker.push(_taken(visible, chosen))
        places = self.body.positions(x)
        again, sure = self._label(visible, places)
        if (again != chosen).any():                                     # the next frame begins from these
            chosen = again
        off = np.linalg.norm(_taken(visible, chosen) - places, axis=1)
        self._remember(_taken(visible, chosen))
        self._look_again(visible, x, chosen, off)
        return self._frame(chosen, sure, seen, True)

    def _label(self, points: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The point (L,) of each marker near its place (L, 3) and its track, -1 without one, and how sure that is."""
        cost = _half_squares(places, points, PLACE_SD)
        dt = self.age / self.rate
        followed = dt < max(MEMORY, 1.5 / self.rate)
        ahead = self.last + self.velocity * np.where(followed, dt, 0.0)[:, None]
        sd = TRACK_SD + 0.5 * ACCELERATION * np.where(followed, dt, 0.0)**2
        track = _half_squares(np.where(followed[:, None], ahead, 1e3), points, sd[:, None])
        cost = np.where(followed[:, None], 0.5 * (cost + track), cost)
        chosen, _ = assign(cost, ALONE)
        rows, sure = np.flatnonzero(chosen >= 0), np.zeros(len(places))
        if len(rows):
            here, others = cost[rows, chosen[rows]], cost.copy()
            others[rows, chosen[rows]] = np.inf
            rival = np.minimum(np.minimum(others[:, chosen[rows]].min(axis=0), others[rows].min(axis=1)), ALONE)
            sure[rows] = 1 / (1 + np.exp(np.maximum(here - rival, -50.0)))
        return chosen, sure

    def _remember(self, targets: np.ndarray) -> None:
        """Where the points (L, 3) of the markers are now, and how fast they went."""
        there = np.isfinite(targets[:, 0])
        fresh = there & (self.age * 1.0 / self.rate > MEMORY + 1.0 / self.rate)
        step = (targets - self.last) / np.maximum(self.age, 1)[:, None] * self.rate
        self.velocity[there] = np.where(fresh[there, None] | np.isnan(step[there]), 0.0, step[there])
        self.last[there], self.age[there] = targets[there], 0

    def _begin(self, points: np.ndarray) -> bool:
        """Seek the body in the points of a frame; whether it was found."""
        if len(points) < max(FEWEST, 0.5 * self.body.count) or self.quiet > 0:
            return False
        placement = self.search.find(points)
        if placement.misfit > FOUND:
            self.quiet, self.patience = self.patience, min(2 * self.patience, LONGEST)
            return False
        self._go_on_from(placement)
        return True

    def _look_again(self, points: np.ndarray, x: np.ndarray, chosen: np.ndarray, off: np.ndarray) -> None:
        """Seek the body, or a limb of it, anew where the labelled points are few or far from it."""
        few = (chosen >= 0).sum() < FEW * min(self.body.count, len(points))
        far = not (np.nanmedian(off) < OFF) if (chosen >= 0).any() else True
        if not (few or far) or self.quiet > 0 or len(points) < max(FEWEST, 0.5 * self.body.count):
            return
        scale = OWN_PERSON.judged
        now = self.search.judge(x, points, scale)
        found = self.search.restart_limbs(now, points, scale)
        if far:
            anew = self.search.judge(self.search.find(points).x, points, scale)
            found = min(found, anew, key=lambda one: one.misfit)
        if (now.misfit - found.misfit) * self.body.count > BETTER:
            self._go_on_from(found)
        else:
            self.quiet, self.patience = self.patience, min(2 * self.patience, LONGEST)

    def _go_on_from(self, placement: Placement) -> None:
        """Continue from a body that was found, at rest."""
        self.tracker.begin(placement.x)
        self.age[:] = np.inf
        self.quiet = self.patience = PATIENCE

    def _frame(self, chosen: np.ndarray, sure: np.ndarray, seen: np.ndarray, found: bool) -> LabelledFrame:
        """The result, in columns of the points as they were given."""
        columns = np.where(chosen >= 0, seen[np.maximum(chosen, 0)] if len(seen) else -1, -1)
        if not found:
            return LabelledFrame(columns, sure, np.full((self.body.body.n_angles // 3, 3), np.nan), np.full(3, np.nan),
                                 False)
        pose, trans, _ = self.body.body.split(self.tracker.prediction.x)
        return LabelledFrame(columns, sure, pose, trans, True)


def _half_squares(places: np.ndarray, points: np.ndarray, sd: float | np.ndarray) -> np.ndarray:
    """Half the squared deviations (L, N) of points (N, 3) from places (L, 3), at most `AWAY`."""
    squared = ((places[:, None] - points)**2).sum(axis=-1)
    return np.minimum(squared / (2 * sd**2), AWAY)


def _taken(points: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """The points (L, 3) that were chosen, NaN where none was."""
    if not len(points):
        return np.full((len(chosen), 3), np.nan)
    return np.where(chosen[:, None] >= 0, points[np.maximum(chosen, 0)], np.nan)
