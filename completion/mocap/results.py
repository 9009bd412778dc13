"""What `mosh` and its stages find."""
from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from model.body import BodyModel
from scanprep.geometry import storage

from ..motion import Motion
from .files.markers import MarkerSequence
from .marker_sets.layout import MarkerLayout


@dataclass(frozen=True, eq=False)
class PersonFit:
    """The shape of a person and where the markers really sit.

    Attributes
    ----------
    betas : (k,) float
    layout : MarkerLayout
        Of the markers that were fitted: three vertices of a triangle with weights, and the distance from the skin.
    frames : (B, 2) int
        Number of the sequence and of the frame that were used.
    poses : (B, J, 3) float, radians
    trans : (B, 3) float, metres
    residuals : (B, L) float, metres
        Of the markers of `layout`; NaN where one was not seen.
    moved : (L,) float, metres
        How far each marker sits from its usual place on this person.
    energies : {str: float}
        What each term is at the end.
    converged : bool
    iterations : int
    """

    betas: np.ndarray
    layout: MarkerLayout
    frames: np.ndarray
    poses: np.ndarray
    trans: np.ndarray
    residuals: np.ndarray
    moved: np.ndarray
    energies: dict[str, float]
    converged: bool
    iterations: int

    @property
    def residual(self) -> float:
        """The mean distance, metres."""
        return float(np.nanmean(self.residuals))


@dataclass(frozen=True, eq=False)
class SoftTissue:
    """A motion of a body whose shape changes while it moves.

    Attributes
    ----------
    motion : Motion
        Poses and places, and the residuals with the changing shape; `motion.betas` is the person's own shape.
    changes : (T, K) float
        What is added to the person's betas in every frame; K may be more than the person's betas, which are zero beyond
        their end.
    """

    motion: Motion
    changes: np.ndarray

    def betas(self, factor: float = 1.0) -> np.ndarray:
        """(T, K) betas of every frame, the change taken `factor` times: more than 1 exaggerates it."""
        assert self.motion.betas is not None, "a person of a shape space"
        own = np.zeros(self.changes.shape[1])
        own[:len(self.motion.betas)] = self.motion.betas
        return own + factor * self.changes

    def vertices(self, model: BodyModel, frames: np.ndarray | slice = slice(None), factor: float = 1.0) -> np.ndarray:
        """The meshes (n, N, 3) of some frames, metres, the change taken `factor` times."""
        from .soft_tissue.changing_bodies import changing_bodies

        return changing_bodies(model, self.motion.poses[frames], self.betas(factor)[frames], self.motion.trans[frames])

    def movement(self, model: BodyModel) -> np.ndarray:
        """How far the change moves every vertex (N,) of the skin, metres: the root of the mean square over time."""
        from .soft_tissue.changing_bodies import skin_movement

        return skin_movement(model, self.changes)

    def save(self, path: str | Path) -> None:
        """Write a motion file (see `Motion.save`) that also holds the changes, as `shape_changes`."""
        self.motion.save(path, shape_changes=self.changes)

    @staticmethod
    def load(path: str | Path) -> SoftTissue:
        """Read a file of `save`.

        Raises
        ------
        StorageError
            Missing, not a motion, or one of a fixed shape.
        """
        motion, stored = Motion.load(path), storage.load_arrays(path, "a motion")
        with storage.taking_apart(path, f"shape_changes, a row for each of {len(motion.poses)} frames"):
            changes = storage.numbers(stored, "shape_changes", len(motion.poses), None)
        if motion.betas is None or len(motion.betas) > changes.shape[1]:
            raise storage.StorageError(f"{path}: expected a person of at most {changes.shape[1]} betas, "
                                       f"found {0 if motion.betas is None else len(motion.betas)}")
        return SoftTissue(motion, changes.astype(np.float64))


@dataclass(frozen=True, eq=False)
class Exchange:
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
class MarkerFaults:
    """What is wrong with the markers of a sequence.

    Attributes
    ----------
    exchanges : tuple of Exchange
    bad : tuple of BadSpan
    simulated : (T, L, 3) float, metres
        Where the body puts the markers that the layout knows, in the order of `labels`.
    labels : L strings
    repaired : MarkerSequence
        The sequence with exchanged labels put right and bad spans taken out (NaN).
    weights : (T, L) float in [0, 1]
        How far each marker is believed; 0 where it was not seen.
    expected : (T, L, 3) float, metres
        The simulated markers, off by what the measured ones are off around that time: they join them without a step.
    order : (T, all labels of the sequence) int
        From which label of the sequence, as it came, each one was taken.
    """

    exchanges: tuple[Exchange, ...]
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


@dataclass(frozen=True, eq=False)
class MoshResult:
    """People and motions from markers alone.

    Attributes
    ----------
    betas : (k,) float
    layout : MarkerLayout
        Where the markers really sat.
    person : PersonFit
        How they were found.
    motions : one Motion for each sequence
        With the shape fixed; residuals in the order of the sequence's labels, NaN where the layout does not know one.
    soft_tissue : one SoftTissue for each sequence, or none
    faults : one MarkerFaults for each sequence
    seconds : {str: float}
        How long each stage took: "person", "poses", "faults", "soft tissue".
    """

    betas: np.ndarray
    layout: MarkerLayout
    person: PersonFit
    motions: tuple[Motion, ...]
    soft_tissue: tuple[SoftTissue, ...]
    faults: tuple[MarkerFaults, ...]
    seconds: dict[str, float] = field(default_factory=dict)
