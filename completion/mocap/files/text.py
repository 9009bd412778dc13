"""Marker sequences as text, TRC and CSV, and what all readers of marker files have in common.

Files are read as programs and spreadsheets write them: lines are counted, whatever the header says, and every
difference becomes a note.
"""
from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from scanprep.geometry import tables
from scanprep.geometry.storage import StorageError
from scanprep.words import number_of, printable

Rows = Sequence[tuple[int, Sequence[str]]]           # number and cells of each line of a table


class MarkerFileError(StorageError):
    """A file of markers or of a layout that cannot be read; the message says which, what was expected and found."""


@dataclass(frozen=True, eq=False)
class RawMarkers:
    """Content of a marker file, in its own unit."""

    positions: np.ndarray            # (T, L, 3) float, NaN where missing
    labels: tuple[str, ...]          # L strings as in the file, made distinct
    rate: float | None               # frames per second, or None where the file does not say
    unit: str                        # as in the file
    notes: tuple[str, ...] = ()      # errors in the file, and how they were resolved


def distinct_labels(labels: Sequence[str], descriptions: Sequence[str] = ()) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Make labels distinct, and return them with a note where some were changed.

    A repeated label is replaced by its description, where programs that cut labels to four letters keep the full name.
    Without a description it becomes LABEL_2, LABEL_3, ...

    Examples
    --------
    >>> distinct_labels(["LKNE", "LKNE", "C7"])[0]
    ('LKNE', 'LKNE_2', 'C7')
    """
    taken, times, out, changed = set(labels), dict[str, int](), list[str](), list[str]()
    for i, label in enumerate(labels):
        name = label
        if label in times:
            # the description, with the prefix of the person, then numbers
            who, colon, _ = label.rpartition(":")
            said = descriptions[i].strip() if i < len(descriptions) else ""
            name = f"{who}{colon}{said}" if said and ":" not in said else label
            while name in taken:
                times[label] += 1
                name = f"{label}_{times[label]}"
            taken.add(name)
            changed.append(f"{label} now {name}")
        times.setdefault(label, 1)
        out.append(name)
    if not changed:
        return tuple(out), ()
    more = f" and {len(changed) - 6} more" if len(changed) > 6 else ""
    return tuple(out), (f"labels come again: {', '.join(changed[:6])}{more}",)


def read_trc(path: Path, data: bytes) -> RawMarkers:
    """Read a TRC file of Motion Analysis or OpenSim; empty cells and NaN are missing.

    The names in line 4 tell the number of markers; trajectories without a name are left out.
    """
    tabs = b"PathFileType\t" in data[:100].replace(b"\0", b"")
    separator, split = tables.table_rows(path, data, MarkerFileError, "\t" if tabs else ",;\t")
    rows = [(number, cells if len(cells) > 1 else cells[0].split()) for number, cells in split]
    if len(rows) < 4 or not rows[0][1][0].startswith("PathFileType"):
        raise MarkerFileError(f"{path}: expected a TRC file that begins with 'PathFileType' and has five lines "
                              f"of header, found {len(rows)} lines, first "
                              f"{' '.join(rows[0][1])[:30] if rows else ''!r}")
    keys, values = ([cell for cell in rows[k][1] if cell] for k in (1, 2))
    # in some files empty cells only separate, in others they stand for a missing value
    said = dict(zip(map(str.lower, keys), values if len(values) == len(keys) else rows[2][1], strict=False))
    try:
        cells = [said.get(key, "") for key in ("datarate", "numframes", "nummarkers")]
        rate, frames, count = (value if np.isfinite(value) else None
                               for value in tables.number_cells(cells, decimal_commas=True))
    except ValueError:
        raise MarkerFileError(f"{path}: line {rows[2][0]}: expected values of DataRate, NumFrames and NumMarkers, "
                              f"found {' '.join(rows[2][1])[:60]!r}") from None
    # the line of names, and the frames below it
    named = next((k for k, (_, cells) in enumerate(rows) if cells[0].lower().startswith("frame")), 3)
    body = rows[named + 1:]
    while body and not re.fullmatch(r"[-+]?\d+([.,]\d*)?(e[-+]?\d+)?", body[0][1][0].strip().lower()):    # X1 Y1 Z1 ...
        body = body[1:]
    if not body:
        raise MarkerFileError(f"{path}: truncated: expected frames below line {rows[named][0]}, found none")
    usual = Counter(len(cells) for _, cells in body).most_common(1)[0][0]
    # the names, and the columns of the trajectories that have one
    columns, names = _find_named_columns(rows[named][1], count, usual)
    if not names:
        raise MarkerFileError(f"{path}: line {rows[named][0]}: expected marker names, found none")
    width, notes = 5 + 3 * max(columns), []
    if usual > width:
        notes.append(f"{number_of(-(-(usual - width) // 3), 'trajectory', 'trajectories')} without a name left out")
        body = [(number, cells[:width]) for number, cells in body]
    table = table_numbers(path, body, width, separator, fill=len(split[-1][1]) > 1)
    if frames is not None and frames != len(table):
        notes.append(f"NumFrames says {frames:g}, there are {len(table)}")
    clocked = even_rate(table[:, 1]) if len(table) > 1 else None
    # 0.02: with a larger relative difference between rate and times, the times are right
    if clocked is not None and (not rate or abs(clocked / rate - 1) > 0.02):
        notes.append(f"DataRate says {rate or 0:g} frames a second, the times {clocked:g}: the times are believed")
        rate = clocked
    labels, twice = distinct_labels(names)
    places = table[:, 2:].reshape(len(table), -1, 3)[:, columns]
    return RawMarkers(places, labels, rate if rate and rate > 0 else None, said.get("units") or "mm",
                      (*notes, *twice))


def _find_named_columns(cells: Sequence[str], count: float | None, usual: int) -> tuple[list[int], list[str]]:
    """Return which trajectories have a name, and their names, from the line with the names.

    `count` is the number in the header, `usual` the number of cells in a line. Names may be separated by blanks.
    """
    in_cells = [(k, name) for k, name in enumerate(cells[2:]) if name]
    text = "  ".join(cells)
    ways = [[name for _, name in in_cells], re.split(r"\s{2,}", text)[2:], text.split()[2:]]
    # the way to split that gives the number of the header, else that fits the cells of a line
    names = next((way for way in ways if len(way) == count), None) \
        or next((way for way in ways if 3 * len(way) + 2 == usual), ways[0])
    if names is ways[0] and all(k % 3 == 0 for k, _ in in_cells):
        return [k // 3 for k, _ in in_cells], names
    return list(range(len(names))), names


def encode_trc(positions: np.ndarray, labels: Sequence[str], rate: float, name: str) -> bytes:
    """Encode positions (T, L, 3), metres, as a TRC file with this name, in millimetres, as OpenSim reads it.

    A missing marker has empty cells. Blanks in labels become `_`, as they separate names there. Lines of numbers end
    with a tab, because OpenSim counts an empty last cell only if a tab follows.
    """
    spelled = [re.sub(r"\s+", "_", label.strip()) or f"marker{i + 1}" for i, label in enumerate(labels)]
    T, L = positions.shape[:2]
    lines = [f"PathFileType\t4\t(X/Y/Z)\t{printable(name)}",
             "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
             f"{rate:.9g}\t{rate:.9g}\t{T}\t{L}\tmm\t{rate:.9g}\t1\t{T}",
             "Frame#\tTime\t" + "\t\t\t".join(spelled) + "\t\t",
             "\t\t" + "\t".join(f"{axis}{i + 1}" for i in range(L) for axis in "XYZ"), ""]
    for t, cells in enumerate(tables.number_lines((1000 * positions).reshape(T, -1), "%.5f", "\t")):
        lines.append(f"{t + 1}\t{t / rate:.9g}\t{cells}\t")
    return ("\n".join(lines) + "\n").encode()


def csv_markers(path: Path, separator: str, rows: Rows) -> RawMarkers:
    """Read markers from a table with the columns `time` or `frame`, then `LABEL_x, LABEL_y, LABEL_z` of every marker.

    Numbers may have decimal commas where semicolons or tabs separate.
    """
    head = rows[0][1] if rows else []
    clock = [word for word in head if word.lower() in ("time", "frame")]
    columns = {word.lower(): i for i, word in enumerate(head)}
    names = [word for word in head if word not in clock]
    labels = tuple(word[:-2] for word in names[::3])
    wanted = [f"{label}_{axis}" for label in labels for axis in "xyz"]
    if not clock or not labels or [n.lower() for n in names] != [w.lower() for w in wanted]:
        raise MarkerFileError(f"{path}: line 1: expected the columns time,LABEL_x,LABEL_y,LABEL_z,..., "
                              f"found {','.join(head)[:80]!r}")
    if not rows[1:]:
        raise MarkerFileError(f"{path}: expected frames below the first line, found none")
    table = table_numbers(path, rows[1:], len(head), separator)
    places = [i for i, word in enumerate(head) if word not in clock]
    rate = None
    # the rate from the times, which must have even steps; name the first line that has not
    if "time" in columns:
        times = table[:, columns["time"]]
        rate = even_rate(times) if len(times) > 1 else 1.0
        if rate is None:
            typical = (times[-1] - times[0]) / (len(times) - 1)
            off = np.flatnonzero(~(np.abs(np.diff(times) - typical) <= 0.5 * typical))
            k = int(off[0]) if len(off) else 0
            raise MarkerFileError(f"{path}: line {rows[1:][k + 1 if len(off) else 0][0]}: expected times in even steps "
                                  f"of {typical:.4g} s, found {times[k + 1]:.6g} s after {times[k]:.6g} s")
    labels, notes = distinct_labels(labels)
    return RawMarkers(table[:, places].reshape(len(table), len(labels), 3), labels, rate, "m", notes)


table_numbers = partial(tables.table_numbers, error=MarkerFileError)


def even_rate(times: np.ndarray) -> float | None:
    """Compute frames per second from times, at least two; None where they are not evenly spaced."""
    typical = (times[-1] - times[0]) / (len(times) - 1)
    even = typical > 0 and (np.abs(np.diff(times) - typical) <= 0.5 * typical).all()
    return round(1 / typical, 6) if even else None


def encode_csv(positions: np.ndarray, labels: Sequence[str], rate: float) -> bytes:
    """Encode positions (T, L, 3), metres, as the CSV that `csv_markers` reads."""
    rows = np.column_stack([np.arange(len(positions)) / rate, positions.reshape(len(positions), -1)])
    header = ["time", *(f"{label}_{axis}" for label in labels for axis in "xyz")]
    return tables.number_table(header, rows, "%.9g").encode()
