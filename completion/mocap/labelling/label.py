"""Labels for markers without names: which point of every frame is which marker of a body."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from model.body import BodyModel
from model.linear import Subject
from scanprep.judgement import Judgement
from scanprep.threads import one_thread

from ...motion import Motion, Progress
from ..files.markers import MarkerSequence
from ..marker_sets.layout import MarkerLayout
from ..mosh.mosh import PoseConfig
from ..pose.follow import animate
from ..pose.marked_body import AnimateConfig, MarkedBody
from ..subject.frame_starts import mean_person
from ..subject.person import PersonFit, find_person
from .body_search import OTHERS, UPS, BodySearch, Placement
from .follow_points import assign_by_places, elect, take_columns, vote
from .tracks import link_points

UNKNOWN, GHOST = -1, -2              # in labels that are known: nothing is, and: this point is no marker
FEWEST = 10                          # points in a frame, of which no body can be told otherwise
STARTS = 5                           # frames in which the body is sought
FOUND = 0.3                          # misfit of a frame above which no body was found; right ones had at most 0.18
# metres from its place that a marker lies, in each direction: of the mean person's first, of the person's own at last
DEVIATIONS = (0.03, 0.02, 0.012)
SAME = 0.001                         # share of labels that may change without the person being found anew
SURE = 0.9                           # confidence below which a label is doubted
POSES = PoseConfig.weighted(2.0, 0.3, 57600.0)                          # as of `mosh`


@dataclass(frozen=True, eq=False)
class LabelledMarkers:
    """Which point is which marker.

    Attributes
    ----------
    markers : MarkerSequence
        The markers of the layout that were found, in its order.
    columns : (T, L) int
        The column of the points that each of them is, in every frame; -1 without one.
    confidence : (T, L) float
        Of each label, 0 to 1; 0 without a point.
    unlabelled : (T, C) bool
        Points that are no marker of this body.
    tracks : (T, C) int
        The track of every point, -1 without one.
    motion : Motion
        Of the body that the labels were found with.
    subject : Subject
        That body: the one that was given, or the one that was found.
    layout : MarkerLayout
        Where the markers sit on it.
    person : PersonFit or None
        Who was found, where the shape was not known.
    """

    markers: MarkerSequence
    columns: np.ndarray
    confidence: np.ndarray
    unlabelled: np.ndarray
    tracks: np.ndarray
    motion: Motion
    subject: Subject
    layout: MarkerLayout
    person: PersonFit | None

    @property
    def judgement(self) -> Judgement:
        """What the labels are worth: how many points have one, how sure they are, and how the body fits."""
        there = self.columns >= 0
        doubted = float((self.confidence[there] < SURE).mean()) if there.any() else 1.0
        alone = float(self.unlabelled.sum() / max((self.tracks >= 0).sum(), 1))
        residual = float(np.nanmedian(self.motion.residuals)) if there.any() else np.inf
        bad, check = [], []
        if residual > 0.04:
            bad.append(f"labelled points lie {1000 * residual:.0f} mm from the body: another layout, or not one person?")
        if doubted > 0.02:
            check.append(f"{100 * doubted:.0f}% of the labels are doubtful")
        if alone > 0.1:
            check.append(f"{100 * alone:.0f}% of the points have no label: another person, props, or another layout?")
        return Judgement.of(bad, check)


@one_thread()
def label_markers(model: BodyModel | Subject, points: MarkerSequence, layout: MarkerLayout,
                  known: np.ndarray | None = None, progress: Progress | None = None) -> LabelledMarkers:
    """Find the label of every point in every frame, from nothing but where the points are.

    Points are joined to tracks as far as their motion tells. In a few frames the body is sought in many poses and
    turns; from the best it goes both ways through key frames, which vote for the labels of tracks. These labels tell
    the person's shape, marker places and motion, and the body with its own markers says anew which point is which.

    Parameters
    ----------
    model : BodyModel or Subject
        Of a person of unknown shape a model with betas; of a known one the subject, with the layout as worn.
    points : MarkerSequence
        Its labels are not looked at. Columns may be tracks, or shuffled in every frame.
    layout : MarkerLayout
        Where markers sit. Those that are not in the recording stay without points.
    known : (T, C) int, optional
        Labels that are known: the row of the layout that a point is, `GHOST` for a point that is no marker, `UNKNOWN`.
    progress : callable, optional
        Called with (done, total).

    Raises
    ------
    ValueError
        No frame with ten points, no body that fits them, a layout of another body.
    """
    tell = progress or (lambda done, total: None)
    T, at, rate = len(points.positions), points.positions, points.rate
    most = int(points.seen.sum(axis=1).max(initial=0))
    if most < FEWEST:
        raise ValueError(f"points: expected a frame with at least {FEWEST} points to find a body in, the best has {most}")
    tracks = link_points(at, rate)
    known = model if isinstance(model, Subject) else None
    total = (1 if known else 2) * (T + STARTS) + len(DEVIATIONS) * T

    # labels by the votes of key frames: of the mean person, then of the person who is found by them
    subject, fit = known or model.subject(), None
    body = mean_person(subject, layout) if known is None else _own(subject, layout)
    columns = told = _label_by_votes(BodySearch(body, subject), at, tracks, rate, lambda done: tell(done, total))
    if known is None:
        fit = find_person(model, _sequence(at, columns, layout, rate), layout)
        subject = model.subject(fit.betas)
        body = _own(subject, fit.layout)
        columns = _label_by_votes(BodySearch(body, subject), at, tracks, rate,
                                  lambda done: tell(T + STARTS + done, total))

    # the motion of the person tells the labels anew, and these the person, ever closer
    worn = layout if fit is None else fit.layout
    done = total - len(DEVIATIONS) * T
    for sd in DEVIATIONS:
        markers = _sequence(at, columns, layout, rate)
        if known is None and (columns != told).mean() > SAME:
            told = columns
            fit = find_person(model, markers, layout)
            subject, worn = model.subject(fit.betas), fit.layout
            body = _own(subject, worn)
        motion = animate(subject, markers, worn, POSES)
        places = body.positions(body.body.join(motion.poses, motion.trans))
        columns, sure = assign_by_places(at, tracks, places, rate, sd)
        done += T
        tell(done, total)
    unlabelled = points.seen.copy()
    frames, rows = np.nonzero(columns >= 0)
    unlabelled[frames, columns[frames, rows]] = False
    return LabelledMarkers(_sequence(at, columns, layout, rate), columns, sure, unlabelled, tracks, motion, subject,
                           worn, fit)


def _label_by_votes(search: BodySearch, points: np.ndarray, tracks: np.ndarray, rate: float,
                    tell: Callable[[int], None]) -> np.ndarray:
    """Columns (T, L) of the markers by the votes of key frames, from the best of a few frames on."""
    start = find_start(search, points, tell)
    return elect(vote(search, points, tracks, rate, start, lambda done: tell(STARTS + done)), tracks)


def find_start(search: BodySearch, points: np.ndarray, tell: Callable[[int], None]) -> tuple[int, Placement]:
    """The frame, of a few well seen ones, in which a body fits best, and where it is there."""
    seen = np.isfinite(points[..., 0])
    full = np.flatnonzero(seen.sum(axis=1) >= max(FEWEST, 0.9 * seen.sum(axis=1).max()))
    frames = full[np.unique(np.linspace(0, len(full) - 1, STARTS + 2).round().astype(int)[1:-1])]
    tried = list[tuple[int, Placement]]()
    for axes in (UPS, OTHERS):
        for i, t in enumerate(frames):
            tried.append((int(t), search.find(points[t, seen[t]], axes)))
            tell(i + 1)
        best = min(tried, key=lambda one: one[1].misfit)
        if best[1].misfit < FOUND:
            return best
    raise ValueError(f"points: no body with these markers was found in frames {', '.join(map(str, frames))}: the best "
                     f"leaves {best[1].misfit:.2f}, expected below {FOUND}; another layout, several people, or metres "
                     "taken for millimetres?")


def _own(subject: Subject, layout: MarkerLayout) -> MarkedBody:
    """A known person with the markers where they sit."""
    return MarkedBody(subject, layout, AnimateConfig.prior_weight, AnimateConfig.prior_shrinkage)


def _sequence(points: np.ndarray, columns: np.ndarray, layout: MarkerLayout, rate: float) -> MarkerSequence:
    return MarkerSequence(take_columns(points, columns), layout.labels, rate)
