"""Labels for markers without names: which point of every frame is which marker of a body."""
from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from model.body import BodyModel
from model.linear import Subject
from scanprep.judgement import Judgement
from scanprep.threads import one_thread

from ...motion import Motion, Progress
from ..files.markers import MarkerSequence
from ..marker_sets.layout import MarkerLayout
from ..pose.follow import animate
from ..pose.marked_body import AnimateConfig, MarkedBody
from ..subject.frame_starts import mean_person
from ..subject.person import PersonFit, find_person
from .assignment import assign_by_places, elect, find_displaced, label_of_track, mean_offsets, take_columns
from .body_search import OTHERS, UPS, BodySearch, Placement
from .follow_points import KeyFrame, Solutions, count_votes, follow_keys, key_frames, solve_again
from .layout_order import order_by_layout
from .separate import separate_people
from .tracks import link_points

UNKNOWN, GHOST = -1, -2              # in labels that are known: nothing is, and: this point is no marker
FEWEST = 10                          # points in a frame, of which no body can be told otherwise
STARTS = 5                           # frames in which the body is sought
# metres that half of a frame's points are from their middle at least and at most: 0.4 to 0.6 of one person
SPREAD = 0.1, 5.0
FOUND = 0.3                          # misfit of a frame above which no body was found; right ones had at most 0.18
# metres from its place that a marker lies at least, in each direction, of the three passes at last
DEVIATIONS = (0.03, 0.02, 0.012)
SURE = 0.9                           # confidence below which a label is doubted
POSES = AnimateConfig(marker_sd=0.007)                                  # metres: markers where they sit, as in `mosh`


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
            bad.append(f"labelled points lie {1000 * residual:.0f} mm from the body: another layout or person?")
        if doubted > 0.02:
            check.append(f"{100 * doubted:.0f}% of the labels are doubtful")
        if alone > 0.1:
            check.append(f"{100 * alone:.0f}% of the points have no label: another person, props, or another layout?")
        return Judgement.of(bad, check)


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

    Examples
    --------
    >>> points = read_markers("raw.c3d")
    >>> layout, _ = choose_layout(model, "cmu41", ())
    >>> label_markers(model, points, layout).markers.labels[:2]
    ('LFHD', 'RFHD')
    """
    return label_people([(model, layout)], points, known, progress)[0]


@one_thread()
def label_people(people: Sequence[tuple[BodyModel | Subject, MarkerLayout]], points: MarkerSequence,
                 known: np.ndarray | None = None, progress: Progress | None = None) -> list[LabelledMarkers]:
    """The same for several people in one volume, each with a model or a subject, and a layout.

    All markers of all people compete for the points of a frame, so that none takes what is another's.

    Parameters
    ----------
    people : sequence of (BodyModel or Subject, MarkerLayout)
    points : MarkerSequence
    known : (T, C) int, optional
        As of `label_markers`; rows of the layouts are counted on from person to person.
    progress : callable, optional
        Called with (done, total).

    Raises
    ------
    ValueError
        As of `label_markers`; no frame in which the people stand apart.
    """
    tell = progress or (lambda done, total: None)
    at, rate, T = points.positions, points.rate, len(points.positions)
    known = _check_known(known, points, sum(len(layout.labels) for _, layout in people))
    tracks = link_points(at, rate)

    # key frames, from one in which the bodies are found: mean people, or those who are known
    bodies = [_Person.start(model, layout) for model, layout in people]
    searches = [BodySearch(body.marked, body.subject) for body in bodies]
    first, placements = find_start(searches, at, lambda done: tell(done, 4 * T))
    times, keys = key_frames(at, tracks, known, rate, first)
    begin = int(np.searchsorted(times, first))
    found = follow_keys(searches, keys, begin, placements,
                        lambda done: tell(T * done // len(keys), 4 * T))
    columns = elect(count_votes(keys, found, tracks.max() + 1), tracks)
    columns, found = _in_order(bodies, columns, keys, found)

    # the same by the people themselves
    bodies = [body if isinstance(model, Subject) else _find_person(body, model, at, mine, rate)
              for body, (model, _), mine in zip(bodies, people, _of_each(bodies, columns), strict=True)]
    searches = [BodySearch(body.marked, body.subject) for body in bodies]
    labels = label_of_track(columns, tracks)
    found = solve_again(searches, keys, found, labels)
    columns = elect(count_votes(keys, found, tracks.max() + 1), tracks)
    columns, found = _in_order(bodies, columns, keys, found)

    # the motion of each tells the labels anew, and these the person, ever closer
    told = np.full_like(columns, -2)
    for i, sd in enumerate(DEVIATIONS):
        # share of labels that may change without the person being found anew
        changed = (columns != told).mean() > 0.001
        told = columns
        for k, mine in enumerate(_of_each(bodies, columns)):
            model = people[k][0]
            if changed and not isinstance(model, Subject):
                bodies[k] = _find_person(bodies[k], model, at, mine, rate)
        moving = [body.follow(at, mine, rate) for body, mine in zip(bodies, _of_each(bodies, columns), strict=True)]
        places = np.concatenate([one.places for one in moving], axis=1)
        turns = np.concatenate([one.turns for one in moving], axis=1)
        # markers keep their places on these parts, wherever the fitted layout has them
        part = np.concatenate([body.part + 1000 * k for k, body in enumerate(bodies)])
        offsets, deviations = mean_offsets(at, columns, places, turns)
        offsets = offsets + find_displaced(at, columns, places, turns, part)
        places += np.einsum("tlij,lj->tli", turns, offsets)
        columns, sure = assign_by_places(at, tracks, known, places, rate, np.clip(deviations, sd, DEVIATIONS[0]))
        tell((i + 2) * T, (len(DEVIATIONS) + 1) * T)

    unlabelled = points.seen.copy()
    frames, rows = np.nonzero(columns >= 0)
    unlabelled[frames, columns[frames, rows]] = False
    return [LabelledMarkers(_sequence(at, mine, body.layout, rate), mine, certain, unlabelled, tracks, one.motion,
                            body.subject, body.layout, body.fit)
            for body, one, mine, certain
            in zip(bodies, moving, _of_each(bodies, columns), _of_each(bodies, sure), strict=True)]


@dataclass(frozen=True, eq=False)
class _Person:
    """A person, the usual layout, and markers on the body as far as they are known."""

    subject: Subject
    layout: MarkerLayout
    usual: MarkerLayout
    marked: MarkedBody
    fit: PersonFit | None = None

    @property
    def part(self) -> np.ndarray:
        """(L,) the part that carries each marker."""
        return self.subject.skeleton.part_of_vertex(self.subject.template)[self.layout.nearest]

    @staticmethod
    def start(model: BodyModel | Subject, layout: MarkerLayout) -> _Person:
        """The mean person of a model, or the one that is known."""
        if isinstance(model, Subject):
            return _Person(model, layout, layout, _own(model, layout))
        subject = model.subject()
        return _Person(subject, layout, layout, mean_person(subject, layout))

    def follow(self, points: np.ndarray, columns: np.ndarray, rate: float) -> _Moving:
        """The motion by the labels that columns (T, L) give."""
        motion = animate(self.subject, _sequence(points, columns, self.layout, rate), self.layout, POSES)
        x = self.marked.body.join(motion.poses, motion.trans)
        turns = self.marked.shapes.rotations(np.swapaxes(motion.poses, 0, 1))[self.part]
        return _Moving(motion, self.marked.positions(x), np.swapaxes(turns, 0, 1))


@dataclass(frozen=True, eq=False)
class _Moving:
    """A motion, places (T, L, 3) of markers in it, metres, and rotations (T, L, 3, 3) of the parts that carry them."""

    motion: Motion
    places: np.ndarray
    turns: np.ndarray


def _find_person(person: _Person, model: BodyModel, points: np.ndarray, columns: np.ndarray, rate: float) -> _Person:
    """A person of unknown shape by the labels that columns (T, L) give."""
    fit = find_person(model, _sequence(points, columns, person.usual, rate), person.usual)
    subject = model.subject(fit.betas)
    return _Person(subject, fit.layout, person.usual, _own(subject, fit.layout), fit)


def _in_order(bodies: Sequence[_Person], columns: np.ndarray, keys: Sequence[KeyFrame],
              found: Sequence[Solutions | None]) -> tuple[np.ndarray, list[Solutions | None]]:
    """Columns (T, L) and solutions with labels put back that were exchanged throughout among the markers of a part."""
    orders = []
    for k, body in enumerate(bodies):
        part, marked = body.part, body.marked
        solved = [solutions[k] for solutions in found if solutions is not None]
        pose, _, _ = marked.body.split(np.stack([one.x for one in solved]))
        turns = marked.shapes.rotations(np.swapaxes(pose, 0, 1))[part]                            # (L, K, 3, 3)
        off = np.stack([np.where(one.matches[:, None] >= 0, one.off, np.nan) for one in solved])
        local = np.einsum("lkji,klj->kli", turns, off)
        # share of key frames in which a marker has to be for its place to be told
        enough = np.isfinite(local[..., 0]).mean(axis=0) > 0.1
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)                # a marker that was never seen
            places = body.layout.place(body.subject.template) + np.nanmedian(local, axis=0)
        places[~enough] = np.nan
        orders.append(order_by_layout(places, body.usual.place(body.subject.template), part))
    again = [None if solutions is None else tuple(
        replace(one, matches=one.matches[np.argsort(order)], off=one.off[np.argsort(order)])
        for one, order in zip(solutions, orders, strict=True)) for solutions in found]
    return np.concatenate([mine[:, np.argsort(order)] for mine, order
                           in zip(_of_each(bodies, columns), orders, strict=True)], axis=1), again


def find_start(searches: Sequence[BodySearch], points: np.ndarray, tell: Callable[[int], None]
               ) -> tuple[int, list[Placement]]:
    """The frame, of a few well seen ones, in which the bodies fit best, and where they are there."""
    seen = np.isfinite(points[..., 0])
    full = np.flatnonzero(seen.sum(axis=1) >= max(FEWEST, 0.9 * seen.sum(axis=1).max()))
    frames = full[np.unique(np.linspace(0, len(full) - 1, STARTS + 2).round().astype(int)[1:-1])]
    groups = [[points[t, seen[t]]] for t in frames]
    if len(searches) > 1:
        frames, groups = separate_people(points[full], len(searches))
        frames = full[frames]
    tried = list[tuple[int, list[Placement]]]()
    # of them, in which it is sought lying or upside down, if it stands nowhere
    for axes, count in ((UPS, len(frames)), (OTHERS, 2)):
        for i, (t, group) in enumerate(zip(frames[:count], groups[:count], strict=True)):
            tried.append((int(t), [search.find(some, axes) for search, some in zip(searches, group, strict=True)]))
            tell(i + 1)
        best = min(tried, key=lambda one: max(placement.misfit for placement in one[1]))
        worst = max(placement.misfit for placement in best[1])
        if worst < FOUND:
            return best
    raise ValueError(f"points: no body with these markers was found in frames {', '.join(map(str, frames))}: the best "
                     f"leaves {worst:.2f}, expected below {FOUND}; another layout, or several "
                     "people?")


def _check_known(known: np.ndarray | None, points: MarkerSequence, count: int) -> np.ndarray:
    """What is known of the points (T, C), and that there are enough of them."""
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
    """The columns of an array (T, L) of all markers that are each person's."""
    return np.split(values, np.cumsum([len(body.layout.labels) for body in bodies])[:-1], axis=1)


def _own(subject: Subject, layout: MarkerLayout) -> MarkedBody:
    """A known person with the markers where they sit."""
    return MarkedBody(subject, layout, AnimateConfig.prior_weight, AnimateConfig.prior_shrinkage)


def _sequence(points: np.ndarray, columns: np.ndarray, layout: MarkerLayout, rate: float) -> MarkerSequence:
    return MarkerSequence(take_columns(points, columns), layout.labels, rate)
