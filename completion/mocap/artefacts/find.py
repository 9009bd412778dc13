"""Find marker artefacts of a sequence by the body that carries the markers."""
from __future__ import annotations

import numpy as np

from model.linear import Subject

from ...motion import Motion, Progress
from ..files.markers import MarkerSequence
from ..marker_sets.layout import MarkerLayout
from ..pose import swaps
from ..pose.follow import SMOOTH_ROUNDS, between_keys, span_with_markers
from ..pose.marked_body import AnimateConfig, MarkedBody, batches, marker_weights, median_of_known
from .results import BadSpan, MarkerArtefacts, list_swaps
from .slips import find_bad, without_lost_limbs

FOLLOW = AnimateConfig()             # settings of the body that follows the markers
ROUNDS = 6                           # most rounds of repairing markers and following them again


def find_artefacts(subject: Subject, markers: MarkerSequence, layout: MarkerLayout, motion: Motion | None = None,
                   progress: Progress | None = None, known: MarkerArtefacts | None = None) -> MarkerArtefacts:
    """Find swapped labels, and markers that slip, jitter or stray.

    First the tracks alone tell where two labels were swapped. The body follows the repaired markers. Its simulated
    markers and the tracks together then tell which labels are swapped and which markers are bad. The body follows the
    rest, until nothing changes.

    Parameters
    ----------
    subject : Subject
        The person, of known shape.
    markers : MarkerSequence
        Positions (T, L, 3) in metres.
    layout : MarkerLayout
        Where on the person the markers sit. Swaps are also found among labels that it does not know.
    motion : Motion, optional
        Known motion of the person with the markers that `known` has repaired, or else `relabel_by_tracks`.
    progress : callable, optional
        Called with (done, total) rounds.
    known : MarkerArtefacts, optional
        Result for this sequence with nearly this person, as the initialisation.

    Returns
    -------
    MarkerArtefacts
        Swaps, bad spans, simulated markers (T, L, 3) in metres and the repaired sequence.

    Raises
    ------
    ValueError
        Fewer than 3 markers in common, no frame with 3 of them, a layout of another body, a motion of other length.

    Examples
    --------
    >>> from completion import load_layout
    >>> from model import load_built_in_model
    >>> model = load_built_in_model()
    >>> layout = load_layout("cmu41", model)
    >>> still = MarkerSequence(np.stack([layout.place(model)] * 5), layout.labels, 120.0)
    >>> find_artefacts(model.subject(), still, layout).swaps
    ()

    [MoSh]
    """
    if motion is not None and len(motion.poses) != len(markers.positions):
        raise ValueError(f"motion: expected {len(markers.positions)} frames as the markers have, "
                         f"got {len(motion.poses)}")
    body = Simulation(subject, markers, layout)
    bad, near, tried_both = () if known is None else known.bad, None, False
    order = swaps.find_order(markers.positions, markers.rate) if known is None else known.order
    # swapped by tracks in more than a quarter of the frames: both ways are possible, and the body has to decide
    unsure = (order != np.arange(order.shape[1])).mean(axis=0) > (0.25 if known is None else 1)
    for done in range(ROUNDS):
        # the body follows the markers as repaired so far
        repaired = _repair(markers, order, bad)[:, body.rows]
        x = body.body.body.join(motion.poses, motion.trans) if motion is not None and not done and not unsure.any() \
            else body.follow(repaired, unsure, near)

        # its simulated markers tell, with the tracks, which labels are swapped
        simulated, before, begun, sure = body.body.positions(x), order, bad, not unsure.any()
        places = np.full(markers.positions.shape, np.nan)
        places[:, body.rows] = body.expect(repaired, simulated, x, unsure)
        order = swaps.find_order(markers.positions, markers.rate, places)
        if sure and not tried_both and (order == before).all():
            order, tried_both = _both_ways(body, markers, x, order, places), True
        same, unsure = (order == before).all(), np.zeros_like(unsure)

        # and which markers are bad, once labels are right; a limb that was lost is initialised again
        bad, near = (), x if same else None
        if sure and same:
            tracks = swaps.Tracks(swaps.apply_order(markers.positions, order)[:, body.rows], markers.rate)
            off = tracks.positions - simulated
            spans = find_bad(body.local(off, x), body.local(body.alone(off, x, repaired), x),
                             np.where(tracks.jumped, tracks.off, 0), body.labels, markers.rate)
            bad = without_lost_limbs(spans, body.neighbours, body.labels)
            near = x if len(bad) == len(spans) else None
        if progress:
            progress(done + 1, ROUNDS)
        # converged: at most 0.2% of the markers changed
        if sure and same and (_out(markers, begun) != _out(markers, bad))[:, body.rows].mean() <= 0.002:
            break
    return _result(body, markers, order, bad, x)


def relabel_by_tracks(markers: MarkerSequence) -> MarkerSequence:
    """Correct swapped labels as far as the tracks of the markers alone tell, without a body."""
    order = swaps.find_order(markers.positions, markers.rate)
    return MarkerSequence(swaps.apply_order(markers.positions, order), markers.labels, markers.rate)


def no_artefacts(subject: Subject, markers: MarkerSequence, layout: MarkerLayout, motion: Motion) -> MarkerArtefacts:
    """Return the result of `find_artefacts` for a sequence without artefacts and its motion."""
    body, (T, L) = Simulation(subject, markers, layout), markers.positions.shape[:2]
    return _result(body, markers, np.tile(np.arange(L), (T, 1)), (), body.body.body.join(motion.poses, motion.trans))


def _out(markers: MarkerSequence, bad: tuple[BadSpan, ...]) -> np.ndarray:
    """Return a mask (T, L) of bad markers."""
    out = np.zeros(markers.positions.shape[:2], dtype=bool)
    for span in bad:
        out[span.begin:span.end + 1, markers.labels.index(span.label)] = True
    return out


def _repair(markers: MarkerSequence, order: np.ndarray, bad: tuple[BadSpan, ...]) -> np.ndarray:
    """Return the markers (T, L, 3), metres, under corrected labels and without bad spans."""
    return np.where(_out(markers, bad)[..., None], np.nan, swaps.apply_order(markers.positions, order))


def _result(body: Simulation, markers: MarkerSequence, order: np.ndarray, bad: tuple[BadSpan, ...], x: np.ndarray
            ) -> MarkerArtefacts:
    """Collect the result, with the body at unknowns (T, P)."""
    repaired, simulated = _repair(markers, order, bad), body.body.positions(x)
    targets = repaired[:, body.rows]
    # 0.5 s: in a gap a marker returns to its usual offset within that time, and leaves it likewise
    off = bridge_gaps(body.local(targets - simulated, x), 0.5 * markers.rate)
    return MarkerArtefacts(list_swaps(order, markers.seen, markers.labels), bad, simulated, body.labels,
                           MarkerSequence(repaired, markers.labels, markers.rate),
                           marker_weights(simulated, targets, 1.0, FOLLOW.outlier)[0],
                           simulated + body.world(off, x), order)


class Simulation:
    """A body that follows markers without changing their labels."""

    def __init__(self, subject: Subject, markers: MarkerSequence, layout: MarkerLayout) -> None:
        self.rows, known_layout = layout.match_columns(markers.labels)
        self.labels, self.rate = known_layout.labels, markers.rate
        self.body = MarkedBody(subject, known_layout, FOLLOW.prior_weight, FOLLOW.prior_shrinkage)
        self.part = subject.skeleton.part_of_vertex(subject.template)[known_layout.nearest]
        # markers of one part, or of a part and its parent, are neighbours
        hangs = self.part[:, None] == np.asarray(subject.skeleton.parents)[self.part]
        self.neighbours = (self.part[:, None] == self.part) | hangs | hangs.T

    def follow(self, targets: np.ndarray, unsure: np.ndarray | None = None, near: np.ndarray | None = None
               ) -> np.ndarray:
        """Follow markers (T, L, 3), metres; return unknowns (T, P), from a `near` solution or from key frames.

        Markers with `unsure` labels of the sequence are left out, if a frame keeps 60% of all.
        """
        if unsure is not None and unsure.any():
            near, some = None, np.where(unsure[self.rows, None], np.nan, targets)
            if np.isfinite(some[..., 0]).sum(axis=1).max() >= 0.6 * len(self.rows):
                targets = some
        x = between_keys(self.body, targets, self.rate, FOLLOW) if near is None else near.copy()
        inside, stiffness = span_with_markers(targets), FOLLOW.inertia(self.rate, self.body.n_unknowns)
        for _ in range(SMOOTH_ROUNDS):
            weights = self.weights(x[inside], targets[inside])
            x[inside] = self.body.smooth_step(x[inside], stiffness, self.body.system, targets[inside], weights)
        return x

    def weights(self, x: np.ndarray, targets: np.ndarray) -> np.ndarray:
        """Compute robust weights (n, L) of markers (n, L, 3) for the body at unknowns x (n, P)."""
        return marker_weights(self.body.positions(x), targets, FOLLOW.marker_sd, FOLLOW.outlier)[0]

    def expect(self, targets: np.ndarray, simulated: np.ndarray, x: np.ndarray, unsure: np.ndarray) -> np.ndarray:
        """Compute expected markers (T, L, 3): simulated ones plus their median offset in the frame of their part."""
        usual = median_of_known(self.local(targets - simulated, x), 0)
        usual[unsure[self.rows]] = 0
        # 4 cm: largest usual offset of a marker; more is an artefact
        usual *= np.minimum(1, 0.04 / np.maximum(np.linalg.norm(usual, axis=1, keepdims=True), 1e-12))
        return simulated + self.world(np.broadcast_to(usual, simulated.shape), x)

    def local(self, vectors: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Rotate vectors (T, L, 3) of markers from the world to the frames of their parts, for the body at x (T, P)."""
        return self._rotate("tldc,tld->tlc", vectors, x)

    def world(self, vectors: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Rotate vectors (T, L, 3) from the frames of the markers' parts to the world: the inverse of `local`."""
        return self._rotate("tldc,tlc->tld", vectors, x)

    def _rotate(self, how: str, vectors: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Multiply vectors (T, L, 3) by the rotations of the markers' parts, or their inverses, as `how` says."""
        R, out = self.body.body.skeleton.part_rotations(self.body.body.split(x)[0]), np.empty(vectors.shape)
        for some in batches(len(x)):
            out[some] = np.einsum(how, R[some][:, self.part], vectors[some])
        return out

    def alone(self, off: np.ndarray, x: np.ndarray, targets: np.ndarray) -> np.ndarray:
        """Compute offsets (T, L, 3), metres, of markers from a body that follows only the other markers.

        The body x (T, P) has followed a displaced marker a little. The offset without that follows from its leverage in
        the normal equations of all markers, at targets (T, L, 3).
        """
        # the leverage is computed in 15 frames a second, and interpolated
        T, every = len(x), max(1, round(self.rate / 15))
        frames = np.arange(min(every // 2, T - 1), T, every)
        weights, freed = self.weights(x[frames], targets[frames]), np.empty((len(frames), *off.shape[1:], 3))
        # matrices (3, 3) from the remaining offset to the full displacement: (I - leverage)⁻¹
        for some in batches(len(frames)):
            at = x[frames[some]]
            _, _, hessian = self.body.system(at, targets[frames[some]], weights[some])
            _, columns = self.body.shapes.columns(*self.body.body.split(at)[:2])                     # (B, P, 3, L)
            B, P = columns.shape[:2]
            hessian += 1e-9 * np.trace(hessian, axis1=1, axis2=2)[:, None, None] * np.eye(P)
            answer = np.linalg.solve(hessian, columns.reshape(B, P, -1)).reshape(columns.shape)
            share, axes = np.linalg.eigh(np.einsum("bpcl,bpdl->blcd", columns, answer) * weights[some][..., None, None])
            # 0.6: largest leverage, so that the inverse stays small
            freed[some] = (axes / (1 - np.clip(share, 0, 0.6))[..., None, :]) @ np.swapaxes(axes, -1, -2)
        out = np.empty_like(off)
        for some in batches(T):
            t = np.clip(np.arange(T)[some], frames[0], frames[-1])      # constant before the first and after the last
            i = np.clip(np.searchsorted(frames, t, side="right") - 1, 0, max(len(frames) - 2, 0))
            share = ((t - frames[i]) / every)[:, None, None, None]
            now = freed[i] + share * (freed[np.minimum(i + 1, len(frames) - 1)] - freed[i])
            out[some] = (now @ off[some][..., None])[..., 0]
        return out


def _both_ways(body: Simulation, markers: MarkerSequence, x: np.ndarray, order: np.ndarray, places: np.ndarray
               ) -> np.ndarray:
    """Swap close markers in the order (T, L) where the body at x (T, P) has followed the wrong ones."""
    raw = swaps.Tracks(markers.positions, markers.rate)
    tracks = swaps.Tracks(swaps.apply_order(markers.positions, order), markers.rate)
    swapped = {(min(a, b), max(a, b)) for row in np.unique(order, axis=0) for a, b in enumerate(row.tolist()) if a != b}
    pairs, order = swaps.pairs_that_jump(raw, set(range(len(markers.labels)))) | swapped, order.copy()
    for a, b in sorted(pairs):
        # 0.25 m: a body can follow a swap of markers that close; NaN, an unknown place, compares false
        if np.median(np.linalg.norm(places[:, a] - places[:, b], axis=1)) < 0.25:
            frames, columns = ambiguous_swap(body, x, tracks, a, b), np.array((a, b))
            order[np.ix_(frames, columns)] = order[np.ix_(frames, columns[::-1])]
            if len(frames):
                tracks.change(columns, swaps.apply_order(markers.positions, order[:, columns]))
    return order


def ambiguous_swap(body: Simulation, x: np.ndarray, tracks: swaps.Tracks, a: int, b: int) -> np.ndarray:
    """Find frames (n,) in which labels a, b of close markers are better swapped, though the body followed them as is.

    Both ways are fitted in three frames of each stretch of `tracks`, from a body x (T, P) solved without the pair.
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

    # the gain of a swap in these frames, in half squared deviations
    targets, own = tracks.positions[at][:, body.rows], [int(np.flatnonzero(body.rows == label)[0]) for label in (a, b)]
    full = body.weights(x[at], targets)
    without, other = full.copy(), targets.copy()
    without[:, own], full[:, own], other[:, own] = 0, FOLLOW.marker_sd**-2, targets[:, own[::-1]]
    start = body.body.solve(x[at], targets, without, 8, 1e-3).x
    as_is, exchanged = (body.body.solve(start, way, full, 8, 1e-3).energy for way in (targets, other))
    value = np.clip(0.5 * (as_is - exchanged), -2 * swaps.AWAY, 2 * swaps.AWAY)

    # stretches with a gain: the mean of the tried frames counts for all frames that show both markers
    mean = np.bincount(of, value, len(begins)) / np.maximum(np.bincount(of, minlength=len(begins)), 1)
    known = np.add.reduceat(seen.astype(float), begins)
    total, swapped = swaps.best_stretches(tracks, a, b, begins, mean * known * min(1.0, 1 / (swaps.MEMORY * body.rate)))
    return swapped if total > swaps.WORTH else swapped[:0]


def bridge_gaps(local: np.ndarray, reach: float) -> np.ndarray:
    """Fill gaps in offsets of markers (T, L, 3): linearly, and long gaps through the usual offset."""
    out = np.repeat(median_of_known(local, 0)[None], len(local), axis=0)
    for i in range(local.shape[1]):
        seen = np.flatnonzero(np.isfinite(local[:, i, 0]))
        if not len(seen):
            continue
        usual, times = out[0, i].copy(), np.arange(len(local))
        after = np.searchsorted(seen, times)
        left, right = seen[np.maximum(after - 1, 0)], seen[np.minimum(after, len(seen) - 1)]
        # each end of a gap fades to the usual offset over at most `reach` frames
        span = np.clip(right - left, 1, reach)
        share = [np.clip(1 - np.abs(times - end) / span, 0, 1)[:, None] for end in (left, right)]
        share[1][left == right] = 0                                    # before the first, after the last
        out[:, i] += share[0] * (local[left, i] - usual) + share[1] * (local[right, i] - usual)
        out[seen, i] = local[seen, i]
    return out
