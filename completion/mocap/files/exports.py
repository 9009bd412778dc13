"""Tables of markers as the programs of camera systems export them: Motive's CSV, Qualisys' TSV; and what is none."""
from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from model.motion.files import OTHER_MOTIONS
from scanprep.geometry import tables

from .text import MarkerFileError, RawMarkers, Rows, csv_markers, distinct_labels, even_rate, table_numbers

# What a file of another program is, by its ending, and what to export there in its place.
OTHERS = {**OTHER_MOTIONS, ".qtm": "a project file of Qualisys Track Manager: export C3D or TSV there",
          ".tak": "a take of Motive: export C3D or CSV there"}


def read_marker_table(path: Path, data: bytes) -> RawMarkers:
    """Markers in a CSV or TSV file, of ours, of Motive or of Qualisys Track Manager."""
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
    """Motive's CSV: keys and values in the first line, then a line each for the kind, name and axis of the columns.

    The solved points of rigid bodies and bones lie beside the measured ones; only these are taken.
    """
    said = dict(zip(rows[0][1][::2], rows[0][1][1::2], strict=False))
    heads = {cells[1]: cells for _, cells in rows[1:9] if len(cells) > 2 and not cells[0]}
    axes = next((k for k, (_, cells) in enumerate(rows[:10]) if cells[0] == "Frame"), 0)
    if not axes or not {"Type", "Name"} <= heads.keys():
        raise MarkerFileError(f"{path}: expected a CSV of Motive with the lines Type, Name and Frame,Time; export it "
                              "with the option 'Header Information', or C3D")
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
    rate = tables.number_cells([said.get("Export Frame Rate", said.get("Capture Frame Rate", ""))])[0]
    clocked = even_rate(table[:, 1]) if len(table) > 1 else None
    places = np.stack([table[:, k:k + 3] for k in columns], axis=1)
    return RawMarkers(places, labels, rate if rate > 0 else clocked, said.get("Length Units") or "m", notes)


def _qualisys(path: Path, rows: Rows) -> RawMarkers:
    """Qualisys' TSV: a line for each key, of which MARKER_NAMES has the labels, then the frames, in millimetres."""
    start = next((k for k, (_, cells) in enumerate(rows) if not re.fullmatch("[A-Z_]{4,}|Frame|Time", cells[0])),
                 len(rows))
    said = {cells[0]: cells[1:] for _, cells in rows[:start]}
    names = [name for name in said.get("MARKER_NAMES", ()) if name]
    kind = " ".join(said.get("DATA_INCLUDED", ["3D"]))
    if not names or kind != "3D":
        raise MarkerFileError(f"{path}: expected a TSV of 3D data from Qualisys Track Manager, with MARKER_NAMES, "
                              f"found {kind} data; export 3D data, or C3D")
    if start == len(rows):
        raise MarkerFileError(f"{path}: expected frames below the names of the markers, found none")
    clock = 2 if rows[start - 1][1][0] == "Frame" else 0
    # a frame in which nothing was seen may be a line without a number, which is not among the rows
    at = np.array([number for number, _ in rows[start:]]) - rows[start][0]
    table = np.full((at[-1] + 1, clock + 3 * len(names)), np.nan)
    table[at] = table_numbers(path, rows[start:], table.shape[1], "\t", fill=True)
    labels, notes = distinct_labels(names)
    rate = tables.number_cells([*said.get("FREQUENCY", ()), ""], decimal_commas=True)[0]
    count = tables.number_cells([*said.get("NO_OF_FRAMES", ()), ""])[0]
    if count != len(table):
        notes = (*notes, f"NO_OF_FRAMES says {count:g}, there are {len(table)}")
    return RawMarkers(table[:, clock:].reshape(len(table), -1, 3), labels, rate if rate > 0 else None, "mm", notes)
