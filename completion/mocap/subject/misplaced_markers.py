"""Misplaced markers: those not where the layout has them are searched on the whole body, exchanged names first.

A misplaced marker is an outlier in every frame, but keeps its place on the skin. So the body is fitted to the other
markers, in frames that differ most. The point of the skin nearest to the marker in all frames is its place.
"""
from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import numpy as np

from model.body import BodyModel
from scanprep.console import Metric
from scanprep.geometry.mesh import Mesh
from scanprep.judgement import Judgement
from scanprep.skeleton.roles import above
from scanprep.words import number_of

from ..files.markers import MarkerSequence
from ..marker_sets.layout import DISTANCE, MarkerLayout
from ..marker_sets.symmetry import label_pairs
from .frame_starts import mean_person, stand_off, start_frames
from .latent_fit import distance_reach
from .person import PersonConfig, PersonFit, common_markers, find_person, judge_moves

FAR = 0.06                           # metres, RMS over frames, from its usual place beyond which it is misplaced


@dataclass(frozen=True, eq=False)
class MovedMarker:
    """A misplaced marker, and the place where it was found.

    Attributes
    ----------
    label : str
    corners : (3,) int
        Vertices of the triangle on which it was found.
    weights : (3,) float
        Barycentric weights of the corners.
    distance : float, metres
        From the skin.
    before, after : float, metres
        RMS distance over the frames from the layout's place, and from the place that was found.
    """

    label: str
    corners: np.ndarray
    weights: np.ndarray
    distance: float
    before: float
    after: float


@dataclass(frozen=True, eq=False)
class MisplacedMarkers:
    """Differences between a layout and the markers of a recording.

    Attributes
    ----------
    moved : tuple of MovedMarker
        Markers with another place on the skin.
    exchanged : pairs of labels
        Markers with each other's name throughout.
    unplaced : labels
        Markers that are far from the layout's place and that no place on the skin explains; they are left out.
    too_many : labels
        Markers that are far from the layout's place, so many that the body is at fault: nothing is changed.
    lost : tuple of (part, labels, whole)
        Parts of the body of which most markers, or all (`whole`), are misplaced. Then the pose of the part is at fault:
        its markers are kept, and weighted as usual.
    """

    moved: tuple[MovedMarker, ...] = ()
    exchanged: tuple[tuple[str, str], ...] = ()
    unplaced: tuple[str, ...] = ()
    too_many: tuple[str, ...] = ()
    lost: tuple[tuple[str, tuple[str, ...], bool], ...] = ()

    @property
    def changes(self) -> bool:
        """Whether the layout or the names have to be changed."""
        return bool(self.moved or self.exchanged or self.unplaced)

    def metrics(self) -> list[Metric]:
        """Return a row for each difference from the layout."""
        return [*(Metric("names swapped throughout, corrected", " and ".join(pair)) for pair in self.exchanged),
                *(Metric(f"misplaced marker, moved to its real place ({m.label})", 1000 * m.before,
                         "mm") for m in self.moved),
                *(Metric("misplaced marker, no place found: left out", label) for label in self.unplaced),
                *(Metric("far from the layout's place, as are too many others", label) for label in self.too_many),
                *(Metric(f"{'all' if whole else 'most'} markers of the {part} far from the layout's places",
                         ", ".join(labels)) for part, labels, whole in self.lost)]

    def judgement(self, labels: Sequence[str]) -> Judgement:
        """Judge a person found with these markers; `labels` are all those of the recording."""
        sides, check = sum(i < j for i, j in enumerate(label_pairs(labels))), list[str]()
        # more than half of the pairs exchanged: another convention, or a mirrored recording
        if 2 * len(self.exchanged) > sides:
            check.append(f"left and right of {len(self.exchanged)} of {number_of(sides, 'pair')} of markers were "
                         "exchanged and put back: labels of the other side, or a mirrored recording, which is to be "
                         "mirrored first?")
        # parts whose markers are all misplaced fail, those with most of them are a doubt
        parts, some = ([f"{share} markers of the {part} ({', '.join(names)}) are far from where the layout says: wrong "
                        "labels there, another layout, or a model that knows no such body?"
                        for part, names, whole in self.lost if whole == wanted]
                       for share, wanted in (("all", True), ("most", False)))
        check += some
        if self.unplaced:
            check.append(f"{', '.join(self.unplaced)} misplaced, and no place was found: left out")
        if self.too_many:
            check.append(f"{', '.join(self.too_many)} far from where the layout says: the wrong layout, or the wrong "
                         "body?")
        return judge_moves({m.label: m.before for m in self.moved}, len(labels)).merge(Judgement.of(parts, check))

    def restore_names(self, sequence: MarkerSequence, layout: MarkerLayout) -> MarkerSequence:
        """Return a sequence with exchanged names corrected."""
        return MarkerSequence(sequence.positions[:, self.order(sequence, layout)], sequence.labels, sequence.rate)

    def order(self, sequence: MarkerSequence, layout: MarkerLayout) -> np.ndarray:
        """Return the column (L,) of a sequence from which each of its labels is taken."""
        rows = {layout.aliases.get(label, label): sequence.labels.index(label)
                for label in layout.match_labels(sequence.labels, 0)}
        order = np.arange(len(sequence.labels))
        for first, second in self.exchanged:
            if first in rows and second in rows:
                two = [rows[first], rows[second]]
                order[two] = order[two[::-1]]
        return order

    def update_layout(self, layout: MarkerLayout) -> MarkerLayout:
        """Return a layout with the moved markers at their new places, at its end, and without the unplaced ones."""
        layout = layout.without(self.unplaced) if self.unplaced else layout
        if not self.moved:
            return layout
        new_places = MarkerLayout(tuple(m.label for m in self.moved), np.array([m.corners for m in self.moved]),
                                  np.array([m.distance for m in self.moved]), np.array([m.weights for m in self.moved]))
        return replace(layout.without(new_places.labels).merge(new_places), aliases=layout.aliases)


class _Frames:
    """The fitted bodies of a person in their frames, and the measured markers there."""

    def __init__(self, model: BodyModel, person: PersonFit, sequences: Sequence[MarkerSequence], layout: MarkerLayout,
                 wand: float) -> None:
        # measured markers, bodies with their normals, and the layout's places on the bodies, for every frame of the fit
        self.layout, positions = common_markers(sequences, layout)
        self.targets = np.stack([positions[which][t] for which, t in person.frames])                  # (B, L, 3)
        self.vertices = model.subject(person.betas).vertices(person.poses, person.trans).astype(float)     # (B, N, 3)
        bodies = [model.template.with_vertices(v) for v in self.vertices]
        self.normals = np.stack([body.vertex_normals for body in bodies])
        self.reach, self.wand = distance_reach(self.layout, wand), wand
        self.part = model.skeleton.part_of_vertex(model.template)
        self.template: Mesh = model.template
        self.places = np.stack([self.layout.place(body) for body in bodies])                          # (B, L, 3)

    def off_skin(self, row: int, least: float, greatest: float) -> tuple[np.ndarray, np.ndarray]:
        """Compute the RMS distance (N,) of a marker from every vertex, lifted off the skin, and the lift (N,)."""
        seen = np.isfinite(self.targets[:, row, 0])
        apart, lift = stand_off(self.targets[seen, row], self.vertices[seen], self.normals[seen], least, greatest)
        return _rms(apart), lift

    def off_place(self, row: int, of: int) -> float:
        """Compute the RMS distance, metres, of a marker `row` from the usual place of a marker `of`.

        A loose marker may be anywhere along its part. Where the distance from the skin is unknown, it is not counted.
        """
        loose, least, greatest = self.layout.labels[of] in self.layout.loose, self.reach[0][of], self.reach[1][of]
        if not (loose or least < greatest) or not np.isfinite(self.targets[:, row, 0]).any():
            return float(_rms(np.linalg.norm(self.targets[:, row] - self.places[:, of], axis=1)))
        # a loose marker may be 20 cm along its part from its usual place, about half a thigh
        centre = self.layout.nearest[of]
        near = (np.linalg.norm(self.template.vertices - self.template.vertices[centre], axis=1) < 0.2) \
            & (self.part == self.part[centre]) if loose else [centre]
        return float(self.off_skin(row, float(least), float(greatest))[0][near].min())

    @cached_property
    def off(self) -> np.ndarray:
        """RMS distance (L,), metres, of every marker from its usual place; NaN for one seen in fewer than 4 frames."""
        often = np.isfinite(self.targets[..., 0]).sum(axis=0) >= 4
        return np.array([self.off_place(row, row) if seen else np.nan for row, seen in enumerate(often)])

    def far(self, least: float) -> float:
        """Compute the distance from its usual place, metres, beyond which a marker is suspected; at least `least`.

        It grows to four times the median distance on a body that the model hardly knows. It stays below twice `FAR`,
        since mixed-up labels also raise the median.
        """
        return float(np.clip(4.0 * np.nanmedian(self.off), least, 2 * FAR)) if np.isfinite(self.off).any() else least


def _rms(apart: np.ndarray) -> np.ndarray:
    """Compute the root mean square over the first axis, without NaN."""
    seen = np.isfinite(apart)
    total, count = np.where(seen, apart, 0.0)**2, seen.sum(axis=0)
    return np.where(count > 0, np.sqrt(total.sum(axis=0) / np.maximum(count, 1)), np.nan)


def find_misplaced_markers(model: BodyModel, sequences: Sequence[MarkerSequence], layout: MarkerLayout,
                           person: PersonFit, config: PersonConfig) -> MisplacedMarkers:
    """Find markers that are not where a layout has them, their places, and pairs with exchanged names.

    The body is fitted without the suspected markers until the suspects do not change. A suspect that ends near its
    usual place, though it was left out, is cleared and not suspected again.

    Parameters
    ----------
    model : BodyModel
        With betas.
    sequences : sequence of MarkerSequence
        Of one subject.
    layout : MarkerLayout
        Where markers usually sit.
    person : PersonFit
        Fitted to all of them.
    config : PersonConfig
        Settings of that fit.

    Returns
    -------
    MisplacedMarkers
        Distances in metres.

    [MoSh]
    """
    # with 20 betas the shape cannot follow a wrong marker
    rough = replace(config, n_betas=20, annealing=(40.0, 10.0, 2.0, 1.0))
    sides, sequences, at = _find_exchanged_sides(model, sequences, layout,
                                                 _Frames(model, person, sequences, layout, config.wand), rough)
    # suspects: markers far off on the body of the others; at first, on a body that all have attracted, 4 cm are enough
    suspects, cleared, far = frozenset[str](), frozenset[str](), FAR if sides else 0.04
    for _ in range(4):
        off, limit = dict(zip(at.layout.labels, np.nan_to_num(at.off).tolist(), strict=True)), at.far(far)
        cleared |= {label for label in suspects if off[label] <= max(limit, FAR)}
        before, suspects = suspects, frozenset(label for label in off if label not in cleared and off[label] > limit)
        if len(suspects) > 0.25 * len(off):                             # so many: the body is at fault
            return MisplacedMarkers(too_many=tuple(label for label in at.layout.labels if label in suspects))
        if suspects == before:
            break
        at, far = _without(model, sequences, layout, suspects, rough), FAR
    # the final fit without the suspects explains each by an exchange or by another place
    if suspects:
        at = _without(model, sequences, layout, suspects, config)
    explained = _explain(at, suspects)

    # two exchanged names on a leg can pull all its markers away: unplaced markers are searched again on the new body
    if explained.unplaced and (explained.moved or explained.exchanged):
        renamed = [explained.restore_names(each, layout) for each in sequences]
        placed = replace(explained, unplaced=()).update_layout(layout)
        again = _without(model, renamed, placed, (), config)
        off, limit = dict(zip(again.layout.labels, again.off, strict=True)), again.far(FAR)
        gone = [label for label in explained.unplaced if off[label] > limit]
        rest = _explain(_without(model, renamed, placed, gone, config), gone) if gone else MisplacedMarkers()
        explained = MisplacedMarkers(explained.moved + rest.moved, explained.exchanged + rest.exchanged, rest.unplaced)
    explained = _with_whole_parts(at, explained, model.skeleton.names)
    back = set(sides) & set(explained.exchanged)                            # exchanged twice: not at all
    return replace(explained, exchanged=tuple(pair for pair in (*sides, *explained.exchanged) if pair not in back))


def _with_whole_parts(at: _Frames, found: MisplacedMarkers, names: Sequence[str]) -> MisplacedMarkers:
    """Keep all markers of parts that would lose most of them, and list these parts in `lost`."""
    part_of_marker = at.part[at.layout.nearest]
    ends = {m.label: at.part[m.corners[m.weights.argmax()]] for m in found.moved}
    kept, lost = set[str](), []
    for part in np.unique(part_of_marker).tolist():
        of_part = [label for label, of in zip(at.layout.labels, part_of_marker, strict=True) if of == part]
        gone = [label for label in of_part if label in found.unplaced or ends.get(label, part) != part]
        if len(gone) > max(1, len(of_part) / 2):
            lost.append((names[part], tuple(gone), len(gone) == len(of_part)))
            kept.update(gone)
    return replace(found, moved=tuple(m for m in found.moved if m.label not in kept),
                   unplaced=tuple(label for label in found.unplaced if label not in kept), lost=tuple(lost))


def _without(model: BodyModel, sequences: Sequence[MarkerSequence], layout: MarkerLayout, suspects: Collection[str],
             config: PersonConfig) -> _Frames:
    """Fit a person without some markers, and return its bodies with all markers."""
    others = layout.without([label for label in layout.labels if label in suspects])
    return _Frames(model, find_person(model, sequences, others, config), sequences, layout, config.wand)


def _find_exchanged_sides(model: BodyModel, sequences: Sequence[MarkerSequence], layout: MarkerLayout, at: _Frames,
                          rough: PersonConfig) -> tuple[tuple[tuple[str, str], ...], Sequence[MarkerSequence], _Frames]:
    """Test whether left and right are exchanged on a limb or on the whole body, where many markers are far off.

    The other markers cannot tell it then. Returned are the pairs, the sequences with corrected names, and the body.
    """
    def burden(off: np.ndarray) -> float:
        """Sum distances (L,), each limited to twice FAR: beyond, it does not matter how far off a marker is."""
        return float(np.minimum(np.nan_to_num(off), 2 * FAR).sum())

    best: tuple[tuple[tuple[str, str], ...], Sequence[MarkerSequence], _Frames] = (), sequences, at
    if (np.nan_to_num(at.off) > FAR).sum() < 5:
        return best
    # a quick test with the mean person, then a full fit for limbs that pass it
    labels, mean = at.layout.labels, mean_person(model.subject(np.zeros(model.n_betas)), at.layout)

    def by_mean(targets: np.ndarray) -> float:
        """Compute how badly the mean person explains markers (B, L, 3), from poses alone."""
        x = start_frames(mean, targets, lambda done: None)
        return burden(_rms(np.linalg.norm(mean.positions(x) - targets, axis=2)))

    as_they_came = by_mean(at.targets)
    for pairs in _limbs(model.skeleton.parents, at):
        order = np.arange(len(labels))
        for i, j in pairs:
            order[[i, j]] = j, i
        if by_mean(at.targets[:, order]) < as_they_came:
            names = MisplacedMarkers(exchanged=tuple((labels[i], labels[j]) for i, j in pairs))
            renamed = [names.restore_names(each, layout) for each in sequences]
            other = _Frames(model, find_person(model, renamed, layout, rough), renamed, layout, rough.wand)
            if burden(other.off) < min(0.5 * burden(at.off), burden(best[2].off)):
                best = names.exchanged, renamed, other
    return best


def _limbs(parents: np.ndarray, at: _Frames) -> list[list[tuple[int, int]]]:
    """Return pairs of left and right markers: all of them, and those of each pair of limbs below a fork of bones."""
    pairs = [(i, int(j)) for i, j in enumerate(label_pairs(at.layout.labels)) if i < j]
    limbs: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for i, j in pairs:
        ways = (above(parents, int(at.part[at.layout.nearest[k]]))[::-1] for k in (i, j))
        fork = next((both for both in zip(*ways, strict=False) if both[0] != both[1]), None)
        if fork:
            limbs.setdefault(fork, []).append((i, j))
    return [pairs, *limbs.values()] if pairs else []


def _explain(at: _Frames, suspects: Collection[str]) -> MisplacedMarkers:
    """Explain suspects by pairs of exchanged names or by another place on the skin."""
    if not suspects:
        return MisplacedMarkers()
    labels, far, exchanged = at.layout.labels, at.far(FAR), []
    rows = {i for i, label in enumerate(labels) if label in suspects and at.off[i] > far}
    # distance of each suspect from the usual place of each other one, the best pair first
    crossed = [(at.off_place(i, j), at.off_place(j, i), i, j) for i, j in combinations(sorted(rows), 2)]
    gain = 0.4  # another explanation has to leave less than that share of the distance
    for one, other, i, j in sorted(crossed, key=lambda both: max(both[:2])):
        if {i, j} <= rows and max(one, other) < FAR and one + other < gain * (at.off[i] + at.off[j]):
            exchanged.append((labels[i], labels[j]))
            rows -= {i, j}
    # another place has to lie within 2 cm, or 1.5 times the median distance of the other markers from their places
    limit = max(0.02, 1.5 * float(np.nanmedian(at.off[[i for i, label in enumerate(labels) if label not in suspects]])))
    found = {row: _best_place(at, row) for row in sorted(rows)}
    moved = {row: m for row, m in found.items() if m.after < limit and m.after < gain * m.before}
    return MisplacedMarkers(tuple(moved.values()), tuple(exchanged),
                            tuple(labels[row] for row in found if row not in moved))


def _best_place(at: _Frames, row: int) -> MovedMarker:
    """Find the place on the skin nearest to a marker, for the layout's distance from the skin, a common one, or a wand.

    [MoSh]
    """
    own, target = float(np.asarray(at.layout.distances)[row]), at.targets[:, row]
    seen, tried = np.isfinite(target[:, 0]), []
    for low, high in {(own, own), (DISTANCE, DISTANCE), (min(own, DISTANCE), max(own, DISTANCE) + at.wand)}:
        # the nearest vertex, then all triangles around it
        off, lift = at.off_skin(row, low, high)
        vertex = int(off.argmin())
        distance = float(lift[vertex])
        for corners in at.template.faces[(at.template.faces == vertex).any(axis=1)]:
            # the weights of the corners, lifted so far, that come nearest to the marker
            lifted = at.vertices[:, corners] + distance * at.normals[:, corners]                      # (B, 3, 3)
            sides = (lifted[seen, 1:] - lifted[seen, :1]).swapaxes(1, 2).reshape(-1, 2)
            share = np.linalg.lstsq(sides, (target - lifted[:, 0])[seen].ravel(), rcond=None)[0]
            weights = np.maximum([1 - share.sum(), *share], 0)
            weights /= weights.sum()
            after = float(_rms(np.linalg.norm(np.einsum("c,bcd->bd", weights, lifted) - target, axis=1)))
            tried.append(MovedMarker(at.layout.labels[row], corners, weights, distance, float(at.off[row]), after))
    return min(tried, key=lambda m: m.after)
