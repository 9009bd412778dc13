"""The table of labels: a row for each stretch of a track with one label, which the user can correct and return."""
from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from scanprep.geometry import tables
from scanprep.geometry.storage import StorageError

from .label import GHOST, UNKNOWN

COLUMNS = ("track", "point", "begin", "end", "label", "confidence", "fixed")


def write_labels(path: Path, points: Sequence[str], tracks: np.ndarray, rows: np.ndarray, names: Sequence[str],
                 confidence: np.ndarray, fixed: np.ndarray) -> None:
    """Write a table of the labels of all tracks, a row for each stretch, the least confident first.

    Parameters
    ----------
    path : Path
        CSV file to write.
    points : C strings
        Names of the columns of the recording.
    tracks : (T, C) int
        The track of each point, -1 without one.
    rows : (T, C) int
        The marker that each point is, -1 for none.
    names : strings
        Labels of the markers.
    confidence : (T, C) float
        Of each label.
    fixed : (T, C) bool
        Labels that were known.
    """
    # all points, sorted by track and frame, and cut where track, label or `fixed` changes
    frames, columns = np.nonzero(tracks >= 0)
    number, label = tracks[frames, columns], rows[frames, columns]
    order = np.lexsort((frames, number))
    frames, columns, number, label = frames[order], columns[order], number[order], label[order]
    certain, known = confidence[frames, columns], fixed[frames, columns]
    edges = np.flatnonzero((np.diff(number) != 0) | (np.diff(label) != 0) | (np.diff(known.astype(int)) != 0)) + 1
    out = []
    for stretch in np.split(np.arange(len(frames)), edges):
        if not len(stretch):
            continue
        row, first, last = int(label[stretch[0]]), stretch[0], stretch[-1]
        out.append((int(number[first]), points[columns[first]], int(frames[first]), int(frames[last]),
                    names[row] if row >= 0 else "", round(float(certain[stretch].mean()), 3) if row >= 0 else "",
                    "yes" if known[first] else ""))
    out.sort(key=lambda each: (each[5] == "", each[5] if each[5] != "" else 0.0, each[0], each[2]))
    tables.write_table(path, COLUMNS, out)


def read_corrections(path: Path, tracks: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """Read the known labels (T, C) from the `fixed` rows of a table of labels, as `label_markers` takes them.

    Parameters
    ----------
    path : Path
        File of `write_labels`, with changed labels and `yes` in the column `fixed`.
    tracks : (T, C) int
        Those of the same recording.
    names : strings
        Labels of the markers.

    Raises
    ------
    StorageError
        A row that is not of this recording, an unknown label, two labels for one point.
    """
    known = np.full(tracks.shape, UNKNOWN)
    for line, row in tables.read_table(path, COLUMNS, ("track", "begin", "end", "label", "fixed")):
        said = row["fixed"].strip().lower()
        if said not in ("yes", "y", "x", "1", "true"):
            if said not in ("", "no", "n", "0", "false"):
                raise StorageError(f"{path}: line {line}: expected yes or nothing in the column fixed, found '{said}'")
            continue
        try:
            track, begin, end = (int(row[name]) for name in ("track", "begin", "end"))
        except ValueError:
            raise StorageError(f"{path}: line {line}: expected whole numbers for track, begin and end, found "
                               f"'{row['track']}', '{row['begin']}', '{row['end']}'") from None
        label = row["label"].strip()
        if label and label not in names:
            raise StorageError(f"{path}: line {line}: expected a label of the layout or nothing, found '{label}'; it "
                               f"has {', '.join(names)}")
        # the frames have to be those of the track
        here = tracks == track
        frames = np.flatnonzero(here.any(axis=1))
        if not {begin, end} <= set(frames.tolist()) or begin > end:
            there = f"has it in {frames[0]} to {frames[-1]}" if len(frames) else "has no such track"
            raise StorageError(f"{path}: line {line}: expected frames of track {track} in {begin} to {end}; this "
                               f"recording {there}: was the table made from another?")
        here[:begin], here[end + 1:] = False, False
        meant = names.index(label) if label else GHOST
        if not np.isin(known[here], (UNKNOWN, meant)).all():
            raise StorageError(f"{path}: line {line}: expected one label for track {track} in {begin} to {end}, an "
                               "earlier line has fixed another")
        known[here] = meant
    # a label may occur only once in a frame
    for marker, name in enumerate(names):
        twice = np.flatnonzero((known == marker).sum(axis=1) > 1)
        if len(twice):
            raise StorageError(f"{path}: expected each label once in a frame, {name} is fixed for two points in "
                               f"frame {twice[0]}")
    return known
