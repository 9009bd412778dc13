"""Virtual marker files: swapped labels put right, bad spans and gaps filled by the simulated markers."""
from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from scanprep.geometry import storage

from ..files.c3d import point_table, replace_points, write_c3d
from ..files.common import MarkerFileError
from ..files.markers import write_markers
from .results import MarkerArtefacts


def write_virtual(path: str | Path, artefacts: MarkerArtefacts, original: str | Path | None = None,
                  subject: str | None = None, unit: str | None = None) -> None:
    """Write the markers of a sequence with all gaps filled, whole or not at all.

    In a C3D file, points that were computed have residual 0 and no cameras, as the format says, and measured ones a
    residual above 0. Into a copy of the original file the points are put where they stand there: everything else,
    such as analog channels and events, stays byte for byte. A CSV file cannot tell computed points.

    Parameters
    ----------
    path : str or Path
        A name that ends in `.c3d` or `.csv`.
    artefacts : MarkerArtefacts
    original : str or Path, optional
        The C3D file that the sequence was read from.
    subject, unit : str, optional
        As `read_markers` was given them for the original.

    Raises
    ------
    MarkerFileError
        A name that ends in neither, an original that is no C3D file or has other frames or labels.
    """
    path, sequence = Path(path), artefacts.virtual()
    filled = ~artefacts.repaired.seen
    if path.suffix.lower() != ".c3d":
        write_markers(path, sequence)
    elif original is None:
        with storage.writing(path) as beside:
            write_c3d(beside, sequence.positions, sequence.labels, sequence.rate, filled)
    else:
        data = Path(original).read_bytes()
        columns = _columns(Path(original), data, sequence.labels, subject)
        source = np.where(filled, -1, artefacts.order)
        with storage.writing(path) as beside:
            beside.write_bytes(replace_points(Path(original), data, columns, sequence.positions, source, unit))


def _columns(path: Path, data: bytes, labels: tuple[str, ...], subject: str | None) -> np.ndarray:
    """Where the labels (L,) of a sequence stand among the points of a file that have positions."""
    table = point_table(path, data)
    names = [table.labels[i].rpartition(":") for i in table.kept]
    bare = [label if subject is None or who == subject else "" for who, _, label in names]
    missing = [label for label in labels if label not in bare]
    if missing:
        raise MarkerFileError(f"{path}: expected the labels of the sequence, {', '.join(missing)} not among "
                              f"{', '.join(name for name in bare if name)}")
    return np.array([bare.index(label) for label in labels])


def artefact_table(artefacts: MarkerArtefacts) -> dict[str, Any]:
    """What was found, as numbers and text for a JSON file: exchanges, bad spans, and how much was filled.

    Frames count from 0; both ends belong to a span. Distances are in metres.
    """
    gone = ~artefacts.repaired.seen
    known = [artefacts.repaired.labels.index(label) for label in artefacts.labels]
    return {"rate": artefacts.repaired.rate, "frames": len(gone),
            "exchanges": [{"labels": [s.first, s.second], "begin": s.begin, "end": s.end} for s in artefacts.swaps],
            "bad": [{"label": b.label, "kind": b.kind, "begin": b.begin, "end": b.end, "distance": b.distance}
                    for b in artefacts.bad],
            "filled": {artefacts.repaired.labels[i]: int(gone[:, i].sum()) for i in known if gone[:, i].any()}}
