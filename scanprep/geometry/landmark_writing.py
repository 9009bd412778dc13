"""Landmarks in the files of other programs; the counterpart of what `landmarks.py` reads."""
from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from xml.sax.saxutils import quoteattr

import numpy as np

from .format_common import UNITS

Points = Mapping[str, np.ndarray]


def as_bytes(name: str, points: Points, unit: str | None) -> bytes | None:
    """The contents of a file of this name with points (3,), metres; None for JSON of ours.

    `unit` is that of the coordinates in the file; without one it is that which `read_landmarks` expects. ValueError for
    a name of a landmark that the format cannot hold.
    """
    ending = next((ending for ending in _WRITERS if name.lower().endswith(ending)), None)
    if ending is None:
        return None
    return _WRITERS[ending](points, unit).encode("latin-1" if ending == ".lnd" else "utf-8")


def _picked_points(points: Points, unit: str | None) -> str:
    """MeshLab's PickPoints."""
    rows = "".join(f' <point x="{x:.9g}" y="{y:.9g}" z="{z:.9g}" active="1" name={quoteattr(name)}/>\n'
                   for name, (x, y, z) in _scaled(points, unit or "m"))
    return f"<!DOCTYPE PickedPoints>\n<PickedPoints>\n{rows}</PickedPoints>\n"


def _slicer(points: Points, unit: str | None) -> str:
    """A markups file of 3D Slicer, in its LPS frame."""
    controls = [{"id": str(i + 1), "label": name, "position": point.tolist(), "positionStatus": "defined"}
                for i, (name, point) in enumerate(_scaled(points, unit or "mm"))]
    return json.dumps({"markups": [{"type": "Fiducial", "coordinateSystem": "LPS", "coordinateUnits": unit or "mm",
                                    "controlPoints": controls}]}, indent=1)


def _caesar(points: Points, unit: str | None) -> str:
    """CAESAR's .lnd: number, two codes, distance from the axis, x, y, z, name."""
    rows = [f"{i + 1} 0 0 {np.hypot(x, y):.6f} {x:.6f} {y:.6f} {z:.6f} {_one_line(name)}"
            for i, (name, (x, y, z)) in enumerate(_scaled(points, unit or "mm"))]
    return "AUX =\n" + "\n".join(rows) + "\nEND =\n"


def _rows(points: Points, unit: str | None) -> str:
    """Lines of x, y, z and name."""
    return "".join(f"{x:.9g} {y:.9g} {z:.9g} {_one_line(name)}\n" for name, (x, y, z) in _scaled(points, unit or "m"))


def _scaled(points: Points, unit: str) -> list[tuple[str, np.ndarray]]:
    return [(name, np.asarray(point, dtype=float) / UNITS[unit]) for name, point in points.items()]


def _one_line(name: str) -> str:
    if name != " ".join(name.split()) or "=" in name or name.startswith("#"):
        raise ValueError(f"landmarks: '{name}' cannot be the name of a landmark in a file of lines; write JSON")
    return name


_WRITERS: dict[str, Callable[[Points, str | None], str]] = {
    ".mrk.json": _slicer, ".pp": _picked_points, ".lnd": _caesar, ".txt": _rows}
