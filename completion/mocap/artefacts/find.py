"""What is wrong with the markers of a sequence, by the body that carries them."""
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from model.linear import Subject

from ...motion import Motion, Progress
from ..files.markers import MarkerSequence
from ..marker_sets.layout import MarkerLayout
from ..pose import swaps
from ..pose.robust import known_median, marker_weights
from ..pose.settings import AnimateConfig
from .results import ArtefactConfig, BadSpan, MarkerArtefacts, list_swaps
from .simulated import Simulation, bridged
from .slips import find_bad, without_lost_limbs

FOLLOW = AnimateConfig()             # how the body follows the markers here
ROUNDS = 6                           # most times that markers are repaired and the body follows them anew
CLOSE = 0.25                         # metres between markers whose swap a body can follow


@dataclass(frozen=True, eq=False)
class _State:
    """Where the search stands."""

    order: np.ndarray                    # (T, L) int, from which label each marker is taken
    unsure: np.ndarray                   # (L,) bool, swapped by tracks for so long that it may be the other way round
    bad: tuple[BadSpan, ...] = ()
    x: np.ndarray | None = None          # (T, P) the body as it follows the markers so repaired
    both_ways_tried: bool = False        # swaps that the body may have followed were looked for

    def out(self, labels: tuple[str, ...]) -> np.ndarray:
        """Bad markers (T, L) bool."""
        found = np.zeros(self.order.shape, dtype=bool)
        for span in self.bad:
            found[span.begin:span.end + 1, labels.index(span.label)] = True
        return found

    def repaired(self, markers: MarkerSequence) -> np.ndarray:
        """The markers (T, L, 3), metres, under their right labels, without bad spans."""
        return np.where(self.out(markers.labels)[..., None], np.nan, swaps.relabelled(markers.positions, self.order))


def find_artefacts(subject: Subject, markers: MarkerSequence, layout: MarkerLayout,
                   config: ArtefactConfig | None = None, motion: Motion | None = None,
                   progress: Progress | None = None, known: MarkerArtefacts | None = None) -> MarkerArtefacts:
    """Labels that were swapped, and markers that slip, jitter or stray.

    First the tracks alone tell where two labels change places. The body follows the markers so repaired, and where
    it has them tells with the tracks which labels are swapped, and which markers are elsewhere. It follows what is
    left, until nothing changes.

    Parameters
    ----------
    subject : Subject
        The person, of known shape.
    markers : MarkerSequence
    layout : MarkerLayout
        Where on the person the markers sit. Swaps are also found among labels that it does not know.
    config : ArtefactConfig, optional
    motion : Motion, optional
        Of the person in this sequence as `known` has repaired it, else `relabelled_by_tracks`, if it is known already.
    progress : callable, optional
        Called with (done, total) rounds.
    known : MarkerArtefacts, optional
        What was found in this sequence with nearly this person, to begin with.

    Raises
    ------
    ValueError
        Fewer than 3 markers in common, no frame with 3 of them, a layout of another body, a motion of other length.
    """
    config = config or ArtefactConfig()
    if motion is not None and len(motion.poses) != len(markers.positions):
        raise ValueError(f"motion: expected {len(markers.positions)} frames as the markers have, "
                         f"got {len(motion.poses)}")
    body = Simulation(subject, markers, layout, FOLLOW)
    state = _by_tracks(markers) if known is None else _State(
        known.order, np.zeros(known.order.shape[1], dtype=bool), known.bad)
    for done in range(ROUNDS):
        if motion is not None and not done and not state.unsure.any():
            x = body.taken_from(motion, state.repaired(markers))
        else:
            x = _followed(body, markers, state)
        before, state = state, _judged(body, markers, replace(state, x=x), config)
        if progress:
            progress(done + 1, ROUNDS)
        if _same(body, markers, before, state):
            break
    return _result(body, markers, replace(state, x=x))


def relabelled_by_tracks(markers: MarkerSequence) -> MarkerSequence:
    """The sequence with labels put right as far as the tracks of the markers alone tell, without a body."""
    order = swaps.find_order(markers.positions, markers.rate)
    return MarkerSequence(swaps.relabelled(markers.positions, order), markers.labels, markers.rate)


def _by_tracks(markers: MarkerSequence) -> _State:
    """What tracks alone tell; labels swapped in more than a quarter of the frames are the more likely of two ways."""
    order = swaps.find_order(markers.positions, markers.rate)
    return _State(order, (order != np.arange(order.shape[1])).mean(axis=0) > 0.25)


def _followed(body: Simulation, markers: MarkerSequence, state: _State) -> np.ndarray:
    """The body (T, P) that follows the repaired markers, without those of unsure labels where enough are left."""
    enough = 0.6                                                        # share of the markers that the layout knows
    repaired = state.repaired(markers)
    targets = np.where(state.unsure[:, None], np.nan, repaired)[:, body.rows]
    if np.isfinite(targets[..., 0]).sum(axis=1).max() < enough * len(body.rows):
        targets = repaired[:, body.rows]
    return body.solve(targets, None if state.unsure.any() else state.x)


def _judged(body: Simulation, markers: MarkerSequence, state: _State, config: ArtefactConfig) -> _State:
    """The state with the swaps and then the bad spans that the body at its x tells; x is None if it is to be anew."""
    assert state.x is not None, "the body has followed"
    places, simulated = np.full(markers.positions.shape, np.nan), body.body.positions(state.x)
    places[:, body.rows] = _expected(body, state, state.repaired(markers)[:, body.rows], simulated)
    order = swaps.find_order(markers.positions, markers.rate, places)
    sure, tried = not state.unsure.any(), state.both_ways_tried
    if sure and not tried and (order == state.order).all():
        order, tried = _both_ways(body, markers, state.x, order, places), True
    after = replace(state, order=order, unsure=np.zeros_like(state.unsure), both_ways_tried=tried)
    if not sure or (order != state.order).any():                        # where labels are wrong, so is the body
        return replace(after, bad=(), x=state.x if (order == state.order).all() else None)
    tracks = swaps.Tracks(swaps.relabelled(markers.positions, order)[:, body.rows], markers.rate)
    off = tracks.positions - simulated
    mine, alone = (body.local(v, state.x) for v in (off, body.alone(off, state.x)))
    found = find_bad(mine, alone, np.where(tracks.jumped, tracks.off, 0), body.labels, config, markers.rate)
    bad = without_lost_limbs(found, body.neighbours, body.labels)
    return replace(after, bad=bad, x=state.x if len(bad) == len(found) else None)       # a lost limb is sought anew


def _same(body: Simulation, markers: MarkerSequence, before: _State, after: _State) -> bool:
    """Whether a round has changed next to nothing."""
    changed = before.out(markers.labels) != after.out(markers.labels)
    # share of the markers that may still change when the search ends
    return bool((before.order == after.order).all() and not before.unsure.any()
                and changed[:, body.rows].mean() <= 0.002)


def _expected(body: Simulation, state: _State, repaired: np.ndarray, simulated: np.ndarray) -> np.ndarray:
    """Where markers (T, L, 3) are expected: off the simulated ones as they mostly are in their part's frame."""
    assert state.x is not None, "the body has followed"
    usual = known_median(body.local(repaired - simulated, state.x), 0)
    usual[state.unsure[body.rows]] = 0
    length = np.linalg.norm(usual, axis=1, keepdims=True)
    # metres, most that a marker's usual place is taken to be from its simulation
    usual *= np.minimum(1, 0.04 / np.maximum(length, 1e-12))
    return simulated + body.world(np.broadcast_to(usual, simulated.shape), state.x)


def _both_ways(body: Simulation, markers: MarkerSequence, x: np.ndarray, order: np.ndarray, places: np.ndarray
               ) -> np.ndarray:
    """The order (T, L) with close markers swapped where the body at x (T, P) has followed the wrong ones."""
    raw = swaps.Tracks(markers.positions, markers.rate)
    tracks = swaps.Tracks(swaps.relabelled(markers.positions, order), markers.rate)
    swapped = {(min(a, b), max(a, b)) for row in np.unique(order, axis=0) for a, b in enumerate(row.tolist()) if a != b}
    pairs, order = swaps.pairs_that_jump(raw, set(range(len(markers.labels)))) | swapped, order.copy()
    for a, b in sorted(pairs):
        if not np.median(np.linalg.norm(places[:, a] - places[:, b], axis=1)) < CLOSE:      # nor where one is unknown
            continue
        frames = ambiguous_swap(body, x, tracks, a, b)
        if len(frames):
            columns = np.array((a, b))
            order[np.ix_(frames, columns)] = order[np.ix_(frames, columns[::-1])]
            tracks.change(columns, swaps.relabelled(markers.positions, order[:, columns]))
    return order


def ambiguous_swap(body: Simulation, x: np.ndarray, tracks: swaps.Tracks, a: int, b: int) -> np.ndarray:
    """Frames (n,) in which the labels a, b of close markers are better swapped, though the body followed them as is.

    Both ways are tried in three frames of each stretch of `tracks`, from a body at x (T, P) that follows neither.
    """
    samples = 3
    begins = tracks.loose_ends(a, b)
    lengths = np.diff(np.r_[begins, len(x)])
    seen = np.isfinite(tracks.positions[:, [a, b], 0]).all(axis=1)
    frames, stretch = [], []
    for i, (begin, length) in enumerate(zip(begins, lengths, strict=True)):
        there = begin + np.flatnonzero(seen[begin:begin + length])
        if len(there):
            some = np.unique(there[np.linspace(0, len(there) - 1, samples + 2).round().astype(int)[1:-1]])
            frames.append(some)
            stretch.append(np.full(len(some), i))
    if not frames:
        return np.zeros(0, dtype=int)
    at, of = np.concatenate(frames), np.concatenate(stretch)
    value = np.clip(_gains(body, x[at], tracks.positions[at], a, b), -2 * swaps.AWAY, 2 * swaps.AWAY)
    mean = np.bincount(of, value, len(begins)) / np.maximum(np.bincount(of, minlength=len(begins)), 1)
    known = np.add.reduceat(seen.astype(float), begins)
    total, swapped = swaps.best_stretches(tracks, a, b, begins, mean * known * min(1.0, 1 / (swaps.MEMORY * body.rate)))
    return swapped if total > swaps.WORTH else swapped[:0]


def _gains(body: Simulation, x: np.ndarray, positions: np.ndarray, a: int, b: int) -> np.ndarray:
    """What it gains (n,), in half squared deviations, to swap a pair in frames with unknowns (n, P)."""
    targets = positions[:, body.rows]
    own = [int(np.flatnonzero(body.rows == label)[0]) for label in (a, b)]
    weights, _ = marker_weights(body.body.positions(x), targets, FOLLOW.marker_sd, FOLLOW.outlier)
    without, full = weights.copy(), weights
    without[:, own], full[:, own] = 0, FOLLOW.marker_sd**-2
    start = body.body.solve(x, targets, without, 8, 1e-3).x
    other = targets.copy()
    other[:, own] = targets[:, own[::-1]]
    costs = [body.body.solve(start, way, full, 8, 1e-3).energy for way in (targets, other)]
    return 0.5 * (costs[0] - costs[1])


def _result(body: Simulation, markers: MarkerSequence, state: _State) -> MarkerArtefacts:
    """What has been found."""
    assert state.x is not None, "the body has followed"
    repaired, simulated = state.repaired(markers), body.body.positions(state.x)
    targets = repaired[:, body.rows]
    weights, _ = marker_weights(simulated, targets, 1.0, FOLLOW.outlier)
    # seconds that a marker out of sight takes to its usual place, and from there
    off = bridged(body.local(targets - simulated, state.x), 0.5 * markers.rate)
    expected = simulated + body.world(off, state.x)
    return MarkerArtefacts(list_swaps(state.order, markers.seen, markers.labels), state.bad, simulated, body.labels,
                           MarkerSequence(repaired, markers.labels, markers.rate), weights, expected, state.order)


def no_artefacts(subject: Subject, markers: MarkerSequence, layout: MarkerLayout, motion: Motion) -> MarkerArtefacts:
    """What `find_artefacts` returns where nothing is wrong: markers as they came, and the body of a motion."""
    body, (T, L) = Simulation(subject, markers, layout, FOLLOW), markers.positions.shape[:2]
    x = body.taken_from(motion, markers.positions)
    return _result(body, markers, _State(np.tile(np.arange(L), (T, 1)), np.zeros(L, dtype=bool), x=x))
