"""Write landmark files of other programs; `landmark_reading` reads more of them."""
from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Literal
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from ..words import printable
from .format_common import UNITS
from .tables import csv_text

Points = Mapping[str, np.ndarray]
Format = Literal["json", "csv", "pp", "mrk.json"]


CLICKED_JOINTS = ".features.json"    # ending of the joints clicked in a scan; no command takes them for its landmarks


def landmark_ending(format: Format) -> str:
    """Return the ending of a landmark file by which `landmarks_beside` finds it.

    Examples
    --------
    >>> landmark_ending("pp"), landmark_ending("json")
    ('.pp', '.landmarks.json')
    """
    return (".landmarks." if format in ("json", "csv") else ".") + format


def is_written(file: Path) -> bool:
    """Return whether landmarks can be written in the format of a file name; others are only read.

    Examples
    --------
    >>> is_written(Path("anna.pp")), is_written(Path("anna.lnd"))
    (True, False)
    """
    name = file.name.lower()
    return name.endswith((".json", *_WRITERS)) and not name.endswith(".scalismo.json")


def encode_landmarks(file: Path, points: Points, unit: str | None) -> bytes | None:
    """Encode points (3,), metres, in the format of a file name; None for our JSON.

    `unit` is that of the coordinates in the file, by default the one that `read_landmarks` expects. ValueError for a
    format that is not written, or a landmark name that it cannot hold.
    """
    if not is_written(file):
        raise ValueError(f"{file}: expected a name ending in .json, {', '.join(_WRITERS)}; landmarks are written as "
                         "JSON, CSV, and for MeshLab and 3D Slicer")
    writer = next((_WRITERS[ending] for ending in _WRITERS if file.name.lower().endswith(ending)), None)
    return None if writer is None else writer(points, unit).encode("utf-8")


def _meshlab(points: Points, unit: str | None) -> str:
    """Encode MeshLab's PickPoints."""
    rows = "".join(f' <point x="{x:.12g}" y="{y:.12g}" z="{z:.12g}" active="1" name={quoteattr(name)}/>\n'
                   for name, (x, y, z) in _as_xml(points, unit or "m"))
    return f"<!DOCTYPE PickedPoints>\n<PickedPoints>\n{rows}</PickedPoints>\n"


def _slicer(points: Points, unit: str | None) -> str:
    """Encode a markups file of 3D Slicer, in its LPS frame."""
    controls = [{"id": str(i + 1), "label": name, "position": point.tolist(), "positionStatus": "defined"}
                for i, (name, point) in enumerate(_in_unit(points, unit or "mm"))]
    return json.dumps({"markups": [{"type": "Fiducial", "coordinateSystem": "LPS", "coordinateUnits": unit or "mm",
                                    "controlPoints": controls}]}, indent=1)


def _table(points: Points, unit: str | None) -> str:
    """Encode a CSV table."""
    return csv_text([("name", "x", "y", "z"), *((name, *point) for name, point in _as_text(points, unit or "m"))])


def marker_set(markers: Mapping[str, tuple[str, np.ndarray]]) -> str:
    """Encode a marker set of OpenSim 4: name -> path of the frame, as `/bodyset/pelvis`, and position (3,), metres."""
    rows = "".join(
        f"   <Marker name={quoteattr(_visible(name))}>\n"
        f"    <socket_parent_frame>{escape(frame)}</socket_parent_frame>\n"
        f"    <location>{' '.join(map(repr, map(float, place)))}</location>\n    <fixed>false</fixed>\n   </Marker>\n"
        for name, (frame, place) in markers.items())
    return ('<?xml version="1.0" encoding="UTF-8" ?>\n'
            '<OpenSimDocument Version="40000">\n <MarkerSet name="markerset">\n'
            f"  <objects>\n{rows}  </objects>\n  <groups />\n </MarkerSet>\n</OpenSimDocument>\n")


_NOT_XML = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]")


def _as_xml(points: Points, unit: str) -> list[tuple[str, np.ndarray]]:
    """Return names that XML can hold, and points; ValueError for other names."""
    if wrong := next((name for name in points if _NOT_XML.search(name)), None):
        raise ValueError(f"landmarks: {wrong!a} cannot be the name of a landmark in XML; write JSON")
    return _in_unit(points, unit)


def _visible(name: str) -> str:
    """Write what XML cannot hold as `\\x07`."""
    return _NOT_XML.sub(lambda sign: printable(sign[0]), name)


def _as_text(points: Points, unit: str) -> list[tuple[str, list[str]]]:
    """Return names that fit into a table, and coordinates without loss; ValueError for other names."""
    wrong = next((name for name in points if name.splitlines() != [name] or name.strip() != name or "#" in name), None)
    if wrong is not None:
        raise ValueError(f"landmarks: '{wrong}' cannot be the name of a landmark in a file of lines; write JSON")
    return [(name, [repr(float(value)) for value in point]) for name, point in _in_unit(points, unit)]


def _in_unit(points: Points, unit: str) -> list[tuple[str, np.ndarray]]:
    """Convert points from metres to a unit."""
    return [(name, np.asarray(point, dtype=float) / UNITS[unit]) for name, point in points.items()]


_WRITERS: dict[str, Callable[[Points, str | None], str]] = {
    ".csv": _table, ".pp": _meshlab, ".mrk.json": _slicer}
