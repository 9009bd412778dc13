"""How well the template lies on each scan: figures, and their tables in the folder of the set."""
from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from ..geometry import storage

NONE = "none"                  # what a table says where a figure has no value
EARLIER = {"guide": "init", "flipped": "inverted"}      # names of columns in tables written before
FIGURES, TIMES, FAILURES = "registration.csv", "times.csv", "failures.csv"


@dataclass(frozen=True)
class ScanFigures:
    """How well the template lies on one scan: a row of `registration.csv`."""

    name: str
    init: str               # what led the template there: "10 landmarks", "160 correspondences", "pose"
    distance: float         # metres, mean of the vertices with data to the surface of the scan
    rms: float              # metres, of the same
    seen: float             # share of the vertices with data
    confidence: float       # mean over all vertices, from 0 to 1
    missed: float           # share of the scan's points off the template: a limb it does not cover, or clutter
    stretch: float          # share of the surface more than twice, or less than half, as long in some direction
    landmarks: float        # metres, RMS distance of the landmarks; NaN without
    inverted: int           # triangles that face against their surroundings
    converged: bool
    removed: float = 0.0    # share of the scan's points that were cleaned off before
    seconds: float = np.nan         # in `times.csv`, as it is the one figure that differs from run to run


@dataclass(frozen=True)
class Failure:
    """A scan that could not be registered, and one line that says why and names the file: a row of `failures.csv`."""

    name: str
    reason: str


_TABLED = [f for f in fields(ScanFigures) if f.name != "seconds"]
_READ: dict[str, Callable[[str], Any]] = {"str": str, "float": lambda text: np.nan if text == NONE else float(text),
                                          "int": int, "bool": "True".__eq__}


def read_figures(folder: Path) -> list[ScanFigures]:
    """The figures of all scans of a set, as they stand in its tables; ValueError for other columns or values."""
    seconds = {row["name"]: float(row["seconds"]) for row in _read(folder / TIMES)}
    rows = [{EARLIER.get(name, name): text for name, text in row.items()} for row in _read(folder / FIGURES)]
    try:
        return [ScanFigures(**{f.name: _READ[str(f.type)](row[f.name]) for f in _TABLED},
                            seconds=seconds.get(row["name"], np.nan)) for row in rows]
    except (KeyError, ValueError, TypeError) as error:
        raise ValueError(f"{folder / FIGURES}: expected the columns {', '.join(f.name for f in _TABLED)} "
                         f"({type(error).__name__}: {error})") from None


def write_figures(folder: Path, figures: Iterable[ScanFigures]) -> None:
    """Write the tables of figures and times, sorted by name."""
    rows = sorted(figures, key=lambda f: f.name)
    _write(folder / TIMES, ["name", "seconds"], [[f.name, f"{f.seconds:.2f}"] for f in rows])
    names = [f.name for f in _TABLED]
    _write(folder / FIGURES, names, [[_tabled(getattr(row, name)) for name in names] for row in rows])


def _tabled(value: Any) -> Any:
    return NONE if isinstance(value, float) and np.isnan(value) else value


def read_failures(folder: Path) -> list[Failure]:
    """The scans that could not be registered when they were tried last."""
    return [Failure(row["name"], row["reason"]) for row in _read(folder / FAILURES)]


def write_failures(folder: Path, failures: Iterable[Failure]) -> None:
    """Write the table of failures, sorted by name; without any there is none."""
    rows = sorted(failures, key=lambda f: f.name)
    if rows:
        _write(folder / FAILURES, ["name", "reason"], [[f.name, f.reason] for f in rows])
    else:
        (folder / FAILURES).unlink(missing_ok=True)


def _read(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(path.read_text(encoding="utf-8")))) if path.exists() else []


def _write(path: Path, header: list[str], rows: list[list[Any]]) -> None:
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerows([header, *rows])
    with storage.writing(path) as beside:
        beside.write_text(text.getvalue(), encoding="utf-8")
