"""C3D, the file of motion-capture systems: read here, of every processor type; written through ezc3d.

The reader is our own because ezc3d ends the process on some damaged files, reads truncated ones as shorter, and
does not know big-endian ones.
"""
from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scanprep.geometry.format_common import UNITS

from .text import MarkerFileError, RawMarkers

BLOCK = 512
_INTEL, _DEC, _MIPS = 84, 85, 86
_COMPUTED = ("ANGLES", "FORCES", "MOMENTS", "POWERS", "SCALARS")     # stored among the points, but no positions
RESIDUAL = 256                       # one step of the residual in the fourth number of a point; below it are cameras
_Parameters = dict[tuple[str, str], list[Any]]                       # group and name -> values


class _Damaged(Exception):
    """What is wrong with the file."""


@dataclass(frozen=True)
class _Numbers:
    """How one processor stores its numbers."""

    processor: int

    @property
    def order(self) -> str:
        return ">" if self.processor == _MIPS else "<"

    def words(self, data: bytes, kind: str) -> np.ndarray:
        return np.frombuffer(data, self.order + kind)

    def floats(self, data: bytes) -> np.ndarray:
        if self.processor != _DEC:
            return self.words(data, "f4").astype(np.float64)
        halves = np.frombuffer(data, "<u2").reshape(-1, 2)           # the upper half first, exponent larger by 2
        return halves[:, ::-1].copy().view("<f4")[:, 0].astype(np.float64) / 4

    def encoded(self, values: np.ndarray, kind: str) -> bytes:
        """Numbers as bytes, floating-point ones ("f4") or whole ones ("i2")."""
        if kind == "f4" and self.processor == _DEC:
            return (4 * values.ravel()).astype("<f4").view("<u2").reshape(-1, 2)[:, ::-1].tobytes()
        return values.astype(self.order + kind).tobytes()


@dataclass(frozen=True, eq=False)
class PointTable:
    """Where in a C3D file its points stand."""

    numbers: _Numbers
    labels: tuple[str, ...]          # of all points, those that hold no positions among them
    kept: tuple[int, ...]            # the columns that hold positions
    start: int                       # byte of the first frame
    width: int                       # bytes of each
    frames: int
    scale: float                     # of whole numbers; negative where the file holds floating-point numbers
    rate: float | None
    unit: str

    @property
    def kind(self) -> str:
        """Of a number, as numpy names it."""
        return "f4" if self.scale < 0 else "i2"

    def words(self, data: bytes) -> np.ndarray:
        """The four numbers (T, L, 4) of all points: places as they stand there, cameras and residual in one."""
        body = data[self.start:self.start + self.frames * self.width]
        rows = self.numbers.floats(body) if self.kind == "f4" else self.numbers.words(body, "i2").astype(np.float64)
        return rows.reshape(self.frames, -1)[:, :4 * len(self.labels)].reshape(self.frames, len(self.labels), 4)


def point_table(path: Path, data: bytes) -> PointTable:
    """Where the points of a C3D file stand."""
    start = (data[0] - 1) * BLOCK if data else 0
    if len(data) < BLOCK or data[1] != 0x50:
        raise MarkerFileError(f"{path}: expected a C3D file, with byte 2 = 80 and a header of {BLOCK} bytes; "
                              f"found {len(data)} bytes that begin {data[:8]!r}")
    if not 0 < start < len(data) - 4:
        raise MarkerFileError(f"{path}: truncated or damaged: expected C3D parameters at byte {start}, "
                              f"found {len(data)} bytes")
    numbers = _Numbers(data[start + 3])
    if numbers.processor not in (_INTEL, _DEC, _MIPS):
        raise MarkerFileError(f"{path}: expected processor type 84, 85 or 86 in the C3D file, "
                              f"found {numbers.processor}")
    try:
        return _table(data, file_parameters(data, numbers), numbers)
    except _Damaged as problem:
        raise MarkerFileError(f"{path}: {problem}") from None
    except (struct.error, IndexError, ValueError, OverflowError) as error:
        raise MarkerFileError(f"{path}: damaged C3D file ({error})") from None


def read_c3d(path: Path, data: bytes) -> RawMarkers:
    """The points of a C3D file; missing are those with a negative residual."""
    table = point_table(path, data)
    words = table.words(data)[:, list(table.kept)]
    positions = words[..., :3] * (1.0 if table.kind == "f4" else table.scale)
    positions[(words[..., 3] < 0) | np.isnan(words).any(axis=2)] = np.nan
    return RawMarkers(positions, tuple(table.labels[i] for i in table.kept), table.rate, table.unit)


def file_parameters(data: bytes, numbers: _Numbers) -> _Parameters:
    """All parameters; a group is known by its number, which may come after its parameters."""
    place = (data[0] - 1) * BLOCK + 4
    groups: dict[int, str] = {}
    room = len(data)                     # no byte belongs to two parameters
    found: list[tuple[int, str, list[Any]]] = []
    while place + 2 < len(data) and data[place]:
        length, group = abs(struct.unpack_from("b", data, place)[0]), struct.unpack_from("b", data, place + 1)[0]
        name = data[place + 2:place + 2 + length].decode("latin-1").upper()
        link = place + 2 + length
        step = int(numbers.words(data[link:link + 2], "u2")[0])
        if group < 0:
            groups[-group] = name
        else:
            values, size = _values(data, link + 2, numbers)
            found.append((group, name, values))
            room -= size
            if room < 0:
                raise _Damaged("damaged: the C3D parameters lie over each other")
        if step == 0:
            break
        place = link + step
    return {(groups.get(group, ""), name): values for group, name, values in found}


def _values(data: bytes, place: int, numbers: _Numbers) -> tuple[list[Any], int]:
    """The values of one parameter, text stripped of blanks or numbers, and the bytes they take."""
    kind, count = struct.unpack_from("bB", data, place)
    dims = list(data[place + 2:place + 2 + count])
    size = abs(kind) * math.prod(dims)
    raw = data[place + 2 + count:place + 2 + count + size]
    if len(raw) < size:
        raise _Damaged("truncated: the C3D parameters end before they should")
    if kind == -1:
        width = dims[0] if dims else 1
        return [raw[i:i + width].decode("latin-1").strip(" \0") for i in range(0, len(raw), width or 1)], size
    if kind == 4:
        return numbers.floats(raw).tolist(), size
    return numbers.words(raw, {1: "i1", 2: "i2"}[kind] if kind in (1, 2) else "i1").tolist(), size


def _table(data: bytes, parameters: _Parameters, numbers: _Numbers) -> PointTable:
    """Where the points stand, by the header and the parameters."""
    _, points, analog, first, last = (int(n) for n in numbers.words(data[:10], "u2"))
    start = (int(numbers.words(data[16:18], "u2")[0]) - 1) * BLOCK
    scale = float(numbers.floats(data[12:16])[0])
    width = (4 * points + analog) * (4 if scale < 0 else 2)
    frames = _frames(parameters, first, last, (len(data) - start) // width if width else 0)
    if not points or frames <= 0:
        raise _Damaged(f"expected points, the C3D file holds {points} points in {frames} frames")
    if start < BLOCK or not np.isfinite(scale):
        raise _Damaged(f"damaged: the header says that the points begin at byte {start}, their scale is {scale}")
    if start + frames * width > len(data):
        raise _Damaged(f"truncated: expected {frames} frames in {start + frames * width} bytes, "
                       f"found {len(data)} bytes")
    labels = _labels(parameters, points)
    computed = {label for key in _COMPUTED for label in parameters.get(("POINT", key), ())}
    rate = (parameters.get(("POINT", "RATE")) or numbers.floats(data[20:24]).tolist())[0]
    return PointTable(numbers, tuple(labels), tuple(i for i, label in enumerate(labels) if label not in computed),
                      start, width, frames, scale, float(rate) if isinstance(rate, float | int) and rate > 0 else None,
                      str((parameters.get(("POINT", "UNITS")) or ["mm"])[0]).lower() or "mm")


def _frames(parameters: _Parameters, first: int, last: int, room: int) -> int:
    """How many frames there are: the header counts to 65535, longer files say it in parameters or not at all."""
    counted = max(int(last) - int(first) + 1, 0)
    if last < 65535:
        return counted
    ends = [parameters.get(("TRIAL", key), []) for key in ("ACTUAL_START_FIELD", "ACTUAL_END_FIELD")]
    if all(len(end) == 2 for end in ends):
        low, high = ((int(end[0]) & 0xFFFF) + 65536 * (int(end[1]) & 0xFFFF) for end in ends)
        return max(high - low + 1, 0)
    said = parameters.get(("POINT", "LONG_FRAMES"))
    return int(said[0]) if said else max(room, counted)


def _labels(parameters: _Parameters, count: int) -> list[str]:
    """The labels of all points; beyond 255 they go on in LABELS2, LABELS3, ..."""
    labels: list[str] = []
    part = 1
    while more := parameters.get(("POINT", "LABELS" if part == 1 else f"LABELS{part}"), []):
        labels += map(str, more)
        part += 1
    labels = (labels + [""] * count)[:count]
    return [label or f"point{i}" for i, label in enumerate(labels)]


def replace_points(path: Path, data: bytes, columns: np.ndarray, positions: np.ndarray, source: np.ndarray,
                   unit: str | None = None) -> bytes:
    """The file with other positions of some points; analog channels, events and all parameters are kept.

    A measured point keeps its cameras and its residual, made no less than the least that the file can hold; a computed
    one has neither, a missing one residual -1. `columns` (L,) are of the points with positions, `positions` (T, L, 3),
    metres, `source` (T, L) the column a point was measured as, -1 if computed; `unit` of a file that says it wrongly.
    """
    table = point_table(path, data)
    if len(positions) != table.frames:
        raise MarkerFileError(f"{path}: expected a file of {len(positions)} frames, found {table.frames}")
    if len(columns) and np.max(columns) >= len(table.kept):
        raise MarkerFileError(f"{path}: expected a file of more than {np.max(columns)} points, found {len(table.kept)}")
    if (unit or table.unit) not in UNITS:
        raise MarkerFileError(f"{path}: expected a unit of {', '.join(UNITS)}, found '{table.unit}'")
    words, mine = table.words(data), np.array(table.kept)[columns]
    scale = UNITS[unit or table.unit] * (1.0 if table.kind == "f4" else table.scale)
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


def write_c3d(path: Path, positions: np.ndarray, labels: tuple[str, ...], rate: float,
              filled: np.ndarray | None = None) -> None:
    """Write positions (T, L, 3), metres, of which some, `filled` (T, L), were not measured."""
    try:
        import ezc3d
    except ImportError:
        raise ImportError("writing C3D files needs ezc3d: pip install ezc3d") from None
    tree = ezc3d.c3d()
    parameters = tree["parameters"]["POINT"]
    parameters["UNITS"]["value"] = ["mm"]
    parameters["RATE"]["value"] = [float(rate)]
    parameters["LABELS"]["value"] = tuple(labels)
    T, L = positions.shape[:2]
    points = np.ones((4, L, T))
    points[:3] = 1000 * positions.transpose(2, 1, 0)
    tree["data"]["points"] = points
    # residual, millimetres, of points that were measured, where others were not
    residual = np.zeros((T, L)) if filled is None else np.where(filled, 0.0, 1.0)
    tree["data"]["meta_points"] = {"residuals": np.where(np.isnan(positions[..., 0]), -1.0, residual).T[None],
                                   "camera_masks": np.zeros((7, L, T), dtype=bool)}
    if T > 65535:
        for key, frame in (("ACTUAL_START_FIELD", 1), ("ACTUAL_END_FIELD", T)):
            tree.add_parameter("TRIAL", key, np.array([frame & 0xFFFF, frame >> 16], "u2").view("i2").tolist())
    tree.write(str(path))
