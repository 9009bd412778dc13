"""Marker sequences as text, TRC and CSV, and what all readers of marker files share."""
from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scanprep.geometry import tables
from scanprep.geometry.storage import StorageError


class MarkerFileError(StorageError):
    """A file of markers or of a marker layout that cannot be read: which one, what was expected, what came."""


@dataclass(frozen=True, eq=False)
class RawMarkers:
    """What a marker file holds, in its own unit."""

    positions: np.ndarray            # (T, L, 3) float, NaN where missing
    labels: tuple[str, ...]          # L strings, as they stand in the file
    rate: float | None               # frames per second, or None where the file does not say
    unit: str                        # as it stands in the file


def read_trc(path: Path, data: bytes) -> RawMarkers:
    """A TRC file of Motion Analysis or OpenSim: empty cells and NaN are missing."""
    lines = data.decode("latin-1").splitlines()
    if not lines or not lines[0].startswith("PathFileType") or len(lines) < 5:
        raise MarkerFileError(f"{path}: expected a TRC file that begins with 'PathFileType' and has five lines "
                              f"of header, found {len(lines)} lines, first {lines[0][:30] if lines else ''!r}")
    keys, values = lines[1].split(), lines[2].split()
    said = dict(zip(keys, values, strict=False))
    try:
        rate, frames, count = float(said["DataRate"]), int(said["NumFrames"]), int(said["NumMarkers"])
    except (KeyError, ValueError):
        raise MarkerFileError(f"{path}: line 3: expected values of DataRate, NumFrames and NumMarkers, "
                              f"found {lines[2][:60]!r}") from None
    labels = tuple(word.strip() for word in lines[3].split("\t")[2:] if word.strip())
    if len(labels) != count:
        labels = tuple(lines[3].split()[2:])
    if len(labels) != count or not count:
        raise MarkerFileError(f"{path}: line 4: expected {count or 'some'} marker names, found {len(labels)}")
    rows = [(number, line) for number, line in enumerate(lines[5:], 6) if line.strip()]
    if len(rows) != frames:
        raise MarkerFileError(f"{path}: {'truncated: ' if len(rows) < frames else ''}expected {frames} frames, "
                              f"found {len(rows)}")
    width = 2 + 3 * count
    table = np.empty((frames, width))
    for place, (number, line) in zip(table, rows, strict=True):
        cells = line.rstrip("\r\n").split("\t") if "\t" in line else line.split()
        while len(cells) > width and not cells[-1].strip():
            cells.pop()                                  # tabs at the end of the line
        if "\t" in line:
            cells += [""] * (width - len(cells))         # or too few of them where the last markers are missing
        place[:] = _numbers(path, number, cells, width)
    return RawMarkers(table[:, 2:].reshape(frames, count, 3), labels, rate, said.get("Units", "mm").lower())


def encode_trc(positions: np.ndarray, labels: Sequence[str], rate: float, name: str) -> bytes:
    """Positions (T, L, 3), metres, as a TRC file of this name, in millimetres, as OpenSim reads it.

    A missing marker has empty cells; a label has `_` for blanks, which separate there. Lines of numbers end in a tab:
    OpenSim counts an empty last cell only if there is one behind it.
    """
    spelled = [re.sub(r"\s+", "_", label.strip()) or f"marker{i + 1}" for i, label in enumerate(labels)]
    T, L = positions.shape[:2]
    lines = [f"PathFileType\t4\t(X/Y/Z)\t{name}",
             "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
             f"{rate:.9g}\t{rate:.9g}\t{T}\t{L}\tmm\t{rate:.9g}\t1\t{T}",
             "Frame#\tTime\t" + "\t\t\t".join(spelled) + "\t\t",
             "\t\t" + "\t".join(f"{axis}{i + 1}" for i in range(L) for axis in "XYZ"), ""]
    for t, cells in enumerate(tables.number_lines((1000 * positions).reshape(T, -1), "%.5f", "\t")):
        lines.append(f"{t + 1}\t{t / rate:.9g}\t{cells}\t")
    return ("\n".join(lines) + "\n").encode()


def read_csv(path: Path, data: bytes) -> RawMarkers:
    """A CSV file with the columns `time` or `frame`, then `LABEL_x, LABEL_y, LABEL_z` of every marker.

    Where semicolons or tabs separate, numbers may have decimal commas.
    """
    separator, rows = tables.table_rows(path, data, MarkerFileError)
    head = rows[0][1] if rows else []
    clock = [word for word in head if word.lower() in ("time", "frame")]
    columns = {word.lower(): i for i, word in enumerate(head)}
    names = [word for word in head if word not in clock]
    labels = tuple(word[:-2] for word in names[::3])
    wanted = [f"{label}_{axis}" for label in labels for axis in "xyz"]
    if not clock or not labels or [n.lower() for n in names] != [w.lower() for w in wanted]:
        raise MarkerFileError(f"{path}: line 1: expected the columns time,LABEL_x,LABEL_y,LABEL_z,..., "
                              f"found {','.join(head)[:80]!r}")
    body = rows[1:] if separator == "," else [(n, [cell.replace(",", ".") for cell in row]) for n, row in rows[1:]]
    if not body:
        raise MarkerFileError(f"{path}: expected frames below the first line, found none")
    table = np.array([_numbers(path, number, row, len(head)) for number, row in body])
    places = [i for i, word in enumerate(head) if word not in clock]
    rate = _rate(path, table[:, columns["time"]], [n for n, _ in body]) if "time" in columns else None
    return RawMarkers(table[:, places].reshape(len(table), len(labels), 3), labels, rate, "m")


def _numbers(path: Path, number: int, cells: Sequence[str], width: int) -> list[float]:
    """The numbers of one line, NaN for an empty cell."""
    if len(cells) != width:
        raise MarkerFileError(f"{path}: line {number}: expected {width} values, found {len(cells)}")
    try:
        return [float(cell) if cell.strip() else np.nan for cell in cells]
    except ValueError as error:
        raise MarkerFileError(f"{path}: line {number}: expected numbers, {error}") from None


def _rate(path: Path, times: np.ndarray, numbers: Sequence[int]) -> float | None:
    """Frames per second of evenly spaced times; None for a single frame."""
    if len(times) < 2:
        return 1.0
    steps = np.diff(times)
    typical = (times[-1] - times[0]) / (len(times) - 1)
    off = np.flatnonzero(~(np.abs(steps - typical) <= 0.5 * typical))
    if len(off) or not typical > 0:
        where = numbers[int(off[0]) + 1] if len(off) else numbers[0]
        raise MarkerFileError(f"{path}: line {where}: expected times in even steps of {typical:.4g} s, "
                              f"found {times[off[0] + 1] if len(off) else times[0]:.6g} s "
                              f"after {times[off[0]] if len(off) else times[0]:.6g} s")
    return round(1 / typical, 6)


def encode_csv(positions: np.ndarray, labels: Sequence[str], rate: float) -> bytes:
    """Positions (T, L, 3), metres, as the CSV that `read_csv` reads."""
    rows = np.column_stack([np.arange(len(positions)) / rate, positions.reshape(len(positions), -1)])
    header = ["time", *(f"{label}_{axis}" for label in labels for axis in "xyz")]
    return tables.number_table(header, rows, "%.9g").encode()
