"""Label unlabelled markers: find which point of every frame is which marker of a body."""
from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from model.body import BodyModel
from model.linear import Subject
from model.people import person_judgement
from scanprep.judgement import Judgement
from scanprep.threads import one_thread

from ...motion import Motion, Progress
from ..files.markers import MarkerSequence
from ..marker_sets.layout import MarkerLayout
from ..movement import pace_doubts, posture_doubts
from ..pose.follow import animate
from ..pose.judgement import motion_doubts, motion_problem
from ..pose.marked_body import AnimateConfig, MarkedBody
from ..subject.frame_starts import mean_person
from ..subject.misplaced_markers import find_misplaced_markers
from ..subject.person import PersonConfig, PersonFit, find_person
from .assignment import assign_by_places, elect, find_displaced, label_of_track, mean_offsets, take_columns
from .body_search import OTHERS, UPS, BodySearch, Placement
from .follow_points import KeyFrame, Solutions, count_votes, follow_keys, key_frames, solve_again
from .layout_order import order_by_layout
from .separate import separate_people
from .tracks import link_points

UNKNOWN, GHOST = -1, -2              # known labels: none for this point; a ghost marker that belongs to no body
FEWEST = 10                          # least points of a frame; fewer do not determine a body
STARTS = 5                           # frames in which the body is searched
# Limits in metres on the median distance of points from their middle; one person has 0.4 to 0.6.
SPREAD = 0.1, 5.0
FOUND = 0.3                          # largest misfit of a frame with a body; correct bodies had at most 0.18
# Least standard deviation, metres, of a marker from its place in each direction, in the last three passes.
DEVIATIONS = (0.03, 0.02, 0.012)
SURE = 0.9                           # confidence below which a label is doubtful


@dataclass(frozen=True, eq=False)
class LabelledMarkers:
    """Labelled markers, and the body that they were found with.

    Attributes
    ----------
    markers : MarkerSequence
        The markers of the layout, in its order.
    columns : (T, L) int
        Column of the point of each marker in every frame; -1 without one.
    confidence : (T, L) float
        Confidence of each label, 0 to 1; 0 without a point.
    unlabelled : (T, C) bool
        Points that are not markers of this body.
    tracks : (T, C) int
        Track of every point, -1 without one.
    motion : Motion
        Motion of the body that the labels were found with.
    subject : Subject
        That body, known before or found.
    layout : MarkerLayout
        Places of the markers on it.
    person : PersonFit or None
        The fit of the person, where the shape was not known.
    plausible : Judgement
        Whether that person can be one, and wears the markers where the layout says.
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
    plausible: Judgement = field(default_factory=Judgement)

    @property
    def judgement(self) -> Judgement:
        """Judgement of the labels: share of labelled points, confidence, fit of the body, and its movement."""
        there = self.columns >= 0
        doubted = float((self.confidence[there] < SURE).mean()) if there.any() else 1.0
        alone = float(self.unlabelled.sum() / max((self.tracks >= 0).sum(), 1))
        residual = float(np.nanmedian(self.motion.residuals)) if there.any() else np.inf
        bad, check = [], []
        # 40 mm from the body: wrong layout or person; 2% doubtful labels or 10% unlabelled points: a doubt
        if residual > 0.04:
            bad.append(f"labelled points lie {1000 * residual:.0f} mm from the body: another layout or person?")
        if doubted > 0.02:
            check.append(f"{100 * doubted:.0f}% of the labels are doubtful")
        if alone > 0.1:
            check.append(f"{100 * alone:.0f}% of the points have no label: another person, props, or another layout?")
        template = self.subject.template
        problem = motion_problem(self.motion, template, self.layout, self.markers)
        check += [*motion_doubts([self.motion], [self.markers], template), *pace_doubts(self.motion, self.subject),
                  *posture_doubts(self.motion, self.subject)]
        return self.plausible.merge(Judgement.of(bad or problem, check))


def label_markers(model: BodyModel | Subject, points: MarkerSequence, layout: MarkerLayout,
                  known: np.ndarray | None = None, progress: Progress | None = None) -> LabelledMarkers:
    """Find the label of every point in every frame, from the positions of the points alone.

    Points are joined to tracks as far as their motion tells. In a few frames the body is searched in many poses and
    orientations. From the best frame it is followed in both directions through key frames, which vote for the labels of
    tracks. These labels give the person's shape, marker places and motion. The body with its own markers then labels
    the points again.

    Parameters
    ----------
    model : BodyModel or Subject
        A model with betas for an unknown person; a subject, with its own layout, for a known one.
    points : MarkerSequence
        Positions (T, C, 3) in metres; labels are ignored. Columns may be tracks, or shuffled in every frame.
    layout : MarkerLayout
        Where markers sit. Markers that are not in the recording stay without points.
    known : (T, C) int, optional
        Known labels: the row of the layout for each point, `GHOST` for a point that is no marker, else `UNKNOWN`.
    progress : callable, optional
        Called with (done, total).

    Returns
    -------
    LabelledMarkers
        Labelled markers (T, L, 3) in metres, columns (T, L), confidence (T, L), and the motion.

    Raises
    ------
    ValueError
        No frame with ten points, no body that fits them, a layout of another body.

    Examples
    --------
    >>> from completion import load_layout
    >>> from model import load_built_in_model
    >>> model = load_built_in_model()
    >>> layout = load_layout("cmu41", model)
    >>> raw = MarkerSequence(np.stack([layout.place(model.template)[::-1]] * 2), [f"*{i}" for i in range(41)], 120.0)
    >>> label_markers(model.subject(), raw, layout).columns[0].tolist() == list(range(41))[::-1]
    True

    [SCAPE] §8
    """
    return label_people([(model, layout)], points, known, progress)[0]


@one_thread()
def label_people(people: Sequence[tuple[BodyModel | Subject, MarkerLayout]], points: MarkerSequence,
                 known: np.ndarray | None = None, progress: Progress | None = None) -> list[LabelledMarkers]:
    """Label the markers of several people in one volume.

    All markers of all people compete for the points of a frame, so no point gets two labels.

    Parameters
    ----------
    people : sequence of (BodyModel or Subject, MarkerLayout)
        One for each person, as for `label_markers`.
    points : MarkerSequence
        Positions (T, C, 3) in metres; labels are ignored.
    known : (T, C) int, optional
        As for `label_markers`; rows of the layouts are numbered through all people.
    progress : callable, optional
        Called with (done, total).

    Returns
    -------
    list of LabelledMarkers
        One for each person.

    Raises
    ------
    ValueError
        As for `label_markers`; no frame in which the people stand apart.

    Examples
    --------
    >>> from completion import load_layout
    >>> from model import load_built_in_model
    >>> model = load_built_in_model()
    >>> layout = load_layout("cmu41", model)
    >>> raw = MarkerSequence(np.stack([layout.place(model.template)] * 2), layout.labels, 120.0)
    >>> [one.columns.shape for one in label_people([(model.subject(), layout)], raw)]
    [(2, 41)]

    [SCAPE] §8
    """
    report_progress = progress or (lambda done, total: None)
    at, rate, T = points.positions, points.rate, len(points.positions)
    known = _check_known(known, points, sum(len(layout.labels) for _, layout in people))
    tracks = link_points(at, rate)

    # find the bodies, mean people or known ones, in one frame, follow them through key frames, and let these vote
    bodies = [_Person.start(model, layout) for model, layout in people]
    searches = [BodySearch(body.marked, body.subject) for body in bodies]
    first, placements = find_start(searches, at, lambda done: report_progress(done, 4 * T))
    times, keys = key_frames(at, tracks, known, rate, first)
    begin = int(np.searchsorted(times, first))
    found = follow_keys(searches, keys, begin, placements,
                        lambda done: report_progress(T * done // len(keys), 4 * T))
    columns = elect(count_votes(keys, found, tracks.max() + 1), tracks)
    columns, found = _in_order(bodies, columns, keys, found)

    # the same with the fitted people, from the solutions so far
    bodies = [body if isinstance(model, Subject) else _find_person(body, model, at, mine, rate)
              for body, (model, _), mine in zip(bodies, people, _of_each(bodies, columns), strict=True)]
    searches = [BodySearch(body.marked, body.subject) for body in bodies]
    labels = label_of_track(columns, tracks)
    found = solve_again(searches, keys, found, labels)
    columns = elect(count_votes(keys, found, tracks.max() + 1), tracks)
    columns, found = _in_order(bodies, columns, keys, found)

    # three passes: motion, then labels by the simulated markers, with ever smaller deviations
    told = np.full_like(columns, -2)
    for i, sd in enumerate(DEVIATIONS):
        # 0.001: share of changed labels above which the person is fitted again
        changed = (columns != told).mean() > 0.001
        told = columns
        for k, mine in enumerate(_of_each(bodies, columns)):
            model = people[k][0]
            if changed and not isinstance(model, Subject):
                bodies[k] = _find_person(bodies[k], model, at, mine, rate)
        motions = [body.follow(at, mine, rate) for body, mine in zip(bodies, _of_each(bodies, columns), strict=True)]
        simulated = [body.simulate(motion) for body, motion in zip(bodies, motions, strict=True)]
        places = np.concatenate([markers for markers, _ in simulated], axis=1)
        turns = np.concatenate([rotations for _, rotations in simulated], axis=1)
        # usual offsets of markers from their simulation, in the axes of their parts; new places of displaced markers
        part = np.concatenate([body.part + 1000 * k for k, body in enumerate(bodies)])
        offsets, deviations = mean_offsets(at, columns, places, turns)
        offsets = offsets + find_displaced(at, columns, places, turns, part)
        places += np.einsum("tlij,lj->tli", turns, offsets)
        columns, sure = assign_by_places(at, tracks, known, places, rate, np.clip(deviations, sd, DEVIATIONS[0]))
        report_progress((i + 2) * T, (len(DEVIATIONS) + 1) * T)

    # what is left has no label
    unlabelled = points.seen.copy()
    frames, rows = np.nonzero(columns >= 0)
    unlabelled[frames, columns[frames, rows]] = False
    labelled = [_sequence(at, mine, body.layout, rate) for body, mine in zip(bodies, _of_each(bodies, columns),
                                                                             strict=True)]
    return [LabelledMarkers(markers, mine, certain, unlabelled, tracks, motion, body.subject, body.layout, body.fit,
                            _judge_person(model, body, markers))
            for (model, _), body, markers, motion, mine, certain
            in zip(people, bodies, labelled, motions, _of_each(bodies, columns), _of_each(bodies, sure), strict=True)]


def _judge_person(model: BodyModel | Subject, person: _Person, markers: MarkerSequence) -> Judgement:
    """Judge a person that was found from labelled markers; a known one is not in question."""
    if isinstance(model, Subject) or person.fit is None:
        return Judgement()
    misplaced = find_misplaced_markers(model, [markers], person.usual, person.fit, PersonConfig())
    # a body found under exchanged names is strange, and the names are why
    if misplaced.changes:
        return misplaced.judgement(markers.labels)
    return person.fit.judgement(person.usual).merge(person_judgement(model, person.fit.betas))


@dataclass(frozen=True, eq=False)
class _Person:
    """A person, the usual layout, and the body with markers, as known so far."""

    POSES = AnimateConfig(marker_sd=0.007)                               # metres: markers at known places, as in `mosh`

    subject: Subject
    layout: MarkerLayout
    usual: MarkerLayout
    marked: MarkedBody
    fit: PersonFit | None = None

    @property
    def part(self) -> np.ndarray:
        """Part (L,) that carries each marker."""
        return self.subject.skeleton.part_of_vertex(self.subject.template)[self.layout.nearest]

    @staticmethod
    def start(model: BodyModel | Subject, layout: MarkerLayout) -> _Person:
        """Start with the mean person of a model, or with a known person."""
        if isinstance(model, Subject):
            return _Person(model, layout, layout, _own(model, layout))
        subject = model.subject()
        return _Person(subject, layout, layout, mean_person(subject, layout))

    def follow(self, points: np.ndarray, columns: np.ndarray, rate: float) -> Motion:
        """Compute the motion for the labels in columns (T, L)."""
        return animate(self.subject, _sequence(points, columns, self.layout, rate), self.layout, self.POSES)

    def simulate(self, motion: Motion) -> tuple[np.ndarray, np.ndarray]:
        """Compute the markers (T, L, 3) of a motion, metres, and the rotations (T, L, 3, 3) of their parts."""
        x = self.marked.body.join(motion.poses, motion.trans)
        turns = self.marked.shapes.rotations(np.swapaxes(motion.poses, 0, 1))[self.part]
        return self.marked.positions(x), np.swapaxes(turns, 0, 1)


def _find_person(person: _Person, model: BodyModel, points: np.ndarray, columns: np.ndarray, rate: float) -> _Person:
    """Fit a person of unknown shape for the labels in columns (T, L)."""
    fit = find_person(model, _sequence(points, columns, person.usual, rate), person.usual)
    subject = model.subject(fit.betas)
    return _Person(subject, fit.layout, person.usual, _own(subject, fit.layout), fit)


def _in_order(bodies: Sequence[_Person], columns: np.ndarray, keys: Sequence[KeyFrame],
              found: Sequence[Solutions | None]) -> tuple[np.ndarray, list[Solutions | None]]:
    """Correct labels in columns (T, L) and solutions that were exchanged throughout among the markers of a part."""
    orders = []
    for k, body in enumerate(bodies):
        part, marked = body.part, body.marked
        solved = [solutions[k] for solutions in found if solutions is not None]
        pose, _, _ = marked.body.split(np.stack([one.x for one in solved]))
        # mean offset of each marker in the axes of its part, over the key frames
        turns = marked.shapes.rotations(np.swapaxes(pose, 0, 1))[part]                            # (L, K, 3, 3)
        off = np.stack([np.where(one.matches[:, None] >= 0, one.off, np.nan) for one in solved])
        local = np.einsum("lkji,klj->kli", turns, off)
        # 0.1: least share of key frames with the marker
        enough = np.isfinite(local[..., 0]).mean(axis=0) > 0.1
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)                # for markers that were never seen
            places = body.layout.place(body.subject.template) + np.nanmedian(local, axis=0)
        places[~enough] = np.nan
        orders.append(order_by_layout(places, body.usual.place(body.subject.template), part))
    again = [None if solutions is None else tuple(
        replace(one, matches=one.matches[np.argsort(order)], off=one.off[np.argsort(order)])
        for one, order in zip(solutions, orders, strict=True)) for solutions in found]
    return np.concatenate([mine[:, np.argsort(order)] for mine, order
                           in zip(_of_each(bodies, columns), orders, strict=True)], axis=1), again


def find_start(searches: Sequence[BodySearch], points: np.ndarray, report_progress: Callable[[int], None]
               ) -> tuple[int, list[Placement]]:
    """Find the frame, among a few full ones, in which the bodies fit best, and their placements there."""
    seen = np.isfinite(points[..., 0])
    full = np.flatnonzero(seen.sum(axis=1) >= max(FEWEST, 0.9 * seen.sum(axis=1).max()))
    frames = full[np.unique(np.linspace(0, len(full) - 1, STARTS + 2).round().astype(int)[1:-1])]
    groups = [[points[t, seen[t]]] for t in frames]
    if len(searches) > 1:
        frames, groups = separate_people(points[full], len(searches))
        frames = full[frames]
    tried = list[tuple[int, list[Placement]]]()
    # upright first; lying or upside down only if no frame has a standing body
    for axes, count in ((UPS, len(frames)), (OTHERS, 2)):
        for i, (t, group) in enumerate(zip(frames[:count], groups[:count], strict=True)):
            tried.append((int(t), [search.find(some, axes) for search, some in zip(searches, group, strict=True)]))
            report_progress(i + 1)
        best = min(tried, key=lambda one: max(placement.misfit for placement in one[1]))
        worst = max(placement.misfit for placement in best[1])
        if worst < FOUND:
            return best
    raise ValueError(f"points: no body with these markers was found in frames {', '.join(map(str, frames))}: the best "
                     f"leaves {worst:.2f}, expected below {FOUND}; another layout, or several "
                     "people?")


def _check_known(known: np.ndarray | None, points: MarkerSequence, count: int) -> np.ndarray:
    """Check the known labels (T, C), and that points are enough and of a person's size."""
    most = int(points.seen.sum(axis=1).max(initial=0))
    if most < FEWEST:
        raise ValueError(f"points: expected a frame with at least {FEWEST} points, the best has {most}")
    shape = points.positions.shape[:2]
    known = np.full(shape, UNKNOWN) if known is None else np.asarray(known)
    if known.shape != shape or known.max(initial=-1) >= count or known.min(initial=-1) < GHOST:
        raise ValueError(f"known: expected {shape} rows of the layout below {count}, {UNKNOWN} or {GHOST}, got "
                         f"{known.shape} from {known.min(initial=-1)} to {known.max(initial=-1)}")
    spread = points.positions - np.nanmedian(points.positions, axis=1, keepdims=True)
    half = float(np.nanmedian(np.linalg.norm(spread, axis=2)))
    if not SPREAD[0] < half < SPREAD[1]:
        raise ValueError(f"points: expected those of a person, half of them within {SPREAD[1]:g} m and not within "
                         f"{SPREAD[0]:g} m of their middle, found {half:.3g} m; metres taken for millimetres?")
    return known


def _of_each(bodies: Sequence[_Person], values: np.ndarray) -> list[np.ndarray]:
    """Split an array (T, L) of all markers into those of each person."""
    return np.split(values, np.cumsum([len(body.layout.labels) for body in bodies])[:-1], axis=1)


def _own(subject: Subject, layout: MarkerLayout) -> MarkedBody:
    """Return a known person with its markers."""
    return MarkedBody(subject, layout, AnimateConfig.prior_weight)


def _sequence(points: np.ndarray, columns: np.ndarray, layout: MarkerLayout, rate: float) -> MarkerSequence:
    """Return the points in columns (T, L) as a sequence with the labels of a layout."""
    return MarkerSequence(take_columns(points, columns), layout.labels, rate)
