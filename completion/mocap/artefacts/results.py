"""Marker artefacts: labels that two markers have swapped, and markers that slip, jitter or stray."""
from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from scanprep.ranges import Settings

from ..files.markers import MarkerSequence


@dataclass(frozen=True)
class ArtefactConfig(Settings):
    """Settings of `find_artefacts`.

    Attributes
    ----------
    slip : float, metres
        Least lasting displacement of a marker in the frame of its body part.
    stray : float, metres
        Least distance from the simulated marker for a marker that is somewhere else for a while.
    noise : float, metres
        Least jitter from frame to frame, as the median length of the second difference.
    """

    slip: float = 0.015
    stray: float = 0.06
    noise: float = 0.012


@dataclass(frozen=True, eq=False)
class Swap:
    """Two markers that bore each other's label from one frame to another, both included."""

    first: str
    second: str
    begin: int
    end: int


BadKind = Literal["slipped", "noisy", "stray"]


@dataclass(frozen=True, eq=False)
class BadSpan:
    """A marker that was not where the body says, from one frame to another, both included.

    Attributes
    ----------
    label : str
    kind : "slipped", "noisy" or "stray"
        It stays displaced, it jitters, or it is somewhere else for a while.
    begin, end : int
    distance : float, metres
        From the simulated marker, the median of the span.
    """

    label: str
    kind: BadKind
    begin: int
    end: int
    distance: float


@dataclass(frozen=True, eq=False)
class MarkerArtefacts:
    """What is wrong with the markers of a sequence.

    Attributes
    ----------
    swaps : tuple of Swap
    bad : tuple of BadSpan
    simulated : (T, L, 3) float, metres
        Where the body puts the markers that the layout knows, in the order of `labels`.
    labels : L strings
    repaired : MarkerSequence
        The sequence with swapped labels put right and bad spans taken out (NaN).
    weights : (T, L) float in [0, 1]
        How far each marker is believed; 0 where it was not seen.
    expected : (T, L, 3) float, metres
        The simulated markers, off by what the measured ones are off around that time: they join them without a step.
    order : (T, all labels of the sequence) int
        From which label of the sequence, as it came, each one was taken.
    """

    swaps: tuple[Swap, ...]
    bad: tuple[BadSpan, ...]
    simulated: np.ndarray
    labels: tuple[str, ...]
    repaired: MarkerSequence
    weights: np.ndarray
    expected: np.ndarray
    order: np.ndarray

    def virtual(self) -> MarkerSequence:
        """The repaired sequence with every gap of a marker that the layout knows filled by `expected`."""
        out = self.repaired.positions.copy()
        for i, label in enumerate(self.labels):
            row = self.repaired.labels.index(label)
            gone = np.isnan(out[:, row, 0])
            out[gone, row] = self.expected[gone, i]
        return MarkerSequence(out, self.repaired.labels, self.repaired.rate)

    @property
    def labels_touched(self) -> set[str]:
        """Labels that were swapped or bad at some time."""
        return {label for s in self.swaps for label in (s.first, s.second)} | {b.label for b in self.bad}


def list_swaps(order: np.ndarray, seen: np.ndarray, labels: tuple[str, ...]) -> tuple[Swap, ...]:
    """The swaps that an order (T, L) is made of; a longer cycle is a chain of pairs.

    A swap begins and ends where one of the two labels is seen (T, L), as they came.
    """
    frames: dict[tuple[int, int], list[int]] = {}
    for t in np.flatnonzero((order != np.arange(order.shape[1])).any(axis=1)):
        left = order[t].copy()
        for a in range(len(left)):
            while left[a] != a:                                        # puts one label right at a time
                b = int(left[a])
                left[a], left[b] = left[b], b
                frames.setdefault((min(a, b), max(a, b)), []).append(int(t))
    out = []
    for (a, b), times in frames.items():
        for run in np.split(np.array(times), np.flatnonzero(np.diff(times) > 1) + 1):
            there = run[seen[run, a] | seen[run, b]]
            if len(there):
                out.append(Swap(labels[a], labels[b], int(there[0]), int(there[-1])))
    return tuple(sorted(out, key=lambda s: (s.begin, s.first, s.second)))
