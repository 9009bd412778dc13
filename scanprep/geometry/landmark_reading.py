"""Read landmark files of other programs; `landmark_writing` writes some of them."""
from __future__ import annotations

import csv
import json
import re
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from . import storage
from .format_common import UNITS, Lines, MeshFileError, quote
from .tables import text_of_cell

Entry = np.ndarray | int | dict[str, Any]        # point, vertex, or face with barycentric coordinates
_Points = list[tuple[str, np.ndarray]]


class LandmarkFile(NamedTuple):
    """The contents of a landmark file, in its order."""

    pairs: list[tuple[str, Entry]]
    unit: str | None = None                      # of the points, if the format or the file says
    flipped: bool = False                        # x and y may have the other sign: 3D Slicer has LPS and RAS


def entries_of(path: Path, data: bytes, unit: str | None) -> LandmarkFile:
    """Read the landmarks of a file, in the format of its ending; `unit` is the one that the caller gave.

    MeshFileError names the bad line or element.
    """
    suffix = path.suffix.lower()
    if suffix not in (".json", ".pp", ".xml") and b"\0" in data:
        raise MeshFileError(f"{path}: expected landmarks as text, found a binary file")
    with storage.taking_apart(path, "landmarks", MeshFileError):
        if suffix == ".json":
            return _json(path, data, unit)
        if suffix == ".fcsv":
            return _fiducials(path, data)
        if suffix == ".pp":
            return LandmarkFile([*_meshlab(path, data)])
        if suffix == ".xml":
            return LandmarkFile([*_marker_set(path, data)], "m")
        if suffix == ".csv":
            return LandmarkFile([*_table(Lines(path, data, comment=b"#"))])
        if suffix == ".lnd":
            # columns: number, two codes, distance from the axis, x, y, z, name; headings are `KEY = value`
            expected = "a line of a CAESAR .lnd file, seven numbers and a name"
            return LandmarkFile(_rows_with_names(Lines(path, data), 7, expected, "latin-1", b"="), "mm")
        return LandmarkFile(_rows_with_names(Lines(path, data, comment=b"#"), 3, "'x y z name'", "utf-8"))


def _json(path: Path, data: bytes, unit: str | None) -> LandmarkFile:
    """Read JSON: our format, scalismo's, or a markups file of 3D Slicer."""
    tree = storage.parse_json(path, data, "landmarks", MeshFileError, nan=True)      # refused later, by name
    if isinstance(tree, list) and all(isinstance(one, dict) and "id" in one for one in tree):
        return LandmarkFile([(str(one["id"]), _point(path, str(one["id"]), one.get("coordinates"))) for one in tree])
    if not isinstance(tree, dict):
        raise MeshFileError(f"{path}: expected landmarks in JSON {{name: [x, y, z]}}, found a {type(tree).__name__}")
    if isinstance(tree.get("markups"), list):
        return _slicer(path, tree["markups"], unit)
    return LandmarkFile([(name, _json_entry(path, name, value)) for name, value in tree.items()])


def _json_entry(path: Path, name: str, value: Any) -> Entry:
    """Read one entry of our JSON: a point, a vertex, or a point of a face."""
    if isinstance(value, int) and not isinstance(value, bool):
        return value
    if isinstance(value, dict) and isinstance(value.get("face"), int) \
            and not isinstance(value["face"], bool):
        bary = _numbers(value.get("bary"))
        if bary is not None and abs(bary.sum() - 1) < 1e-3:
            return {"face": value["face"], "bary": bary / bary.sum()}
    return _point(path, name, value)


def _point(path: Path, name: str, value: Any) -> np.ndarray:
    """Read a point (3,); MeshFileError for anything else."""
    point = _numbers(value)
    if point is None:
        raise MeshFileError(f"{path}: landmark '{name}': expected [x, y, z], a vertex or "
                            f'{{"face": f, "bary": [a, b, c]}}, found {quote(json.dumps(value))}')
    return point


def _numbers(value: Any) -> np.ndarray | None:
    """Return three numbers as an array (3,), or None."""
    try:
        point = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
    return point if point.shape == (3,) else None


def _slicer(path: Path, markups: list[Any], unit: str | None) -> LandmarkFile:
    """Read the points of a markups file, in LPS."""
    pairs: list[tuple[str, Entry]] = []
    own_unit: Any = "mm"
    with storage.taking_apart(path, "a markups file of 3D Slicer", MeshFileError):
        for markup in markups:
            units = markup.get("coordinateUnits", "mm")
            own_unit = units[0] if isinstance(units, list) else units
            signs = {"LPS": (1, 1, 1), "RAS": (-1, -1, 1)}[markup.get("coordinateSystem", "LPS")]
            for i, point in enumerate(markup["controlPoints"]):
                if point.get("positionStatus", "defined") == "defined":
                    name = point.get("label", i)
                    if not isinstance(name, str | int):
                        raise ValueError(f"point {i} has a label that is no text")
                    position = _numbers(point["position"])
                    if position is None:
                        raise ValueError(f"point {i} has a position that is no [x, y, z]")
                    pairs.append((str(name), position * signs))
    if str(own_unit) not in UNITS and unit is None:
        raise MeshFileError(f"{path}: expected coordinateUnits of {', '.join(UNITS)}, found {own_unit!r}")
    return LandmarkFile(pairs, own_unit, flipped=True)


def _fiducials(path: Path, data: bytes) -> LandmarkFile:
    """Read the points of an .fcsv file of 3D Slicer, in LPS; a file that does not name its axes is RAS."""
    heading = [line.lstrip(b"# ").strip() for line in data.splitlines() if line.startswith(b"#")]
    stated = [line.split(b"=")[1].strip() for line in heading if re.match(rb"(?i)coordinatesystem *=", line)]
    signs = {b"0": (-1, -1, 1), b"RAS": (-1, -1, 1), b"1": (1, 1, 1), b"LPS": (1, 1, 1)}.get(*stated or [b"RAS"])
    if signs is None:
        raise MeshFileError(f"{path}: expected CoordinateSystem = LPS or RAS (1 or 0), found {quote(stated[0])}")
    columns = next((line.split(b"=")[-1].strip().decode().split(",") for line in heading if b",x,y,z," in line), None)
    if columns is None:
        raise MeshFileError(f"{path}: expected a line '# columns = id,x,y,z,...' of 3D Slicer, found none")
    pairs: _Points = []
    lines = Lines(path, b"\n".join(b"" if line.startswith(b"#") else line for line in data.splitlines()))
    for row in range(len(lines)):
        words = _cells(lines, row, ",")
        # 3D Slicer 5 adds a status column: 2 for a placed point
        if len(words) > len(columns) and words[len(columns)] != "2":
            continue
        pairs.append(_point_of_row(lines, row, dict(zip(columns, words, strict=False)), "label", ",".join(columns)))
    return LandmarkFile([(name, point * signs) for name, point in pairs], "mm", flipped=True)


def _meshlab(path: Path, data: bytes) -> _Points:
    """Read the points of MeshLab's PickPoints; inactive ones were not picked and are left out."""
    pairs = []
    with storage.taking_apart(path, "picked points of MeshLab with x, y, z and name", MeshFileError):
        for i, point in enumerate(ElementTree.fromstring(data).iter("point"), 1):
            if point.attrib.get("active", "1") == "0":
                continue
            lacking = [name for name in ("x", "y", "z", "name") if name not in point.attrib]
            if lacking:
                raise ValueError(f"point {i} has no {lacking[0]}")
            place = _numbers([point.attrib[axis] for axis in "xyz"])
            if place is None:
                raise ValueError(f"point {i}, {quote(point.attrib['name'])}, lies at no numbers")
            pairs.append((point.attrib["name"], place))
    return pairs


def _marker_set(path: Path, data: bytes) -> _Points:
    """Read the markers of OpenSim; all must be in one frame, as other frames need its model."""
    markers = read_marker_set(path, data)
    frames = {frame: name for name, (frame, _) in reversed(markers.items())}
    if len(frames) > 1:
        (one, a), (other, b), *_ = sorted(frames.items())
        raise MeshFileError(f"{path}: expected markers in one frame, found '{a}' on {one} and '{b}' on {other}: where "
                            "these are OpenSim's model tells; write the markers of a pose from there, as TRC")
    return [(name, place) for name, (_, place) in markers.items()]


def read_marker_set(path: Path, data: bytes) -> dict[str, tuple[str, np.ndarray]]:
    """Read an OpenSim marker set: name -> frame or body, and position (3,) in it, metres. MeshFileError if damaged."""
    markers: dict[str, tuple[str, np.ndarray]] = {}
    with storage.taking_apart(path, "a MarkerSet of OpenSim", MeshFileError):
        for i, marker in enumerate(ElementTree.fromstring(data).iter("Marker"), 1):
            name = marker.get("name", "")
            frame = marker.findtext("socket_parent_frame") or marker.findtext("body")       # of version 4, and before
            place = _numbers((marker.findtext("location") or "").split())
            if not name or frame is None or place is None:
                lacking = "name" if not name else "socket_parent_frame or body" if frame is None else "location x y z"
                raise ValueError(f"marker {i} {quote(name)} has no {lacking}")
            if name in markers:
                raise MeshFileError(f"{path}: landmark '{name}' comes twice")
            markers[name] = frame.strip().rpartition("/")[2], place
    return markers


def _table(lines: Lines) -> _Points:
    """Read rows below a heading with name (or label, landmark, id), x, y and z among its columns."""
    if not len(lines):
        return []
    mark = max(",;\t", key=lambda sign: lines.text[0].count(sign.encode()))
    columns = [word.lower() for word in _cells(lines, 0, mark)]
    name = next((word for word in ("name", "label", "landmark", "id") if word in columns), None)
    if name is None or not {"x", "y", "z"} <= {*columns}:
        raise lines.fail(0, "a heading with name, x, y, z")
    return [_point_of_row(lines, row, dict(zip(columns, _cells(lines, row, mark), strict=False)), name,
                          mark.join(columns)) for row in range(1, len(lines))]


def _cells(lines: Lines, row: int, mark: str) -> list[str]:
    """Split a row of a table into cells."""
    try:
        text = lines.text[row].decode("utf-8-sig")
        return [text_of_cell(word.strip()) for word in next(csv.reader([text], delimiter=mark, strict=True))]
    except (csv.Error, UnicodeDecodeError, StopIteration):
        raise lines.fail(row, f"text in columns, parted by {mark!r}") from None


def _point_of_row(lines: Lines, row: int, cells: dict[str, str], name: str, expected: str) -> tuple[str, np.ndarray]:
    """Return name and point of a row; MeshFileError for a bad row."""
    point = _numbers([cells.get(axis) for axis in "xyz"])
    if point is None or not cells.get(name) or not np.isfinite(point).all():
        raise lines.fail(row, expected)
    return cells[name], point


def _rows_with_names(lines: Lines, count: int, expected: str, encoding: str, heading: bytes | None = None
                ) -> list[tuple[str, Entry]]:
    """Read lines of `count` numbers, the last three x, y, z, and a name; lines with `heading` are skipped."""
    pairs: list[tuple[str, Entry]] = []
    for row, line in enumerate(lines.text):
        if heading is not None and heading in line:
            continue
        words = line.split(None, count)
        try:
            numbers = [float(word) for word in words[:count]]
            pairs.append((b" ".join(words[count].split()).decode(encoding), np.array(numbers[-3:])))
        except (ValueError, IndexError):
            raise lines.fail(row, expected) from None
    return pairs
