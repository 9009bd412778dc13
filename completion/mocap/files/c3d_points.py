"""More points for a C3D file that is there, beside its own."""
from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from scanprep.geometry.format_common import UNITS

from .c3d import BLOCK, PointTable, as_floats, file_parameters, holds, parameter_records, point_table, rotations_start
from .text import MarkerFileError

_MOST = 255                          # values along one dimension of a parameter, and blocks of all parameters


def add_points(path: Path, data: bytes, labels: Sequence[str], descriptions: Sequence[str], positions: np.ndarray,
               unit: str | None = None) -> bytes:
    """The file with computed points (T, M, 3), metres, after its own; these, analog channels and events stay.

    Labels must be new; a point that is NaN is missing. `unit` of a file that says it wrongly.
    """
    table = point_table(path, data)
    if len(positions) != table.frames:
        raise MarkerFileError(f"{path}: expected a file of {len(positions)} frames, found {table.frames}")
    if (unit or table.unit) not in UNITS:
        raise MarkerFileError(f"{path}: expected a unit of {', '.join(UNITS)}, found '{table.unit}'")
    points = np.zeros((*positions.shape[:2], 4))
    points[..., :3] = positions / UNITS[unit or table.unit] / (1.0 if table.kind == "f4" else table.scale)
    points[np.isnan(points).any(axis=2)] = [0, 0, 0, -1]
    if table.kind == "i2" and not holds(points):
        return add_points(path, as_floats(path, data), labels, descriptions, positions, unit)
    begin = (data[0] - 1) * BLOCK
    parameters = file_parameters(data, table.numbers)
    described = [str(text) for text in parameters.get(("POINT", "DESCRIPTIONS"), [])]
    body, behind = _padded(_frames(data, table, points)), rotations_start(parameters, table.start, len(data))
    behind = behind if behind >= table.start + table.frames * table.width else 0
    described = (described + [""] * len(table.labels))[:len(table.labels)]
    try:
        section = _section(path, data, begin, table, [*table.labels, *labels], [*described, *descriptions],
                           len(body) // BLOCK if behind else 0)
    except (struct.error, IndexError, ValueError, OverflowError, StopIteration) as error:
        raise MarkerFileError(f"{path}: expected C3D parameters with a group POINT that can take more points "
                              f"({type(error).__name__} {error})") from None
    head = bytearray(data[:begin])
    struct.pack_into(f"{table.numbers.order}H", head, 2, len(table.labels) + len(labels))
    struct.pack_into(f"{table.numbers.order}H", head, 16, (begin + len(section)) // BLOCK + 1)
    return bytes(head) + section + body + (data[behind:] if behind else b"")


def _frames(data: bytes, table: PointTable, points: np.ndarray) -> bytes:
    """Every frame with the new points between its own and its analog channels."""
    size, T = 4 if table.kind == "f4" else 2, table.frames
    rows = np.frombuffer(data, np.uint8, T * table.width, table.start).reshape(T, -1)
    values = points if table.kind == "f4" else np.rint(points)
    added = np.frombuffer(table.numbers.encoded(values, table.kind), np.uint8).reshape(T, -1)
    own = 4 * len(table.labels) * size
    return np.concatenate([rows[:, :own], added, rows[:, own:]], axis=1).tobytes()


def _section(path: Path, data: bytes, begin: int, table: PointTable, labels: list[str], descriptions: list[str],
             before_rotations: int) -> bytes:
    """The parameters, all but those that tell of the points as they stand there.

    `before_rotations` is the number of blocks of points where rotations follow, else 0.
    """
    records = list(_records(data, table))
    group = next(-number for number, name, _ in records if number < 0 and name == "POINT")
    turned = next((-number for number, name, _ in records if number < 0 and name == "ROTATION"), 0)
    kept = [record for number, name, record in records if not (
        number == group and (name in ("USED", "DATA_START") or name.startswith(("LABELS", "DESCRIPTIONS"))))
        and not (before_rotations and (number, name) == (turned, "DATA_START"))]
    order = table.numbers.order
    kept.append(_parameter(group, "USED", b"\x02\x00" + struct.pack(f"{order}H", len(labels))))
    for name, texts in (("LABELS", labels), ("DESCRIPTIONS", descriptions)):
        for part, first in enumerate(range(0, len(texts), _MOST), start=1):
            some = texts[first:first + _MOST]
            width = min(max(map(len, some), default=1) or 1, _MOST)
            cells = b"".join(text.encode("latin-1", "replace")[:width].ljust(width) for text in some)
            kept.append(_parameter(group, name + (str(part) if part > 1 else ""),
                                   bytes([255, 2, width, len(some)]) + cells))
    starts = [_parameter(group, "DATA_START", b"\x02\x00\x00\x00")]
    starts += [_parameter(turned, "DATA_START", b"\x02\x00\x00\x00")] if before_rotations else []
    blocks = -(-(4 + sum(len(record) + 2 for record in [*kept, *starts])) // BLOCK)
    if blocks > _MOST:
        raise MarkerFileError(f"{path}: expected room for more points, the C3D parameters are full")
    first = begin // BLOCK + blocks + 1
    kept += [start[:-3] + struct.pack(f"{order}H", place) + start[-1:]
             for start, place in zip(starts, (first, first + before_rotations), strict=False)]
    linked = [_linked(record, order, last=i == len(kept) - 1) for i, record in enumerate(kept)]
    return _padded(data[begin:begin + 2] + bytes([blocks, table.numbers.processor]) + b"".join(linked))


def _parameter(group: int, name: str, values: bytes) -> bytes:
    """A record without its link: name, type, dimensions and values, and no description."""
    return bytes([len(name), group]) + name.encode() + values + b"\0"


def _linked(record: bytes, order: str, last: bool) -> bytes:
    """The record with the way to the next one, 0 for the last, after its name."""
    name = 2 + abs(struct.unpack_from("b", record)[0])
    return record[:name] + struct.pack(f"{order}H", 0 if last else len(record) - name + 2) + record[name:]


def _records(data: bytes, table: PointTable) -> Iterator[tuple[int, str, bytes]]:
    """Group, negative for that of a group itself, name, and the bytes of every record without its link."""
    for group, name, place, link, step in parameter_records(data, table.numbers):
        end = link + step if step else _last(data, link + 2, group)
        yield group, name, data[place:link] + data[link + 2:end]


def _last(data: bytes, place: int, group: int) -> int:
    """The byte after a record that links to none, whose values begin at a place."""
    if group > 0:
        kind, count = struct.unpack_from("bB", data, place)
        place += 2 + count + abs(kind) * int(np.prod(list(data[place + 2:place + 2 + count]), initial=1))
    return place + 1 + data[place]


def _padded(data: bytes) -> bytes:
    return data + b"\0" * (-len(data) % BLOCK)
