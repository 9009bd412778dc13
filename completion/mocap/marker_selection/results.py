"""What `design_markers` finds."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..marker_sets.layout import MarkerLayout


@dataclass(frozen=True, eq=False)
class Curve:
    """Sets of markers of many sizes, each the one before and a marker, or a pair, more or less.

    Attributes
    ----------
    name : str
        "removed" from all candidates, "added" to those kept or to none, or "kept, removed": those kept, made fewer.
    start : strings
        Labels of the first set.
    steps : tuple of strings each
        Labels that came or went in every step.
    counts : (S,) int
        Markers of each set, the first included.
    rmse : (S,) float, metres
        Over all vertices and bodies, linearised.
    """

    name: str
    start: tuple[str, ...]
    steps: tuple[tuple[str, ...], ...]
    counts: np.ndarray
    rmse: np.ndarray

    def labels(self, count: int) -> tuple[str, ...]:
        """The set with that many markers, or the most below it."""
        below = np.flatnonzero(self.counts <= count)
        if not len(below):
            raise ValueError(f"count: expected at least {self.counts.min()}, got {count}")
        moved = [label for step in self.steps[:int(below[np.argmax(self.counts[below])])] for label in step]
        if self.name == "added":
            return (*self.start, *moved)
        return tuple(label for label in self.start if label not in moved)


@dataclass(frozen=True, eq=False)
class Check:
    """A set of markers, its bodies estimated again without linearising.

    Attributes
    ----------
    count : int
    linearised, full : float, metres
        Root mean squared distance over all vertices and bodies.
    """

    count: int
    linearised: float
    full: float


@dataclass(frozen=True, eq=False)
class MarkerDesign:
    """A set of markers and how it was found.

    Attributes
    ----------
    layout : MarkerLayout
        The set, in the order of the candidates.
    rmse : float, metres
        Over all vertices and bodies, estimated from these markers, linearised.
    full : float, optional, metres
        The same by full refits; none where bodies of a person share betas.
    floor : float, metres
        What the model leaves of the bodies when it sees all of their surface.
    other_half : float, metres
        With sets chosen on one half of the bodies, measured on the other half; a set that only suits the bodies it
        was chosen on has much more than `rmse`.
    curves : tuple of Curve
    checks : tuple of Check
    exchanged : int
        Groups exchanged after the last step.
    """

    layout: MarkerLayout
    rmse: float
    full: float | None
    floor: float
    other_half: float
    curves: tuple[Curve, ...]
    checks: tuple[Check, ...]
    exchanged: int
