"""Tables of markers as camera systems export them: CSV of Motive, TSV of Qualisys; and files that are none."""
from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from model.motion.files import OTHER_MOTIONS
from scanprep.geometry import tables

from .text import MarkerFileError, RawMarkers, Rows, csv_markers, distinct_labels, even_rate, table_numbers

# Files of other programs, by their ending, and what to export there instead.
OTHERS = {**OTHER_MOTIONS, ".qtm": "a project file of Qualisys Track Manager: export C3D or TSV there",
          ".tak": "a take of Motive: export C3D or CSV there"}


def read_marker_table(path: Path, data: bytes) -> RawMarkers:
    """Read markers from CSV or TSV: our own, of Motive or of Qualisys Track Manager."""
    separator, rows = tables.table_rows(path, data, MarkerFileError)
    first = rows[0][1][0] if rows else ""
    if first == "Format Version":
        return _motive(path, separator, rows)
    if first in ("NO_OF_FRAMES", "FILE_VERSION"):
        return _qualisys(path, rows)
    if first in ("Trajectories", "Model Outputs", "Devices"):
        raise MarkerFileError(f"{path}: a table of Vicon Nexus, whose columns differ from pipeline to pipeline; "
                              "export C3D there")
    return csv_markers(path, separator, rows)


def _motive(path: Path, separator: str, rows: Rows) -> RawMarkers:
    """Read a CSV of Motive: keys and values in the first line, then lines with kind, name and axis of the columns.

    Solved points of rigid bodies and bones stand beside the measured markers; only the markers are read.
    """
    # header lines by their name, and the line with the axes, below which the frames begin
    header = dict(zip(rows[0][1][::2], rows[0][1][1::2], strict=False))
    heads = {cells[1]: cells for _, cells in rows[1:9] if len(cells) > 2 and not cells[0]}
    axes = next((k for k, (_, cells) in enumerate(rows[:10]) if cells[0] == "Frame"), 0)
    if not axes or not {"Type", "Name"} <= heads.keys():
        raise MarkerFileError(f"{path}: expected a CSV of Motive with the lines Type, Name and Frame,Time; export it "
                              "with the option 'Header Information', or C3D")
    # the x columns of markers; y and z follow
    kinds = rows[axes - 1][1]
    columns = [k for k, (kind, axis) in enumerate(zip(heads["Type"], rows[axes][1], strict=False))
               if kind == "Marker" and axis == "X" and (k >= len(kinds) or kinds[k] == "Position")]
    if not columns:
        raise MarkerFileError(f"{path}: expected columns of the type Marker, the CSV of Motive has "
                              f"{', '.join(sorted({*heads['Type'][2:]} - {''}))[:80]}; export it with the option "
                              "'Markers', or BVH")
    body = rows[axes + 1:]
    table = table_numbers(path, body, len(rows[axes][1]), separator, fill=True)
    labels, notes = distinct_labels([heads["Name"][k] for k in columns])
    # the rate of the header, else that of the times
    rate = tables.number_cells([header.get("Export Frame Rate", header.get("Capture Frame Rate", ""))])[0]
    clocked = even_rate(table[:, 1]) if len(table) > 1 else None
    places = np.stack([table[:, k:k + 3] for k in columns], axis=1)
    return RawMarkers(places, labels, rate if rate > 0 else clocked, header.get("Length Units") or "m", notes)


def _qualisys(path: Path, rows: Rows) -> RawMarkers:
    """Read a TSV of Qualisys: lines of keys, MARKER_NAMES has the labels, then the frames, in millimetres."""
    start = next((k for k, (_, cells) in enumerate(rows) if not re.fullmatch("[A-Z_]{4,}|Frame|Time", cells[0])),
                 len(rows))
    header = {cells[0]: cells[1:] for _, cells in rows[:start]}
    names = [name for name in header.get("MARKER_NAMES", ()) if name]
    kind = " ".join(header.get("DATA_INCLUDED", ["3D"]))
    if not names or kind != "3D":
        raise MarkerFileError(f"{path}: expected a TSV of 3D data from Qualisys Track Manager, with MARKER_NAMES, "
                              f"found {kind} data; export 3D data, or C3D")
    if start == len(rows):
        raise MarkerFileError(f"{path}: expected frames below the names of the markers, found none")
    clock = 2 if rows[start - 1][1][0] == "Frame" else 0
    # a frame without markers may be a line without numbers, which is not among the rows
    at = np.array([number for number, _ in rows[start:]]) - rows[start][0]
    table = np.full((at[-1] + 1, clock + 3 * len(names)), np.nan)
    table[at] = table_numbers(path, rows[start:], table.shape[1], "\t", fill=True)
    labels, notes = distinct_labels(names)
    rate = tables.number_cells([*header.get("FREQUENCY", ()), ""], decimal_commas=True)[0]
    count = tables.number_cells([*header.get("NO_OF_FRAMES", ()), ""])[0]
    if count != len(table):
        notes = (*notes, f"NO_OF_FRAMES says {count:g}, there are {len(table)}")
    return RawMarkers(table[:, clock:].reshape(len(table), -1, 3), labels, rate if rate > 0 else None, "mm", notes)
