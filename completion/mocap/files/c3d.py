"""C3D files of motion-capture systems: read here, for all processor types; written with ezc3d.

The reader is our own because ezc3d ends the process on some damaged files, reads truncated ones as shorter, and
does not know big-endian ones.
"""
from __future__ import annotations

import itertools
import math
import struct
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scanprep.geometry.format_common import UNITS, unit_named

from .text import MarkerFileError, RawMarkers, distinct_labels

BLOCK = 512                          # bytes; the unit in which the format counts positions in a file
_INTEL, _DEC, _MIPS = 84, 85, 86     # processor types, by the numbers of the format
MOST_FRAMES = 65535                  # largest count in the header, which then means that many or more
Parameters = dict[tuple[str, str], list[Any]]                       # group and name -> values


class _DamagedError(Exception):
    """What is wrong with the file."""


@dataclass(frozen=True)
class _Numbers:
    """Number formats of one processor type."""

    processor: int

    @property
    def order(self) -> str:
        """Byte order, as numpy and struct write it."""
        return ">" if self.processor == _MIPS else "<"

    def words(self, data: bytes, kind: str) -> np.ndarray:
        """Decode bytes as numbers of a numpy type."""
        return np.frombuffer(data, self.order + kind)

    def floats(self, data: bytes) -> np.ndarray:
        """Decode bytes as floating-point numbers of 4 bytes."""
        if self.processor != _DEC:
            return self.words(data, "f4").astype(np.float64)
        # DEC floats have the upper half first, and an exponent larger by 2
        halves = np.frombuffer(data, "<u2").reshape(-1, 2)
        return halves[:, ::-1].copy().view("<f4")[:, 0].astype(np.float64) / 4

    def encode(self, values: np.ndarray, kind: str) -> bytes:
        """Encode numbers as bytes, floating-point ("f4") or integer ("i2")."""
        if kind == "f4" and self.processor == _DEC:
            return (4 * values.ravel()).astype("<f4").view("<u2").reshape(-1, 2)[:, ::-1].tobytes()
        return values.astype(self.order + kind).tobytes()


@dataclass(frozen=True, eq=False)
class PointTable:
    """The layout of points in a C3D file."""

    numbers: _Numbers
    labels: tuple[str, ...]          # of all points, including those that hold no positions
    kept: tuple[int, ...]            # the columns that hold positions
    start: int                       # byte of the first frame
    width: int                       # bytes of each frame
    frames: int
    scale: float                     # factor on integers; negative where the file holds floating-point numbers
    rate: float | None
    unit: str
    notes: tuple[str, ...]           # errors in the file, and how they were resolved

    @property
    def kind(self) -> str:
        """Type of a number, as numpy names it."""
        return "f4" if self.scale < 0 else "i2"

    def words(self, data: bytes) -> np.ndarray:
        """Read the four numbers (T, L, 4) of all points: raw positions, and one number for cameras and residual."""
        body = data[self.start:self.start + self.frames * self.width]
        rows = self.numbers.floats(body) if self.kind == "f4" else self.numbers.words(body, "i2").astype(np.float64)
        return rows.reshape(self.frames, -1)[:, :4 * len(self.labels)].reshape(self.frames, len(self.labels), 4)


def point_table(path: Path, data: bytes) -> PointTable:
    """Find where the points of a C3D file are; MarkerFileError for a damaged file."""
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
    except _DamagedError as problem:
        raise MarkerFileError(f"{path}: {problem}") from None
    except (struct.error, IndexError, ValueError, OverflowError) as error:
        raise MarkerFileError(f"{path}: damaged C3D file ({error})") from None


def read_c3d(path: Path, data: bytes) -> RawMarkers:
    """Read the points of a C3D file; those with a negative residual are missing."""
    table = point_table(path, data)
    words = table.words(data)[:, list(table.kept)]
    positions = words[..., :3] * (1.0 if table.kind == "f4" else table.scale)
    positions[(words[..., 3] < 0) | np.isnan(words).any(axis=2)] = np.nan
    return RawMarkers(positions, tuple(table.labels[i] for i in table.kept), table.rate, table.unit, table.notes)


def read_analog(path: Path, data: bytes, channels: Sequence[int]) -> np.ndarray:
    """Read analog channels (S, C) of a C3D file in their own units, S samples at a multiple of the frame rate.

    `channels` count from 0; MarkerFileError where the file has fewer.
    """
    table = point_table(path, data)
    parameters, size = file_parameters(data, table.numbers), 4 if table.kind == "f4" else 2
    used, width = sum(_whole(parameters, "ANALOG", "USED")), table.width // size - 4 * len(table.labels)
    if not all(0 <= channel < used for channel in channels) or not width or width % used:
        raise MarkerFileError(f"{path}: expected analog channels up to {max(channels, default=0) + 1}, found {used} "
                              f"channels and {width} analog values a frame")
    # only the bytes of these channels are decoded
    rows = np.frombuffer(data, np.uint8, table.frames * table.width, table.start).reshape(table.frames, -1, size)
    raw = rows[:, 4 * len(table.labels):].reshape(-1, used, size)[:, list(channels)]
    unsigned = "".join(map(str, parameters.get(("ANALOG", "FORMAT"), ()))).upper() == "UNSIGNED"
    values = table.numbers.floats(raw.tobytes()) if size == 4 else \
        table.numbers.words(raw.tobytes(), "u2" if unsigned else "i2").astype(np.float64)
    # value = (stored - OFFSET) * SCALE * GEN_SCALE
    offset, scale = np.zeros(used), np.ones(used)
    for name, numbers in (("OFFSET", offset), ("SCALE", scale)):
        said = _lists(parameters, name, "ANALOG")[:used]
        numbers[:len(said)] = [float(number) for number in said]
    if unsigned:
        offset %= 65536
    general = float(next(iter(parameters.get(("ANALOG", "GEN_SCALE"), ())), 1.0))
    return (values.reshape(-1, len(channels)) - offset[list(channels)]) * scale[list(channels)] * general


def first_frame(data: bytes, parameters: Parameters) -> int:
    """Return the number of the first frame of a file, from 1 for a recording that was not cut."""
    start = parameters.get(("TRIAL", "ACTUAL_START_FIELD"), ())
    if len(start) == 2:
        return (int(start[0]) & 0xFFFF) + 65536 * (int(start[1]) & 0xFFFF)
    return int(_Numbers(data[(data[0] - 1) * BLOCK + 3]).words(data[6:8], "u2")[0])


def file_parameters(data: bytes, numbers: _Numbers) -> Parameters:
    """Read all parameters; groups go by number, since a group may come after its parameters."""
    groups: dict[int, str] = {}
    records: list[tuple[int, str, list[Any]]] = []
    room = len(data)                     # no byte belongs to two parameters
    for group, name, _, link, _ in parameter_records(data, numbers):
        if group < 0:
            groups[-group] = name
            continue
        # type and dimensions, then text, stripped of blanks, or numbers
        kind, count = struct.unpack_from("bB", data, link + 2)
        begin = link + 4 + count
        dims = list(data[link + 4:begin])
        size = abs(kind) * math.prod(dims)
        raw = data[begin:begin + size]
        if len(raw) < size:
            raise _DamagedError("truncated: the C3D parameters end before they should")
        values: list[Any]
        if kind == -1:
            width = (dims[0] if dims else 1) or 1
            values = [raw[i:i + width].decode("latin-1").strip(" \0") for i in range(0, len(raw), width)]
        else:
            values = (numbers.floats(raw) if kind == 4 else numbers.words(raw, "i2" if kind == 2 else "i1")).tolist()
        records.append((group, name, values))
        room -= size
        if room < 0:
            raise _DamagedError("damaged: the C3D parameters lie over each other")
    return {(groups.get(group, ""), name): values for group, name, values in records}


def parameter_records(data: bytes, numbers: _Numbers) -> Iterator[tuple[int, str, int, int, int]]:
    """Yield group (negative for a group itself), name, begin, position of the link, and its step, of every record.

    Records end where the third byte of the section says, or where the points begin, whatever the last one links to; the
    step of the last one is 0.
    """
    begin = (data[0] - 1) * BLOCK
    place, points = begin + 4, (int(numbers.words(data[16:18], "u2")[0]) - 1) * BLOCK
    end = min(max(begin + BLOCK * data[begin + 2], points), len(data))
    while place + 2 < end and data[place]:
        length, group = abs(struct.unpack_from("b", data, place)[0]), struct.unpack_from("b", data, place + 1)[0]
        link = place + 2 + length
        step = int(numbers.words(data[link:link + 2], "u2")[0])
        step = step if link + step <= end else 0
        yield group, data[place + 2:link].decode("latin-1").upper(), place, link, step
        if step == 0:
            return
        place = link + step


def _table(data: bytes, parameters: Parameters, numbers: _Numbers) -> PointTable:
    """Find where the points are, from the header, the parameters and the size of the file."""
    start = (int(numbers.words(data[16:18], "u2")[0]) - 1) * BLOCK
    scale = float(numbers.floats(data[12:16])[0])
    if start < BLOCK or not np.isfinite(scale):
        raise _DamagedError(f"damaged: the header says that the points begin at byte {start}, their scale is {scale}")
    end = rotations_start(parameters, start, len(data)) or len(data)
    try:
        count, analog, frames, size, notes = _counts(data, parameters, numbers, scale, end - start)
    except _DamagedError:                     # the position of the rotations may be wrong: try without it
        end = len(data)
        count, analog, frames, size, notes = _counts(data, parameters, numbers, scale, end - start)
    width = (4 * count + analog) * size
    if frames > MOST_FRAMES and frames == (end - start) // width:      # drop zero frames that only fill the last block
        while end - start - frames * width < BLOCK and not any(data[start + (frames - 1) * width:][:width]):
            frames -= 1
    labels = [label or f"point{i}" for i, label in enumerate((_lists(parameters, "LABELS") + [""] * count)[:count])]
    # outputs of the model that are stored among the points, but are no positions
    computed = {label for key in ("ANGLES", "FORCES", "MOMENTS", "POWERS", "SCALARS")
                for label in parameters.get(("POINT", key), ())}
    kept = tuple(i for i, label in enumerate(labels) if label not in computed)
    described = [str(text) for text in _lists(parameters, "DESCRIPTIONS")]
    names, twice = distinct_labels(labels, described)
    # rate and unit: the parameters first, then the header
    rates = [*parameters.get(("POINT", "RATE"), ()), *numbers.floats(data[20:24]).tolist()]
    said = str((parameters.get(("POINT", "UNITS")) or ["mm"])[0]).lower() or "mm"
    return PointTable(numbers, names, kept, start, width, frames, -abs(scale) if size == 4 else abs(scale),
                      next((float(r) for r in rates if isinstance(r, float | int) and 0 < r < np.inf), None),
                      unit_named(said) or said, (*notes, *twice))


def _counts(data: bytes, parameters: Parameters, numbers: _Numbers, scale: float, room: int
            ) -> tuple[int, int, int, int, tuple[str, ...]]:
    """Find the numbers of points, analog values and frames, the bytes of a number, and notes on a wrong header.

    Some programs write some of these wrongly; the size of the file tells which. The header is right if the points end
    within a block of the end of the `room`. Otherwise the first combination of other values in the file that does is
    taken, or else the header's values if they fit.
    """
    _, header_count, header_analog, first, last = (int(n) for n in numbers.words(data[:10], "u2"))
    counts = list(dict.fromkeys([header_count, *_whole(parameters, "POINT", "USED")]))
    # analog values per frame = channels times samples of each
    samples = [int(numbers.words(data[18:20], "u2")[0])]
    rates = [parameters.get((group, "RATE"), [0.0])[0] for group in ("ANALOG", "POINT")]
    if all(isinstance(rate, float | int) and 0 < rate < np.inf for rate in rates):
        samples.append(round(rates[0] / rates[1]))
    channels = _whole(parameters, "ANALOG", "USED")
    analogs = list(dict.fromkeys([header_analog, *(each * one for each in channels for one in samples)]))
    own = float(next(iter(parameters.get(("POINT", "SCALE"), ())), scale))
    sizes = list(dict.fromkeys([4 if scale < 0 else 2, 4 if own < 0 else 2]))
    # no points at all: a file of rotations, or empty
    if not any(counts):
        turned = len(parameters.get(("ROTATION", "LABELS"), ())) or sum(_whole(parameters, "ROTATION", "USED"))
        raise _DamagedError(f"expected points, the C3D file holds rotations of {turned} segments and no markers, as "
                            "Theia3D writes them; export BVH in its place, for scape animate, or markers" if turned else
                            f"expected points, the C3D file holds 0 points in {max(last - first + 1, 0)} frames")
    # all combinations that fit into the file
    fitting: list[tuple[int, int, int, int]] = []
    for count, analog, size in itertools.product(filter(None, counts), analogs, sizes):
        width = (4 * count + analog) * size
        fitting += [(count, analog, frames, size) for frames in _frames(parameters, first, last, room // width)
                    if 0 < frames * width <= room]
    exact = [f for f in fitting if room - f[2] * (4 * f[0] + f[1]) * f[3] < BLOCK]
    usual = [f for f in fitting if (f[0], f[1], f[3]) == (counts[0], analogs[0], sizes[0])]
    # none fits: the file is truncated
    if not exact and not usual:
        frames = _frames(parameters, first, last, 0)[0]
        if frames <= 0:
            raise _DamagedError(f"expected points, the C3D file holds {header_count} points in {frames} frames")
        wanted = frames * (4 * counts[0] + analogs[0]) * sizes[0] + len(data) - room
        raise _DamagedError(f"truncated: expected {frames} frames in {wanted} bytes, found {len(data)} bytes")
    count, analog, frames, size = (exact or usual)[0]
    # notes where the header is wrong
    told = [(header_count, count, "points"), (header_analog, analog, "analog values a frame")]
    told += [(max(last - first + 1, 0), frames, "frames")] if last < MOST_FRAMES else []
    notes = [f"the header says {said} {what}; by the size of the file and its parameters there are {taken}"
             for said, taken, what in told if said != taken]
    if size != sizes[0]:
        notes.append("the scale in the header has the wrong sign for the size of the file")
    return count, analog, frames, size, tuple(notes)


def rotations_start(parameters: Parameters, start: int, size: int) -> int:
    """Return the byte of the rotations after the points, which begin at `start`; 0 where there are none."""
    place = BLOCK * (sum(_whole(parameters, "ROTATION", "DATA_START")) - 1)
    used = _whole(parameters, "ROTATION", "USED") or [len(parameters.get(("ROTATION", "LABELS"), ()))]
    return place if used[0] and start < place < size else 0


def _whole(parameters: Parameters, group: str, name: str) -> list[int]:
    """Return the first value of a parameter as a count, in a list that is empty where it is missing."""
    return [int(value) & 0xFFFF for value in parameters.get((group, name), ())[:1] if isinstance(value, float | int)]


def _frames(parameters: Parameters, first: int, last: int, room: int) -> list[int]:
    """Return possible numbers of frames, the likeliest first; beyond 65535 they are in parameters, not the header."""
    said = []
    ends = [parameters.get(("TRIAL", key), []) for key in ("ACTUAL_START_FIELD", "ACTUAL_END_FIELD")]
    if all(len(end) == 2 for end in ends):
        low, high = ((int(end[0]) & 0xFFFF) + 65536 * (int(end[1]) & 0xFFFF) for end in ends)
        said.append(high - low + 1)
    long = parameters.get(("POINT", "LONG_FRAMES"), ())[:1]
    said += [int(value) for value in long if isinstance(value, float | int) and 0 < value < 2**31]
    counted = max(last - first + 1, 0)
    if last < MOST_FRAMES:
        return [counted, *_whole(parameters, "POINT", "FRAMES"), *said]
    return [*said, max(room, counted)]


def _lists(parameters: Parameters, name: str, group: str = "POINT") -> list[str]:
    """Read the texts of LABELS or DESCRIPTIONS; beyond 255 points they continue in LABELS2, LABELS3, ..."""
    lists = (parameters.get((group, f"{name}{part}" if part > 1 else name)) for part in itertools.count(1))
    return [str(text) for some in itertools.takewhile(bool, lists) for text in some or ()]


def step_of(path: Path, table: PointTable, frames: int, unit: str | None) -> float:
    """Return metres per step of the file's numbers, for `frames` frames; `unit` replaces a wrong one in the file."""
    if frames != table.frames:
        raise MarkerFileError(f"{path}: expected a file of {frames} frames, found {table.frames}")
    if (unit or table.unit) not in UNITS:
        raise MarkerFileError(f"{path}: expected a unit of {', '.join(UNITS)}, found '{table.unit}'")
    return UNITS[unit or table.unit] * (1.0 if table.kind == "f4" else table.scale)


def replace_points(path: Path, data: bytes, columns: np.ndarray, positions: np.ndarray, source: np.ndarray,
                   unit: str | None = None) -> bytes:
    """Return the file with other positions of some points; analog channels, events and all parameters stay.

    A measured point keeps its cameras and its residual, which is raised to the least that the file can hold. A computed
    point has neither, a missing one has residual -1. `columns` (L,) are among the points with positions, `positions`
    are (T, L, 3), metres, `source` (T, L) is the column a point was measured as, -1 if computed.
    """
    table = point_table(path, data)
    scale = step_of(path, table, len(positions), unit)
    if len(columns) and np.max(columns) >= len(table.kept):
        raise MarkerFileError(f"{path}: expected a file of more than {np.max(columns)} points, found {len(table.kept)}")
    words, mine = table.words(data), np.array(table.kept)[columns]
    fresh = np.empty((*positions.shape[:2], 4))
    fresh[..., :3] = positions / scale
    old = np.take_along_axis(words[:, mine, 3], np.maximum(source, 0), axis=1)
    residual = 256  # one step of the residual in the fourth number of a point; the lower byte has the cameras
    fresh[..., 3] = np.where(source < 0, 0.0, np.where(old < residual, old + residual, old))
    same = (source == np.arange(len(mine))) & (words[:, mine, 3] >= 0)
    fresh[same, :3] = words[:, mine][same, :3]                         # unchanged, bit by bit
    fresh[np.isnan(positions[..., 0])] = [0, 0, 0, -1]
    if table.kind == "i2":
        # integers; too large ones need a file of floating-point numbers
        fresh = np.rint(fresh)
        if not holds(fresh):
            return replace_points(path, as_floats(path, data), columns, positions, source, unit)
    words[:, mine] = fresh
    out = np.frombuffer(data, np.uint8).copy()
    rows = out[table.start:table.start + table.frames * table.width].reshape(table.frames, -1)
    encoded = np.frombuffer(table.numbers.encode(words, table.kind), np.uint8)
    rows[:, :encoded.size // table.frames] = encoded.reshape(table.frames, -1)
    return out.tobytes()


def holds(points: np.ndarray) -> bool:
    """Tell whether 16-bit integers can hold points (T, L, 4), in steps of the file's scale."""
    return bool(np.abs(points).max(initial=0) <= 32767)


def as_floats(path: Path, data: bytes) -> bytes:
    """Convert a file of integers to floating-point numbers, which hold any position; with a warning.

    Points, analog values and parameters keep their values; rotations after the points are left out.
    """
    table = point_table(path, data)
    numbers, parameters = table.numbers, file_parameters(data, table.numbers)
    warnings.warn(f"{path.name}: written with floating-point numbers, its whole ones reach only "
                  f"{32767 * abs(table.scale):g} {table.unit}", stacklevel=2)
    rows = np.frombuffer(data, np.uint8, table.frames * table.width, table.start).tobytes()
    unsigned = "".join(map(str, parameters.get(("ANALOG", "FORMAT"), ()))).upper() == "UNSIGNED"
    values = numbers.words(rows, "i2").reshape(table.frames, -1).astype(np.float64)
    own = 4 * len(table.labels)
    if unsigned:
        values[:, own:] = numbers.words(rows, "u2").reshape(table.frames, -1)[:, own:]
    values[:, :own] *= np.tile([table.scale] * 3 + [1.0], len(table.labels))
    # a negative scale, in the header and in the parameters, marks floating-point numbers
    head = bytearray(data[:table.start])
    minus = numbers.encode(np.array([-abs(table.scale)]), "f4")
    head[12:16] = minus
    records = list(parameter_records(data, numbers))
    points = next((-group for group, name, *_ in records if group < 0 and name == "POINT"), 0)
    for group, name, _, link, _ in records:
        if group == points and name == "SCALE":
            value = link + 4 + data[link + 3]                          # behind type and dimensions
            head[value:value + 4] = minus
    body = numbers.encode(values, "f4")
    made = bytes(head) + body + bytes(-len(body) % BLOCK)
    if point_table(path, made).kind != "f4":
        raise MarkerFileError(f"{path}: expected a scale (POINT:SCALE) that can be changed, as its whole numbers do "
                              "not reach these positions; write .trc or .csv")
    return made


def write_c3d(path: Path, positions: np.ndarray, labels: tuple[str, ...], rate: float,
              filled: np.ndarray | None = None) -> None:
    """Write positions (T, L, 3), metres; `filled` (T, L) marks those that were computed."""
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
    # positions in millimetres, homogeneous
    points = np.ones((4, L, T))
    points[:3] = 1000 * positions.transpose(2, 1, 0)
    tree["data"]["points"] = points
    # measured points have residual 1 mm where others were computed, which have 0
    residual = np.zeros((T, L)) if filled is None else np.where(filled, 0.0, 1.0)
    tree["data"]["meta_points"] = {"residuals": np.where(np.isnan(positions[..., 0]), -1.0, residual).T[None],
                                   "camera_masks": np.zeros((7, L, T), dtype=bool)}
    if T > 65535:
        for key, frame in (("ACTUAL_START_FIELD", 1), ("ACTUAL_END_FIELD", T)):
            tree.add_parameter("TRIAL", key, np.array([frame & 0xFFFF, frame >> 16], "u2").view("i2").tolist())
    tree.write(str(path))
