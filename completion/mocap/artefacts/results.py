"""Marker artefacts: swapped labels, markers that slip, jitter or stray; and files of virtual markers."""
from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from scanprep.console import say
from scanprep.geometry import storage

from ..files.c3d import point_table, replace_points, write_c3d
from ..files.c3d_points import add_points
from ..files.markers import MarkerSequence, subject_columns, write_markers
from ..files.opensim import unlike
from ..files.text import MarkerFileError
from ..pose.marked_body import stretches


@dataclass(frozen=True, eq=False)
class Swap:
    """Two markers that were swapped from one frame to another, both included."""

    first: str
    second: str
    begin: int
    end: int


BadKind = Literal["slipped", "noisy", "stray"]


@dataclass(frozen=True, eq=False)
class BadSpan:
    """A bad marker, far from its simulation, from one frame to another, both included.

    "slipped" stays displaced, "noisy" jitters, "stray" is elsewhere for a while. The distance from the simulated
    marker, metres, is the median of the span.
    """

    label: str
    kind: BadKind
    begin: int
    end: int
    distance: float


@dataclass(frozen=True, eq=False)
class MarkerArtefacts:
    """The artefacts of the markers of a sequence.

    Attributes
    ----------
    swaps : tuple of Swap
    bad : tuple of BadSpan
    simulated : (T, L, 3) float, metres
        Simulated markers of the layout, in the order of `labels`.
    labels : L strings
    repaired : MarkerSequence
        The sequence with corrected labels, and NaN in bad spans.
    weights : (T, L) float in [0, 1]
        Robust weight of each marker; 0 where it was not seen.
    expected : (T, L, 3) float, metres
        Simulated markers plus the offset of the measured ones around that time, so that gaps are filled without a step.
    order : (T, all labels of the sequence) int
        Column of the original sequence from which each label was taken.
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

    def rename_labels(self, order: np.ndarray, seen: np.ndarray) -> MarkerArtefacts:
        """Return the artefacts in the labels of the original sequence, whose columns `order` (L,) were used throughout.

        `seen` (T, L) marks where the original markers were seen.
        """
        if (order == np.arange(len(order))).all():
            return self
        whole = order[self.order]
        return replace(self, order=whole, swaps=list_swaps(whole, seen, self.repaired.labels))

    @property
    def labels_touched(self) -> set[str]:
        """Labels that were swapped or bad at any time."""
        return {label for s in self.swaps for label in (s.first, s.second)} | {b.label for b in self.bad}


def list_swaps(order: np.ndarray, seen: np.ndarray, labels: tuple[str, ...]) -> tuple[Swap, ...]:
    """Return the swaps of an order (T, L), longer cycles as pairs; at both ends one of the two markers is seen."""
    frames: dict[tuple[int, int], list[int]] = {}
    for t in np.flatnonzero((order != np.arange(order.shape[1])).any(axis=1)):
        left = order[t].copy()
        for a in range(len(left)):
            while left[a] != a:                                        # each swap corrects one label
                b = int(left[a])
                left[a], left[b] = left[b], b
                frames.setdefault((min(a, b), max(a, b)), []).append(int(t))
    out = []
    # successive frames of a pair are one swap, from the first to the last frame with one of them in sight
    for (a, b), times in frames.items():
        for run in stretches(np.array(times)):
            visible = run[seen[run, a] | seen[run, b]]
            if len(visible):
                out.append(Swap(labels[a], labels[b], int(visible[0]), int(visible[-1])))
    return tuple(sorted(out, key=lambda s: (s.begin, s.first, s.second)))


def write_virtual(path: str | Path, artefacts: MarkerArtefacts, original: str | Path | None = None,
                  subject_prefix: str | None = None, unit: str | None = None, joints: MarkerSequence | None = None
                  ) -> None:
    """Write the markers of a sequence with all gaps filled; the file appears whole or not at all.

    In a C3D file, computed points have residual 0 and no cameras, as the format says, and measured ones a residual
    above 0. In a copy of the original file only the points change: everything else, such as analog channels and
    events, stays byte for byte. A CSV file cannot mark computed points.

    Parameters
    ----------
    path : str or Path
        A name that ends in `.c3d` or `.csv`.
    artefacts : MarkerArtefacts
        Of the sequence.
    original : str or Path, optional
        The C3D file that the sequence was read from.
    subject_prefix, unit : str, optional
        As `read_markers` was given them for the original.
    joints : MarkerSequence, optional
        Joint centres, in metres, written to a C3D file as further points, marked as computed.

    Raises
    ------
    MarkerFileError
        A name with another ending, an original that is no C3D file or has other frames or labels.

    Examples
    --------
    >>> from completion.mocap.artefacts.results import MarkerArtefacts
    >>> still = MarkerSequence(np.zeros((3, 2, 3)) + 0.5, ("C7", "T10"), 120.0)
    >>> places = still.positions
    >>> clean = MarkerArtefacts((), (), places, still.labels, still, np.ones((3, 2)), places, np.tile([0, 1], (3, 1)))
    >>> write_virtual("virtual.csv", clean)

    [MoSh]
    """
    path, sequence = Path(path), artefacts.virtual()
    filled = ~artefacts.repaired.seen
    # other formats have no room for what a C3D tells of computed points
    if path.suffix.lower() != ".c3d":
        write_markers(path, sequence)
        return
    source = None if original is None else Path(original)
    data = None if source is None else storage.read_bytes(source, "a C3D file", MarkerFileError)
    with storage.writing(path) as beside:
        if source is None or data is None:
            write_c3d(beside, sequence.positions, sequence.labels, sequence.rate, filled)
        else:
            # where the labels stand among the points that have positions
            table = point_table(source, data)
            columns, bare = subject_columns(source, [table.labels[i] for i in table.kept], subject_prefix)
            missing = [label for label in sequence.labels if label not in bare]
            if missing:
                raise MarkerFileError(f"{source}: expected the labels of the sequence, {', '.join(missing)} not among "
                                      f"{', '.join(bare)}")
            rows = np.array([columns[bare.index(label)] for label in sequence.labels])
            beside.write_bytes(replace_points(source, data, rows, sequence.positions,
                                              np.where(filled, -1, artefacts.order), unit))
        if joints is not None:
            _add_joints(source or path, beside, joints, subject_prefix, None if source is None else unit)


def _add_joints(name: Path, file: Path, joints: MarkerSequence, subject_prefix: str | None, unit: str | None
                ) -> None:
    """Add joint centres to a C3D file, under the name of the subject if its labels have one."""
    data = file.read_bytes()
    taken = point_table(name, data).labels
    who = (subject_prefix or "").split(",")[0]
    who = who or next((label.rpartition(":")[0] for label in taken if ":" in label), "")
    labels = unlike([f"{who}:{label}" if who else label for label in joints.labels], taken)
    descriptions = [f"joint centre of the model ({label})" for label in joints.labels]
    try:
        file.write_bytes(add_points(name, data, labels, descriptions, joints.positions, unit))
    except MarkerFileError as error:                     # the markers matter more; the joints are in other files too
        say(f"virtual.c3d has no joint centres: {error}")


def artefact_table(artefacts: MarkerArtefacts) -> dict[str, Any]:
    """Return the artefacts as numbers and text for a JSON file: swaps, bad spans, and the number of filled frames.

    Frames count from 0, and both ends belong to a span. Distances are in metres.
    """
    gone = ~artefacts.repaired.seen
    known = [artefacts.repaired.labels.index(label) for label in artefacts.labels]
    return {"rate": artefacts.repaired.rate, "frames": len(gone),
            "exchanges": [{"labels": [s.first, s.second], "begin": s.begin, "end": s.end} for s in artefacts.swaps],
            "bad": [{"label": b.label, "kind": b.kind, "begin": b.begin, "end": b.end, "distance": b.distance}
                    for b in artefacts.bad],
            "filled": {artefacts.repaired.labels[i]: int(gone[:, i].sum()) for i in known if gone[:, i].any()}}
