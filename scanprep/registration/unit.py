"""The unit of a scan of a person where nobody knows it, and a first test of the size of any scan."""
from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from ..cleaning.clean_scan import take_clutter
from ..geometry.files import read_scan
from ..geometry.format_common import UNKNOWN
from ..geometry.mesh import Mesh
from ..judgement import extent
from .lead import lead_of
from .person import average_person

DIAGONAL = 2.0                       # metres from corner to corner of the box around a person, roughly


def resolve_unit(path: Path, unit: str | None) -> str | None:
    """Return a unit as it is, and for "unknown" the metres of one unit of the scan, as a number for all readers.

    The person in it becomes as tall as people of that build are, with a UserWarning that says how tall.

    Raises
    ------
    WrongScaleError
        A scan in which no person is found.
    """
    if unit != UNKNOWN:
        return unit
    metres, stature = person_size(read_scan(path, "m"))
    warnings.warn(f"{path}: one unit in it is taken for {metres:.4g} m, which makes the person {stature:.2f} m tall, "
                  "as people of that build are; that may be a tenth off", stacklevel=2)
    return repr(metres)


def person_size(scan: Mesh | np.ndarray) -> tuple[float, float]:
    """Find the length of a scan's unit, metres, and the stature of the person in it, metres."""
    points = scan.vertices if isinstance(scan, Mesh) else scan
    # floor and specks go at a rough scale, as their limits are lengths of a person
    rough = DIAGONAL / extent(points)
    bare, _ = take_clutter(scan.with_vertices(rough * points) if isinstance(scan, Mesh) else rough * points)
    lead = lead_of(average_person().mesh, "people")
    assert lead is not None, "the average person is one"
    metres, stature = lead.person_size(bare)
    return rough * metres, stature
