"""Add points to an existing C3D file, or relabel its own; everything else in the file stays."""
from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from .c3d import (
    BLOCK,
    PointTable,
    as_floats,
    file_parameters,
    holds,
    parameter_records,
    point_table,
    rotations_start,
    step_of,
)
from .text import MarkerFileError


def add_points(path: Path, data: bytes, labels: Sequence[str], descriptions: Sequence[str], positions: np.ndarray,
               unit: str | None = None) -> bytes:
    """Return the file with computed points (T, M, 3), metres, after its own; everything else stays.

    Labels must be new; a point that is NaN is missing. `unit` replaces a wrong one in the file.
    """
    table = point_table(path, data)
    points = np.zeros((*positions.shape[:2], 4))
    points[..., :3] = positions / step_of(path, table, len(positions), unit)
    points[np.isnan(points).any(axis=2)] = [0, 0, 0, -1]
    if table.kind == "i2" and not holds(points):
        return add_points(path, as_floats(path, data), labels, descriptions, positions, unit)
    if table.kind == "i2":
        points = np.rint(points)
    return _with_points(path, data, table, np.concatenate([table.words(data), points], axis=1),
                        [*table.labels, *labels], [*_descriptions(data, table), *descriptions])


def rename_points(path: Path, data: bytes, labels: Sequence[str], source: np.ndarray) -> bytes:
    """Return the file with its measured points under other labels; everything else stays.

    Cameras and residuals go with their point. `labels` (M) are those of the new columns. `source` (T, M) is the column
    of `RawMarkers` that each was measured as in every frame, -1 where it is missing.
    """
    table = point_table(path, data)
    words, kept = table.words(data), np.array(table.kept)
    if source.shape != (table.frames, len(labels)) or source.max(initial=-1) >= len(kept):
        raise MarkerFileError(f"{path}: expected a file of {len(source)} frames with more than "
                              f"{source.max(initial=-1)} points, found {table.frames} with {len(kept)}")
    taken = np.take_along_axis(words, kept[np.maximum(source, 0)][..., None], axis=1)
    taken[source < 0] = [0, 0, 0, -1]
    # points without positions come last
    rest = [i for i in range(len(table.labels)) if i not in table.kept]
    described = _descriptions(data, table)
    return _with_points(path, data, table, np.concatenate([taken, words[:, rest]], axis=1),
                        [*labels, *(table.labels[i] for i in rest)],
                        [*[""] * len(labels), *(described[i] for i in rest)])


def _descriptions(data: bytes, table: PointTable) -> list[str]:
    """Read the description of each point in the file, empty where there is none."""
    told = [str(text) for text in file_parameters(data, table.numbers).get(("POINT", "DESCRIPTIONS"), [])]
    return (told + [""] * len(table.labels))[:len(table.labels)]


def _with_points(path: Path, data: bytes, table: PointTable, words: np.ndarray, labels: list[str],
                 descriptions: list[str]) -> bytes:
    """Return the file with points (T, N, 4) in place of its own."""
    begin, parameters = (data[0] - 1) * BLOCK, file_parameters(data, table.numbers)
    # frames: points, then the analog channels as they were
    size, T, behind = 4 if table.kind == "f4" else 2, table.frames, rotations_start(parameters, table.start, len(data))
    rows = np.frombuffer(data, np.uint8, T * table.width, table.start).reshape(T, -1)
    encoded = np.frombuffer(table.numbers.encode(words, table.kind), np.uint8)
    own = 4 * len(table.labels) * size
    body = _pad(np.concatenate([encoded.reshape(T, -1), rows[:, own:]], axis=1).tobytes())
    behind = behind if behind >= table.start + table.frames * table.width else 0
    try:
        section = _section(path, data, begin, table, labels, descriptions, len(body) // BLOCK if behind else 0)
    except (struct.error, IndexError, ValueError, OverflowError, StopIteration) as error:
        raise MarkerFileError(f"{path}: expected C3D parameters with a group POINT that can take more points "
                              f"({type(error).__name__} {error})") from None
    # the header counts the points and says where they begin
    head = bytearray(data[:begin])
    struct.pack_into(f"{table.numbers.order}H", head, 2, len(labels))
    struct.pack_into(f"{table.numbers.order}H", head, 16, (begin + len(section)) // BLOCK + 1)
    return bytes(head) + section + body + (data[behind:] if behind else b"")


def _section(path: Path, data: bytes, begin: int, table: PointTable, labels: list[str], descriptions: list[str],
             before_rotations: int) -> bytes:
    """Return the parameter section, with new parameters about the points and all others unchanged.

    `before_rotations` is the number of blocks of points if rotations follow, else 0.
    """
    # records to keep: all but those about number, place, labels and descriptions of points
    records = list(_records(data, table))
    group = next(-number for number, name, _ in records if number < 0 and name == "POINT")
    turned = next((-number for number, name, _ in records if number < 0 and name == "ROTATION"), 0)
    kept = [record for number, name, record in records if not (
        number == group and (name in ("USED", "DATA_START") or name.startswith(("LABELS", "DESCRIPTIONS"))))
            and not (before_rotations and (number, name) == (turned, "DATA_START"))]
    order = table.numbers.order
    kept.append(_parameter(group, "USED", b"\x02\x00" + struct.pack(f"{order}H", len(labels))))
    most = 255  # largest dimension of a parameter, and number of blocks of all parameters: one byte in the format
    for name, texts in (("LABELS", labels), ("DESCRIPTIONS", descriptions)):
        for part, first in enumerate(range(0, len(texts), most), start=1):
            part_texts = texts[first:first + most]
            width = min(max(map(len, part_texts), default=1) or 1, most)
            cells = b"".join(text.encode("latin-1", "replace")[:width].ljust(width) for text in part_texts)
            kept.append(_parameter(group, name + (str(part) if part > 1 else ""),
                                   bytes([255, 2, width, len(part_texts)]) + cells))
    # the place of the points depends on the length of this section, so it comes last
    starts = [_parameter(group, "DATA_START", b"\x02\x00\x00\x00")]
    starts += [_parameter(turned, "DATA_START", b"\x02\x00\x00\x00")] if before_rotations else []
    blocks = -(-(4 + sum(len(record) + 2 for record in [*kept, *starts])) // BLOCK)
    if blocks > most:
        raise MarkerFileError(f"{path}: expected room for more points, the C3D parameters are full")
    first = begin // BLOCK + blocks + 1
    kept += [start[:-3] + struct.pack(f"{order}H", place) + start[-1:]
             for start, place in zip(starts, (first, first + before_rotations), strict=False)]
    # after its name each record has a link to the next one, 0 for the last
    linked = bytearray(data[begin:begin + 2] + bytes([blocks, table.numbers.processor]))
    for i, record in enumerate(kept):
        name = 2 + abs(struct.unpack_from("b", record)[0])
        linked += record[:name] + struct.pack(f"{order}H", len(record) - name + 2 if i < len(kept) - 1 else 0) \
            + record[name:]
    return _pad(bytes(linked))


def _parameter(group: int, name: str, values: bytes) -> bytes:
    """Encode a record without its link: name, type, dimensions, values and an empty description."""
    return bytes([len(name), group]) + name.encode() + values + b"\0"


def _records(data: bytes, table: PointTable) -> Iterator[tuple[int, str, bytes]]:
    """Yield group (negative for a group itself), name, and the bytes without the link, of every record."""
    for group, name, place, link, step in parameter_records(data, table.numbers):
        end = link + step
        if not step:                     # the last one ends after its values and its description
            end = link + 2
            if group > 0:
                kind, count = struct.unpack_from("bB", data, end)
                end += 2 + count + abs(kind) * int(np.prod(list(data[end + 2:end + 2 + count]), initial=1))
            end += 1 + data[end]
        yield group, name, data[place:link] + data[link + 2:end]


def _pad(data: bytes) -> bytes:
    """Pad bytes with zeros to whole blocks."""
    return data + b"\0" * (-len(data) % BLOCK)
