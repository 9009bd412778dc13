"""Find an unknown layout: where on the body each track of a recording sits."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from model.body import BodyModel
from scanprep.geometry import rotations
from scanprep.geometry.farthest_points import farthest_points
from scanprep.geometry.surface import Surface
from scanprep.judgement import Judgement
from scanprep.threads import one_thread

from ...motion import Progress
from ..files.markers import MarkerSequence
from ..marker_sets.layout import DISTANCE, MarkerLayout
from ..marker_sets.named import choose_layout, layout_names
from ..subject.frame_starts import mean_person, stand_off
from ..subject.latent_fit import PersonConfig
from ..subject.person import PersonFit, find_person, spread_frames
from .body_search import OTHERS, UPS, BodySearch, Placement, match_points
from .tracks import has_tracks, link_points

STARTS = 5                           # frames in which the body is searched
TRIED = 4                            # best bodies of these frames, which are fitted to other frames
# Fit of person and places together: more frames and a weaker pose prior than usual, as motions of a recording differ
# from the prior's. 60% of 88 simulated markers were within 15 mm, 48% with twelve frames and usual weights.
CLOSER = PersonConfig(frames=24, pose=0.02)
ROUNDS = 5                           # fits, each starting from the places of the one before; 2 left 4 mm more
NAMED = 4                            # fits in which markers of a known marker set are held to its places
LIKE = 0.10                          # metres: largest distance of a marker from the place of a known set
OUTLIER = 0.06                       # metres beyond which the distance of a track from a place does not matter


@dataclass(frozen=True, eq=False)
class FoundLayout:
    """The layout of a recording, and how certain it is.

    Attributes
    ----------
    layout : MarkerLayout
        A marker for each track, or for several tracks of one marker. Names are those of a known marker set if one
        explains the markers, else part and number.
    tracks : dict
        Label -> the labels of its tracks.
    uncertainty : (L,) float, metres
        Expected distance of each place, along the skin, from the true one.
    left_out : dict
        Label of a track -> reason why it is no marker.
    person : PersonFit
    margin : float
        Ratio of the residuals of the next best body to those of this one.
    """

    layout: MarkerLayout
    tracks: dict[str, tuple[str, ...]]
    uncertainty: np.ndarray
    left_out: dict[str, str]
    person: PersonFit
    margin: float

    @property
    def judgement(self) -> Judgement:
        """Judgement of the layout."""
        bad, check = [], []
        if self.person.residual > 0.02:
            bad.append(f"the tracks lie {1000 * self.person.residual:.0f} mm from the body: no person, or several?")
        # 1.15: with a smaller ratio the two bodies cannot be told apart
        if self.margin < 1.15:
            check.append("another pose explains the tracks nearly as well: left and right, or front and back, may be "
                         "exchanged")
        turns = rotations.exp(self.person.poses[:, 1:])
        range_of_joint = np.linalg.norm(rotations.log(np.swapaxes(turns[:1], -1, -2) @ turns), axis=-1).max(axis=0)
        # 0.25 radians: a joint that turns less over the frames of the fit is still
        if (range_of_joint < 0.25).mean() > 0.5:
            check.append("the person hardly moves: where markers sit on their limb is not told")
        if (self.uncertainty > 0.03).mean() > 0.2:
            check.append("many places are uncertain by more than 3 cm: markers of no usual set, or a poor fit")
        if self.left_out:
            check.append(f"{len(self.left_out)} tracks are no markers of this body: {', '.join(self.left_out)}")
        return Judgement.of(bad, check)


@one_thread()
def find_layout(model: BodyModel, points: MarkerSequence, progress: Progress | None = None) -> FoundLayout:
    """Find where on the skin each track of a recording sits, with unknown person and layout.

    In a few frames a body is searched whose skin passes below all points; each point sits where the skin is nearest.
    The best of these bodies is the one on which tracks keep their places in other frames. Then places, person and poses
    are refined together.

    Parameters
    ----------
    model : BodyModel
        With betas.
    points : MarkerSequence
        Tracks (T, C, 3) of one person, metres; broken ones are joined as far as their motion tells.
    progress : callable, optional
        Called with (done, total).

    Returns
    -------
    FoundLayout
        The layout, its uncertainty (L,) in metres, and the person.

    Raises
    ------
    ValueError
        A model without betas, fewer than ten tracks, no body that fits them.

    Examples
    --------
    It takes one to two minutes for a recording, so here is only the check of its input.

    >>> from model import load_built_in_model
    >>> find_layout(load_built_in_model(), MarkerSequence(np.ones((9, 2, 3)), ("a", "b"), 100.0))
    Traceback (most recent call last):
    ValueError: points: expected at least 10 tracks that are seen in 30% of the frames, found 2

    [MoSh]
    """
    if not model.n_betas:
        raise ValueError("model: expected one with betas, this one knows its template's body only")
    report_progress = progress or (lambda done, total: None)
    tracks = long_tracks(points)
    total = STARTS + TRIED + ROUNDS

    # candidate bodies: the skin passes below all points of a frame
    starts = _search_skin(model, tracks, lambda done: report_progress(done, total))
    # the candidate on which the tracks keep their places in other frames
    tried = list[tuple[float, PersonFit]]()
    for i, (t, placement) in enumerate(starts):
        fit = find_person(model, tracks, _layout_below(model, tracks, t, placement))
        tried.append((_cost(fit), fit))
        report_progress(STARTS + i + 1, total)
    tried.sort(key=lambda one: one[0])
    best, fit = tried[0]

    margin = min([cost for cost, other in tried[1:] if _differs(model, fit, other)], default=np.inf) / best

    # places by the body in all its frames, then places and person together, in rounds
    fit = find_person(model, tracks, _best_places(model, fit, tracks))
    for i in range(ROUNDS):
        fit = find_person(model, tracks, replace(fit.layout, loose=()), CLOSER)
        report_progress(STARTS + TRIED + i + 1, total)
    # if a known marker set explains the markers, move them to its places, as far as the tracks allow
    named, free = dict[str, str](), fit
    for _ in range(NAMED):
        usual, labels = name_markers(model, fit.layout)
        if usual is None:
            break
        snapped = find_person(model, tracks, _snap(fit.layout, labels, usual), CLOSER)
        # 1.15: largest ratio of residuals with and without the known set
        if _cost(snapped) > 1.15 * _cost(free):
            break
        fit, named = snapped, labels
    return _collect(model, tracks, fit, margin, named)


def name_markers(model: BodyModel, layout: MarkerLayout) -> tuple[MarkerLayout | None, dict[str, str]]:
    """Find the known marker set that explains most markers of a layout, or None, and label -> label in that set."""
    places = layout.skin_points(model.template.vertices)
    share = 0.75  # least share of the markers that a set has to explain
    best: tuple[float, MarkerLayout | None, dict[str, str]] = (share * len(layout.labels), None, {})
    for name in layout_names():
        try:
            usual, _ = choose_layout(model, name, ())
        except ValueError:                                              # no sets are known on this model's triangles
            return None, {}
        apart = np.linalg.norm(places[:, None] - usual.skin_points(model.template.vertices), axis=2)
        rows, columns = linear_sum_assignment(np.minimum(apart, LIKE)**2)
        near = apart[rows, columns] < LIKE
        # score: near markers count more, and unused markers of the set cost 0.3 each
        score = float((1 - (apart[rows, columns][near] / LIKE)**2 / 2).sum()) - 0.3 * (len(usual.labels) - near.sum())
        if near.sum() >= share * len(layout.labels) and score > best[0] * (best[1] is not None):
            best = score, usual, {layout.labels[r]: usual.labels[c]
                                  for r, c in zip(rows[near], columns[near], strict=True)}
    return best[1], best[2]


def _snap(layout: MarkerLayout, labels: dict[str, str], usual: MarkerLayout) -> MarkerLayout:
    """Return a layout with named markers moved to the places of a known set."""
    rest = [label for label in layout.labels if label not in labels]
    order = [usual.labels.index(labels[label]) for label in layout.labels if label in labels]
    vertices, weights = usual.skin
    moved = MarkerLayout(tuple(label for label in layout.labels if label in labels), vertices[order],
                         np.asarray(usual.distances)[order], weights=weights[order])
    return moved.merge(layout.select(rest)) if rest else moved


def long_tracks(points: MarkerSequence) -> MarkerSequence:
    """Return the long tracks of a recording: its columns, or pieces that its points were joined to."""
    fewest = 10  # least number of tracks
    least_share = 0.3  # least share of the frames in which a track has to be seen
    if not has_tracks(points.positions, points.rate):
        number = link_points(points.positions, points.rate)
        frames, columns = np.nonzero(number >= 0)
        which = number[frames, columns]
        counts = np.bincount(which, minlength=number.max() + 1)
        kept = np.flatnonzero(counts >= least_share * len(number))
        if len(kept) < fewest:
            raise ValueError(
                f"points: expected at least {fewest} tracks that are seen in {100 * least_share:.0f}% of the frames, "
                f"found {len(kept)}; without tracks a layout has to be given")
        series = np.full((len(number), len(kept), 3), np.nan)
        place = np.full(number.max() + 1, -1)
        place[kept] = np.arange(len(kept))
        of_kept = place[which] >= 0
        series[frames[of_kept], place[which[of_kept]]] = points.positions[frames[of_kept], columns[of_kept]]
        return MarkerSequence(series, tuple(f"track{k}" for k in kept), points.rate)
    long = points.seen.mean(axis=0) >= least_share
    if long.sum() < fewest:
        raise ValueError(
            f"points: expected at least {fewest} tracks that are seen in {100 * least_share:.0f}% of the frames, "
            f"found {int(long.sum())}")
    return points.select([label for label, is_long in zip(points.labels, long, strict=True) if is_long])


def _search_skin(model: BodyModel, tracks: MarkerSequence, report_progress: Callable[[int], None]
                 ) -> list[tuple[int, Placement]]:
    """Search bodies whose skin passes below the points of some frames; return frames and bodies, the best first."""
    # 250 points of the skin, 9 cm apart, serve as markers for the search
    vertices = farthest_points(model.template.vertices, 250)
    skin = MarkerLayout(tuple(f"skin{v}" for v in vertices), vertices)
    subject = model.subject()
    search = BodySearch(mean_person(subject, skin), subject)
    full = np.flatnonzero(tracks.seen.sum(axis=1) >= 0.9 * tracks.seen.sum(axis=1).max())
    frames = full[spread_frames(tracks.positions[full], STARTS)]
    found = []
    for i, t in enumerate(frames):
        visible = tracks.positions[t, tracks.seen[t]]
        for axis in (*UPS, *OTHERS[:2]):
            placement = search.find(visible, (axis,))
            # only the distance of points from the skin counts, not skin without points
            matches, _ = match_points(search.body.positions(placement.x), visible, OUTLIER)
            at = search.body.positions(placement.x)[matches >= 0]
            off = np.linalg.norm(at - visible[matches[matches >= 0]], axis=1)
            cost = float(np.minimum(off, OUTLIER).sum() + OUTLIER * (len(visible) - len(off))) / len(visible)
            found.append((cost, int(t), placement))
            # 25 mm mean distance: good enough, no other axis is tried
            if cost < 0.025:
                break
        report_progress(i + 1)
    found.sort(key=lambda one: one[0])
    return [(t, placement) for _, t, placement in found[:TRIED]]


def _layout_below(model: BodyModel, tracks: MarkerSequence, t: int, placement: Placement) -> MarkerLayout:
    """Return a layout of the visible tracks of a frame, each at the nearest vertex of a body."""
    subject = model.subject()
    n = 3 * len(subject.skeleton.parents)
    posed = subject.vertices(placement.x[None, :n].reshape(1, -1, 3), placement.x[None, n:n + 3])[0]
    seen = np.flatnonzero(tracks.seen[t])
    found = Surface(model.template.with_vertices(posed)).closest(tracks.positions[t, seen])
    labels = tuple(tracks.labels[i] for i in seen)
    nearest = model.template.faces[found.faces][np.arange(len(seen)), found.bary.argmax(axis=1)]
    return MarkerLayout(labels, nearest, loose=labels)


def _best_places(model: BodyModel, fit: PersonFit, tracks: MarkerSequence) -> MarkerLayout:
    """Return a layout of all tracks, each at the vertex where it keeps its place best in the frames of a fit."""
    subject, frames = model.subject(fit.betas), fit.frames[:, 1]
    vertices = subject.vertices(fit.poses, fit.trans)
    normals = np.stack([model.template.with_vertices(v).vertex_normals for v in vertices])
    places, distances = [], []
    for column in range(len(tracks.labels)):
        targets = tracks.positions[frames, column]
        seen = np.isfinite(targets[:, 0])
        if not seen.any():
            places.append(-1)
            distances.append(DISTANCE)
            continue
        # 4 cm: largest distance of a marker from the skin
        off, lift = stand_off(targets[seen], vertices[seen], normals[seen], 0.0, 0.04)
        best = int(np.minimum(off**2, OUTLIER**2).mean(axis=0).argmin())
        places.append(best)
        distances.append(float(lift[best]))
    there = np.array(places) >= 0
    labels = tuple(label for label, is_there in zip(tracks.labels, there, strict=True) if is_there)
    return MarkerLayout(labels, np.array(places)[there], np.array(distances)[there], loose=labels)


def _cost(fit: PersonFit) -> float:
    """Compute the mean distance of markers of a fit, metres, at most `OUTLIER` each."""
    return float(np.nanmean(np.minimum(fit.residuals, OUTLIER)))


def _differs(model: BodyModel, one: PersonFit, other: PersonFit) -> bool:
    """Tell whether two fits have the tracks at different places of the body."""
    both = [label for label in one.layout.labels if label in other.layout.labels]
    places = [fit.layout.select(both).skin_points(model.template.vertices) for fit in (one, other)]
    return bool(np.median(np.linalg.norm(places[0] - places[1], axis=1)) > LIKE)


def _collect(model: BodyModel, tracks: MarkerSequence, fit: PersonFit, margin: float, usual: dict[str, str]
             ) -> FoundLayout:
    """Collect the result: leave out tracks that are no markers, and join those of one marker."""
    left_out, kept = {}, []
    for row, label in enumerate(fit.layout.labels):
        off = float(np.nanmedian(fit.residuals[:, row]))
        # 35 mm: a track with a larger median distance from its place is no marker
        if off > 0.035:
            left_out[label] = f"{1000 * off:.0f} mm from the body"
        else:
            kept.append(label)
    left_out |= {label: "not seen with the others" for label in tracks.labels if label not in fit.layout.labels}
    layout = fit.layout.select(kept)
    places = layout.skin_points(model.subject(fit.betas).template.vertices)
    seen = tracks.select(kept).seen
    groups: dict[str, list[str]] = {}
    for row, label in enumerate(kept):
        # 25 mm: two tracks this close, which are never seen together, are one marker
        other = next((first for first in groups if np.linalg.norm(
            places[kept.index(first)] - places[row]) < 0.025 and not (seen[:, kept.index(first)] & seen[:, row]).any()),
                     None)
        groups.setdefault(label if other is None else other, []).append(label)
    layout = replace(layout.select(list(groups)), loose=())
    rows = [fit.layout.labels.index(label) for label in layout.labels]
    spread = np.sqrt(np.nanmean(fit.residuals[:, rows]**2, axis=0))
    # uncertainty beside the residuals: 9 mm for a marker of a known set, 25 mm for another
    uncertainty = np.where([label in usual for label in layout.labels], 0.009, 0.025) + spread
    names = suggest_names(model, layout, usual)
    return FoundLayout(replace(layout, labels=names), dict(zip(names, map(tuple, groups.values()), strict=True)),
                       uncertainty, left_out, fit, margin)


def suggest_names(model: BodyModel, layout: MarkerLayout, usual: dict[str, str]) -> tuple[str, ...]:
    """Return names of markers: those of a known set, label -> label, else the part and a number."""
    parts = model.skeleton.part_of_vertex(model.template)[layout.nearest]
    names, counts = list[str](), dict[int, int]()
    for label, part in zip(layout.labels, parts.tolist(), strict=True):
        counts[part] = counts.get(part, 0) + (label not in usual)
        names.append(usual.get(label, f"{model.skeleton.names[part]}{counts[part]}"))
    return tuple(names)
