"""Points of a C3D file replaced where they stand: every other byte remains as it was."""
from __future__ import annotations

from pathlib import Path

import numpy as np

from .c3d import point_table
from .common import MARKER_UNITS, MarkerFileError

RESIDUAL = 256                       # one step of the residual in the fourth number of a point; below it are cameras


def replace_points(path: Path, data: bytes, columns: np.ndarray, positions: np.ndarray, source: np.ndarray,
                   unit: str | None = None) -> bytes:
    """The file with other positions of some points; analog channels, events and all parameters are kept.

    A point that was measured keeps its cameras and its residual, which is made no less than the least that the file
    can hold; one that was computed has neither, as the format has it; a missing one has residual -1.

    `columns` (L,): of the file's points that have positions, which to replace; `positions` (T, L, 3), metres: naN where
    a point is missing; `source` (T, L): which of `columns` a point was measured as, -1 where it was computed.
    """
    table = point_table(path, data)
    if len(positions) != table.frames:
        raise MarkerFileError(f"{path}: expected a file of {len(positions)} frames, found {table.frames}")
    if len(columns) and np.max(columns) >= len(table.kept):
        raise MarkerFileError(f"{path}: expected a file of more than {np.max(columns)} points, found {len(table.kept)}")
    if (unit or table.unit) not in MARKER_UNITS:
        raise MarkerFileError(f"{path}: expected a unit of {', '.join(MARKER_UNITS)}, found '{table.unit}'")
    words, mine = table.words(data), np.array(table.kept)[columns]
    scale = MARKER_UNITS[unit or table.unit] * (1.0 if table.kind == "f4" else table.scale)
    fresh = np.empty((*positions.shape[:2], 4))
    fresh[..., :3] = positions / scale
    old = np.take_along_axis(words[:, mine, 3], np.maximum(source, 0), axis=1)
    fresh[..., 3] = np.where(source < 0, 0.0, np.where(old < RESIDUAL, old + RESIDUAL, old))
    same = (source == np.arange(len(mine))) & (words[:, mine, 3] >= 0)
    fresh[same, :3] = words[:, mine][same, :3]                         # not a bit of them changes
    fresh[np.isnan(positions[..., 0])] = [0, 0, 0, -1]
    if table.kind == "i2":
        fresh = np.rint(fresh)
        if np.abs(fresh).max(initial=0) > 32767:
            raise MarkerFileError(f"{path}: expected places within {32767 * abs(table.scale):g} {table.unit}, which "
                                  f"its whole numbers reach, got {np.nanmax(np.abs(positions)):g} m")
    words[:, mine] = fresh
    out = np.frombuffer(data, np.uint8).copy()
    rows = out[table.start:table.start + table.frames * table.width].reshape(table.frames, -1)
    encoded = np.frombuffer(table.numbers.encoded(words, table.kind), np.uint8)
    rows[:, :encoded.size // table.frames] = encoded.reshape(table.frames, -1)
    return out.tobytes()
