"""What is wrong with the markers of a sequence, by the body that carries them."""
from __future__ import annotations

from collections.abc import Callable

import numpy as np

from model.linear import Subject

from ...motion import Motion
from ..files.markers import MarkerSequence
from ..marker_sets.layout import MarkerLayout
from ..pose.robust import marker_weights
from ..results import BadSpan, MarkerFaults
from ..settings import FaultConfig
from .ambiguous_swaps import doubtful_pairs, exchanged_after_all
from .simulated import Simulation, bridged, usual_places
from .slips import find_bad, without_lost_limbs
from .swaps import Evidence, find_order, listed, marker_levels, pairs_that_jump
from .tracks import Tracks

Progress = Callable[[int, int], None]
BRIDGE = 0.5                         # seconds that a marker out of sight takes to its usual place, and from there
USUAL_PLACE = 0.04                   # metres, most that a marker's usual place is taken to be from its simulation
UNSURE = 0.25                        # share of the frames in which a label was exchanged, the more likely of two ways
ENOUGH = 0.6                         # share of the markers that must be left without those
SETTLED = 0.002                      # share of the markers that may still change when the search ends


def find_faults(subject: Subject, markers: MarkerSequence, layout: MarkerLayout, config: FaultConfig | None = None,
                motion: Motion | None = None, progress: Progress | None = None) -> MarkerFaults:
    """Labels that were exchanged, and markers that slip, jitter or stray.

    First the tracks alone tell where two labels change places. The body follows the markers so repaired, and where
    it has them tells with the tracks which labels are exchanged, and which markers are elsewhere. It follows what is
    left, until nothing changes.

    Parameters
    ----------
    subject : Subject
        The person, of known shape.
    markers : MarkerSequence
    layout : MarkerLayout
        Where on the person the markers sit. Exchanges are also found among labels that it does not know.
    motion : Motion, optional
        Of the person in this sequence, where it is known already; it is followed anew where markers are repaired.
    progress : callable, optional
        Called with (done, total) rounds.

    Raises
    ------
    ValueError
        Fewer than 3 markers in common, no frame with 3 of them, a layout of another body, a motion of other length.
    """
    config = config or FaultConfig()
    if motion is not None and len(motion.poses) != len(markers.positions):
        raise ValueError(f"motion: expected {len(markers.positions)} frames as the markers have, "
                         f"got {len(motion.poses)}")
    search = _Search(subject, markers, layout, config)
    for done in range(config.rounds):
        if motion is not None and not done and search.untouched:
            search.take(motion)
        else:
            search.follow()
        settled = search.look()
        if progress:
            progress(done + 1, config.rounds)
        if settled:
            break
    return search.result()


def by_tracks(markers: MarkerSequence, config: FaultConfig | None = None) -> MarkerSequence:
    """The sequence with labels put right as far as the tracks of the markers alone tell, without a body."""
    return MarkerSequence(_ordered(markers, _order_by_tracks(markers, config or FaultConfig())), markers.labels,
                          markers.rate)


def _order_by_tracks(markers: MarkerSequence, config: FaultConfig) -> np.ndarray:
    """Which column (T, L) each marker is to be taken from."""
    T, L = markers.positions.shape[:2]
    return find_order(Evidence(markers.positions, np.zeros((T, L, L)), markers.rate), config)


def _ordered(markers: MarkerSequence, order: np.ndarray) -> np.ndarray:
    """The markers (T, L, 3), metres, under the labels that an order (T, L) gives them."""
    return np.take_along_axis(markers.positions, order[..., None], axis=1)


class _Search:
    """The state of the search: labels, bad spans and the body that follows the rest.

    Parameters
    ----------
    subject : Subject
    markers : MarkerSequence
    layout : MarkerLayout
    config : FaultConfig
    """

    def __init__(self, subject: Subject, markers: MarkerSequence, layout: MarkerLayout, config: FaultConfig) -> None:
        self.config, self.markers = config, markers
        self.body = Simulation(subject, markers, layout, config.follow)
        T, L = markers.positions.shape[:2]
        self.order = _order_by_tracks(markers, config)
        self.bad: tuple[BadSpan, ...] = ()
        self.unsure = (self.order != np.arange(L)).mean(axis=0) > UNSURE
        self.solved: np.ndarray | None = None
        self.tried = False
        self.out = np.zeros((T, L), dtype=bool)

    @property
    def untouched(self) -> bool:
        """No label has been exchanged."""
        return bool((self.order == np.arange(self.order.shape[1])).all())

    @property
    def ordered(self) -> np.ndarray:
        """The markers (T, L, 3), metres, under their right labels."""
        return _ordered(self.markers, self.order)

    @property
    def repaired(self) -> np.ndarray:
        """The same without bad spans."""
        return np.where(self.out[..., None], np.nan, self.ordered)

    def take(self, motion: Motion) -> None:
        """Have the body as in a motion."""
        self.body.targets = self.repaired[:, self.body.rows]
        self.x, self.solved = self.body.body.body.join(motion.poses, motion.trans), self.order

    def follow(self) -> None:
        """Have the body follow the repaired markers, at first without those whose label is in doubt."""
        targets = np.where(self.unsure[:, None], np.nan, self.repaired)[:, self.body.rows]
        if np.isfinite(targets[..., 0]).sum(axis=1).max() < ENOUGH * len(self.body.rows):
            targets = self.repaired[:, self.body.rows]
        same = self.solved is not None and (self.solved == self.order).all()
        self.x = self.body.solve(targets, self.x if same and not self.unsure.any() else None)
        self.solved = self.order

    def look(self) -> bool:
        """Find exchanges, and then bad spans, by where the body has the markers; whether nothing has changed."""
        before, out, unsure = self.order, self.out, self.unsure.any()
        places = np.full(self.markers.positions.shape, np.nan)
        simulated = self.body.positions(self.x)
        places[:, self.body.rows] = self._usual(simulated)
        levels = marker_levels(places, self.markers.positions, self.config, self.markers.rate)
        self.order = find_order(Evidence(self.markers.positions, levels, self.markers.rate), self.config)
        self.unsure = np.zeros(len(self.unsure), dtype=bool)
        if not unsure and not self.tried and (before == self.order).all():
            self.tried = True
            self._try_both_ways(places)
        if (before != self.order).any() or unsure:                     # where labels are wrong, so is the body
            self.bad, self.out = (), np.zeros_like(out)
            return False
        self._find_bad(simulated)
        return bool((self.out != out)[:, self.body.rows].mean() <= SETTLED)

    def _try_both_ways(self, places: np.ndarray) -> None:
        """Exchange close markers where the body has followed the wrong ones."""
        config, rate, L = self.config, self.markers.rate, len(self.markers.labels)
        raw = Tracks(self.markers.positions, rate, config.floor, config.jump)
        exchanged = {(min(a, b), max(a, b)) for row in np.unique(self.order, axis=0)
                     for a, b in enumerate(row.tolist()) if a != b}
        order, tracks = self.order.copy(), Tracks(self.ordered, rate, config.floor, config.jump)
        for a, b in doubtful_pairs(pairs_that_jump(raw, set(range(L))) | exchanged, places):
            swapped = exchanged_after_all(self.body, self.x, tracks, a, b, config)
            if len(swapped):
                columns = np.array((a, b))
                order[np.ix_(swapped, columns)] = order[np.ix_(swapped, columns[::-1])]
                tracks.changed(columns, np.take_along_axis(self.markers.positions, order[:, columns, None], axis=1))
        self.order = order

    def _find_bad(self, simulated: np.ndarray) -> None:
        """Find the bad spans."""
        config, rate = self.config, self.markers.rate
        tracks = Tracks(self.ordered[:, self.body.rows], rate, config.floor, config.jump)
        off = tracks.positions - simulated
        mine, alone = (self.body.local(v, self.x) for v in (off, self.body.alone(off, self.x)))
        jumps = np.where(tracks.jumped, tracks.off, 0)
        found = find_bad(mine, alone, jumps, self.body.labels, config, rate)
        self.bad = without_lost_limbs(found, self.body.neighbours, self.body.labels)
        if len(self.bad) < len(found):
            self.solved = None                                          # a limb is lost: it is looked for anew
        self.out = np.zeros_like(self.out)
        for span in self.bad:
            self.out[span.begin:span.end + 1, self.markers.labels.index(span.label)] = True

    def _usual(self, simulated: np.ndarray) -> np.ndarray:
        """Where markers (T, L, 3) are expected: off the simulated ones as they mostly are in their part's frame."""
        usual = usual_places(self.body.local(self.repaired[:, self.body.rows] - simulated, self.x))
        usual[self.unsure[self.body.rows]] = 0
        length = np.linalg.norm(usual, axis=1, keepdims=True)
        usual *= np.minimum(1, USUAL_PLACE / np.maximum(length, 1e-12))
        return simulated + np.einsum("tldc,lc->tld", self.body.part_rotations(self.x), usual)

    def result(self) -> MarkerFaults:
        """What has been found."""
        repaired, labels = self.repaired, self.markers.labels
        simulated = self.body.positions(self.x)
        targets, sd = repaired[:, self.body.rows], self.config.follow.marker_sd
        weights, _ = marker_weights(simulated, targets, sd, self.config.follow.outlier)
        off = bridged(self.body.local(targets - simulated, self.x), BRIDGE * self.markers.rate)
        expected = simulated + np.einsum("tldc,tlc->tld", self.body.part_rotations(self.x), off)
        return MarkerFaults(listed(self.order, self.markers.seen, labels), self.bad, simulated, self.body.labels,
                            MarkerSequence(repaired, labels, self.markers.rate), weights * sd**2, expected, self.order)
