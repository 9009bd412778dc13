"""What is wrong with the markers of a sequence, by the body that carries them."""
from __future__ import annotations

import numpy as np

from model.linear import Subject

from ...motion import Motion, Progress
from ..files.markers import MarkerSequence
from ..marker_sets.layout import MarkerLayout
from ..pose import swaps
from ..pose.follow import between_keys, span_with_markers
from ..pose.marked_body import AnimateConfig, MarkedBody, batches, marker_weights, median_of_known
from .results import ArtefactConfig, BadSpan, MarkerArtefacts, list_swaps
from .slips import find_bad, without_lost_limbs

FOLLOW = AnimateConfig()             # how the body follows the markers here
ROUNDS = 6                           # most times that markers are repaired and the body follows them anew


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
        Of the person in this sequence as `known` has repaired it, else `relabel_by_tracks`, if it is known already.
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
    body = Simulation(subject, markers, layout)
    bad, near, tried_both = () if known is None else known.bad, None, False
    order = swaps.find_order(markers.positions, markers.rate) if known is None else known.order
    # labels that tracks have swapped in more than a quarter of the frames are the more likely of two ways
    unsure = (order != np.arange(order.shape[1])).mean(axis=0) > (0.25 if known is None else 1)
    for done in range(ROUNDS):
        # the body follows the markers as they are repaired by now, from where it was
        repaired = _repair(markers, order, bad)[:, body.rows]
        x = body.body.body.join(motion.poses, motion.trans) if motion is not None and not done and not unsure.any() \
            else body.follow(repaired, unsure, near)

        # what it expects tells with the tracks which labels are swapped
        simulated, before, begun, sure = body.body.positions(x), order, bad, not unsure.any()
        places = np.full(markers.positions.shape, np.nan)
        places[:, body.rows] = body.expect(repaired, simulated, x, unsure)
        order = swaps.find_order(markers.positions, markers.rate, places)
        if sure and not tried_both and (order == before).all():
            order, tried_both = _both_ways(body, markers, x, order, places), True
        same, unsure = (order == before).all(), np.zeros_like(unsure)

        # and which markers are elsewhere; where labels are wrong, so is the body, and a lost limb is sought anew
        bad, near = (), x if same else None
        if sure and same:
            tracks = swaps.Tracks(swaps.apply_order(markers.positions, order)[:, body.rows], markers.rate)
            off = tracks.positions - simulated
            found = find_bad(body.local(off, x), body.local(body.alone(off, x, repaired), x),
                             np.where(tracks.jumped, tracks.off, 0), body.labels, config, markers.rate)
            bad = without_lost_limbs(found, body.neighbours, body.labels)
            near = x if len(bad) == len(found) else None
        if progress:
            progress(done + 1, ROUNDS)
        # share of the markers that may still change when the search ends
        if sure and same and (_out(markers, begun) != _out(markers, bad))[:, body.rows].mean() <= 0.002:
            break
    return _result(body, markers, order, bad, x)


def relabel_by_tracks(markers: MarkerSequence) -> MarkerSequence:
    """The sequence with labels put right as far as the tracks of the markers alone tell, without a body."""
    order = swaps.find_order(markers.positions, markers.rate)
    return MarkerSequence(swaps.apply_order(markers.positions, order), markers.labels, markers.rate)


def no_artefacts(subject: Subject, markers: MarkerSequence, layout: MarkerLayout, motion: Motion) -> MarkerArtefacts:
    """What `find_artefacts` returns where nothing is wrong: markers as they came, and the body of a motion."""
    body, (T, L) = Simulation(subject, markers, layout), markers.positions.shape[:2]
    return _result(body, markers, np.tile(np.arange(L), (T, 1)), (), body.body.body.join(motion.poses, motion.trans))


def _out(markers: MarkerSequence, bad: tuple[BadSpan, ...]) -> np.ndarray:
    """Bad markers (T, L) bool."""
    out = np.zeros(markers.positions.shape[:2], dtype=bool)
    for span in bad:
        out[span.begin:span.end + 1, markers.labels.index(span.label)] = True
    return out


def _repair(markers: MarkerSequence, order: np.ndarray, bad: tuple[BadSpan, ...]) -> np.ndarray:
    """The markers (T, L, 3), metres, under their right labels, without bad spans."""
    return np.where(_out(markers, bad)[..., None], np.nan, swaps.apply_order(markers.positions, order))


def _result(body: Simulation, markers: MarkerSequence, order: np.ndarray, bad: tuple[BadSpan, ...], x: np.ndarray
            ) -> MarkerArtefacts:
    """What has been found, with the body at unknowns (T, P)."""
    repaired, simulated = _repair(markers, order, bad), body.body.positions(x)
    targets = repaired[:, body.rows]
    # seconds that a marker out of sight takes to its usual place, and from there
    off = bridge_gaps(body.local(targets - simulated, x), 0.5 * markers.rate)
    return MarkerArtefacts(list_swaps(order, markers.seen, markers.labels), bad, simulated, body.labels,
                           MarkerSequence(repaired, markers.labels, markers.rate),
                           marker_weights(simulated, targets, 1.0, FOLLOW.outlier)[0],
                           simulated + body.world(off, x), order)


class Simulation:
    """A body that follows markers whose labels are taken as they are."""

    def __init__(self, subject: Subject, markers: MarkerSequence, layout: MarkerLayout) -> None:
        self.rows, worn = layout.match_columns(markers.labels)
        self.labels, self.rate = worn.labels, markers.rate
        self.body = MarkedBody(subject, worn, FOLLOW.prior_weight, FOLLOW.prior_shrinkage)
        self.part = subject.skeleton.part_of_vertex(subject.template)[worn.nearest]
        hangs = self.part[:, None] == np.asarray(subject.skeleton.parents)[self.part]
        self.neighbours = (self.part[:, None] == self.part) | hangs | hangs.T

    def follow(self, targets: np.ndarray, unsure: np.ndarray | None = None, near: np.ndarray | None = None
               ) -> np.ndarray:
        """Unknowns (T, P) of the body that follows markers (T, L, 3), metres, from others that are near or anew.

        Markers of labels of the sequence that are `unsure` are left out where three fifths of all are left.
        """
        if unsure is not None and unsure.any():
            near, some = None, np.where(unsure[self.rows, None], np.nan, targets)
            if np.isfinite(some[..., 0]).sum(axis=1).max() >= 0.6 * len(self.rows):
                targets = some
        x = between_keys(self.body, targets, self.rate, FOLLOW) if near is None else near.copy()
        inside, stiffness = span_with_markers(targets), FOLLOW.inertia(self.rate, self.body.n_unknowns)
        for _ in range(FOLLOW.smoothing):
            weights = self.weights(x[inside], targets[inside])
            x[inside] = self.body.smooth_step(x[inside], stiffness, self.body.system, targets[inside], weights)
        return x

    def weights(self, x: np.ndarray, targets: np.ndarray) -> np.ndarray:
        """Weights (n, L) of markers (n, L, 3), low for outliers, the body being at unknowns (n, P)."""
        return marker_weights(self.body.positions(x), targets, FOLLOW.marker_sd, FOLLOW.outlier)[0]

    def expect(self, targets: np.ndarray, simulated: np.ndarray, x: np.ndarray, unsure: np.ndarray) -> np.ndarray:
        """Where markers (T, L, 3) are expected: off the simulated ones as they mostly are in their part's frame."""
        usual = median_of_known(self.local(targets - simulated, x), 0)
        usual[unsure[self.rows]] = 0
        # metres, most that a marker's usual place is taken to be from its simulation
        usual *= np.minimum(1, 0.04 / np.maximum(np.linalg.norm(usual, axis=1, keepdims=True), 1e-12))
        return simulated + self.world(np.broadcast_to(usual, simulated.shape), x)

    def local(self, vectors: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Vectors (T, L, 3) of markers in the frames of their parts, the body being at x (T, P)."""
        return self._rotate("tldc,tld->tlc", vectors, x)

    def world(self, vectors: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Vectors (T, L, 3) in the frames of the markers' parts as they are in the world: the inverse of `local`."""
        return self._rotate("tldc,tlc->tld", vectors, x)

    def _rotate(self, how: str, vectors: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Products (T, L, 3) of the rotations of the markers' parts, from the part to the world, and vectors."""
        R, out = self.body.body.skeleton.part_rotations(self.body.body.split(x)[0]), np.empty(vectors.shape)
        for some in batches(len(x)):
            out[some] = np.einsum(how, R[some][:, self.part], vectors[some])
        return out

    def alone(self, off: np.ndarray, x: np.ndarray, targets: np.ndarray) -> np.ndarray:
        """What markers, off by (T, L, 3) metres, would be off if the body x (T, P) followed the others alone.

        The body has gone after a displaced marker a little: its own part in the normal equations of all markers, at
        targets (T, L, 3), is taken back.
        """
        T, every = len(x), max(1, round(self.rate / 15))                # 15 looks a second at how markers draw the body
        frames = np.arange(min(every // 2, T - 1), T, every)
        weights, freed = self.weights(x[frames], targets[frames]), np.empty((len(frames), *off.shape[1:], 3))
        # matrices from what is left of a displacement to the whole of it
        for some in batches(len(frames)):
            at = x[frames[some]]
            _, _, hessian = self.body.system(at, targets[frames[some]], weights[some])
            _, columns = self.body.shapes.columns(*self.body.body.split(at)[:2])                     # (B, P, 3, L)
            B, P = columns.shape[:2]
            hessian += 1e-9 * np.trace(hessian, axis1=1, axis2=2)[:, None, None] * np.eye(P)
            answer = np.linalg.solve(hessian, columns.reshape(B, P, -1)).reshape(columns.shape)
            share, axes = np.linalg.eigh(np.einsum("bpcl,bpdl->blcd", columns, answer) * weights[some][..., None, None])
            # most of a displacement that the body is taken to have followed
            freed[some] = (axes / (1 - np.clip(share, 0, 0.6))[..., None, :]) @ np.swapaxes(axes, -1, -2)
        out = np.empty_like(off)
        for some in batches(T):
            t = np.clip(np.arange(T)[some], frames[0], frames[-1])      # before the first and after the last look
            i = np.clip(np.searchsorted(frames, t, side="right") - 1, 0, max(len(frames) - 2, 0))
            share = ((t - frames[i]) / every)[:, None, None, None]
            now = freed[i] + share * (freed[np.minimum(i + 1, len(frames) - 1)] - freed[i])
            out[some] = (now @ off[some][..., None])[..., 0]
        return out


def _both_ways(body: Simulation, markers: MarkerSequence, x: np.ndarray, order: np.ndarray, places: np.ndarray
               ) -> np.ndarray:
    """The order (T, L) with close markers swapped where the body at x (T, P) has followed the wrong ones."""
    raw = swaps.Tracks(markers.positions, markers.rate)
    tracks = swaps.Tracks(swaps.apply_order(markers.positions, order), markers.rate)
    swapped = {(min(a, b), max(a, b)) for row in np.unique(order, axis=0) for a, b in enumerate(row.tolist()) if a != b}
    pairs, order = swaps.pairs_that_jump(raw, set(range(len(markers.labels)))) | swapped, order.copy()
    for a, b in sorted(pairs):
        # metres between markers whose swap a body can follow; a place that is unknown is near to none
        if np.median(np.linalg.norm(places[:, a] - places[:, b], axis=1)) < 0.25:
            frames, columns = ambiguous_swap(body, x, tracks, a, b), np.array((a, b))
            order[np.ix_(frames, columns)] = order[np.ix_(frames, columns[::-1])]
            if len(frames):
                tracks.change(columns, swaps.apply_order(markers.positions, order[:, columns]))
    return order


def ambiguous_swap(body: Simulation, x: np.ndarray, tracks: swaps.Tracks, a: int, b: int) -> np.ndarray:
    """Frames (n,) in which the labels a, b of close markers are better swapped, though the body followed them as is.

    Both ways are tried in three frames of each stretch of `tracks`, from a body at x (T, P) that follows neither.
    """
    begins = tracks.loose_ends(a, b)
    seen = np.isfinite(tracks.positions[:, [a, b], 0]).all(axis=1)
    frames, stretch = [np.zeros(0, dtype=int)], [np.zeros(0, dtype=int)]
    for i, (begin, end) in enumerate(zip(begins, [*begins[1:], len(x)], strict=True)):
        there = begin + np.flatnonzero(seen[begin:end])
        frames.append(np.unique(there[np.linspace(0, len(there) - 1, 5).round().astype(int)[1:-1]] if len(there)
                                else there))
        stretch.append(np.full(len(frames[-1]), i))
    at, of = np.concatenate(frames), np.concatenate(stretch)
    if not len(at):
        return at

    # what it gains in them, in half squared deviations, to swap the pair
    targets, own = tracks.positions[at][:, body.rows], [int(np.flatnonzero(body.rows == label)[0]) for label in (a, b)]
    full = body.weights(x[at], targets)
    without, other = full.copy(), targets.copy()
    without[:, own], full[:, own], other[:, own] = 0, FOLLOW.marker_sd**-2, targets[:, own[::-1]]
    start = body.body.solve(x[at], targets, without, 8, 1e-3).x
    as_is, exchanged = (body.body.solve(start, way, full, 8, 1e-3).energy for way in (targets, other))
    value = np.clip(0.5 * (as_is - exchanged), -2 * swaps.AWAY, 2 * swaps.AWAY)

    # the stretches in which it does, each as its mean in all frames that show both
    mean = np.bincount(of, value, len(begins)) / np.maximum(np.bincount(of, minlength=len(begins)), 1)
    known = np.add.reduceat(seen.astype(float), begins)
    total, swapped = swaps.best_stretches(tracks, a, b, begins, mean * known * min(1.0, 1 / (swaps.MEMORY * body.rate)))
    return swapped if total > swaps.WORTH else swapped[:0]


def bridge_gaps(local: np.ndarray, reach: float) -> np.ndarray:
    """What markers are off (T, L, 3), NaN in gaps, with these bridged: straight, long ones by the usual place."""
    out = np.repeat(median_of_known(local, 0)[None], len(local), axis=0)
    for i in range(local.shape[1]):
        seen = np.flatnonzero(np.isfinite(local[:, i, 0]))
        if not len(seen):
            continue
        usual, times = out[0, i].copy(), np.arange(len(local))
        after = np.searchsorted(seen, times)
        left, right = seen[np.maximum(after - 1, 0)], seen[np.minimum(after, len(seen) - 1)]
        span = np.clip(right - left, 1, reach)
        share = [np.clip(1 - np.abs(times - end) / span, 0, 1)[:, None] for end in (left, right)]
        share[1][left == right] = 0                                    # before the first, after the last
        out[:, i] += share[0] * (local[left, i] - usual) + share[1] * (local[right, i] - usual)
        out[seen, i] = local[seen, i]
    return out
