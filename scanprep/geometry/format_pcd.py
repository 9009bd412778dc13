"""Read and write PCD, the point cloud format of PCL: ascii, binary, and LZF-compressed binary."""
from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from . import storage
from .format_common import Contents, Lines, MeshFileError, as_rows, fields_of, quantise_colors, quote

_KEYS = (b"VERSION", b"FIELDS", b"SIZE", b"TYPE", b"COUNT", b"WIDTH", b"HEIGHT", b"VIEWPOINT", b"POINTS", b"DATA")


def read(path: Path, data: bytes) -> Contents:
    """Read points, normals and colours of a PCD file; missing points are not finite."""
    header, start, line = _header(path, data)
    names = header[b"FIELDS"]
    try:
        row = _row(header)
        count = int(header[b"POINTS"][0])
        if count < 0 or any(row[name].shape for name in ("x", "y", "z") if name in (row.names or ())):
            raise ValueError("one x, y, z for each of POINTS")
    except (KeyError, IndexError, ValueError, TypeError, OverflowError, MemoryError) as error:
        raise MeshFileError(f"{path}: expected FIELDS, SIZE, TYPE, COUNT and POINTS that agree in the PCD header "
                            f"({error})") from None
    if not {b"x", b"y", b"z"} <= set(names):
        raise MeshFileError(f"{path}: expected fields x, y, z in the PCD header, found {quote(b' '.join(names))}")
    # three encodings of the same columns
    how = header[b"DATA"][0]
    if how == b"ascii":
        columns = _ascii(Lines(path, data[start:], line), row, count)
    elif how == b"binary":
        if len(data) - start < row.itemsize * count:
            raise MeshFileError(f"{path}: truncated: expected {count} points, "
                                f"found {(len(data) - start) // row.itemsize}")
        table = np.frombuffer(data, row, count, start)
        columns = {name: table[name] for name in row.names or ()}
    elif how == b"binary_compressed":
        columns = _decompress(path, data[start:], row, count)
    else:
        raise MeshFileError(f"{path}: expected DATA ascii, binary or binary_compressed in the PCD header, "
                            f"found {quote(how)}")
    with storage.taking_apart(path, "three normals and one colour of each point", MeshFileError):
        return _contents(columns)


def _header(path: Path, data: bytes) -> tuple[dict[bytes, list[bytes]], int, int]:
    """Parse the header: its words by key, the start of the data, and the line number there."""
    header: dict[bytes, list[bytes]] = {}
    start, number = 0, 0
    while b"DATA" not in header:
        end = data.find(b"\n", start)
        if end < 0:
            raise MeshFileError(f"{path}: truncated or not a PCD file: the header has no line DATA")
        words, number = data[start:end].split(b"#")[0].split(), number + 1
        if words and words[0] not in _KEYS:
            raise MeshFileError(f"{path}: line {number}: expected a line of a PCD header, "
                                f"found {quote(data[start:end])}")
        if words:
            header[words[0]] = words[1:]
        start = end + 1
    if not header.get(b"FIELDS") or not header[b"DATA"]:
        raise MeshFileError(f"{path}: expected FIELDS and DATA in the PCD header, found {list(header)}")
    return header, start, number + 1


def _row(header: dict[bytes, list[bytes]]) -> np.dtype:
    """Build the NumPy type of one point from FIELDS, SIZE, TYPE and COUNT."""
    fields: list[tuple] = []
    letters = {b"F": "f", b"U": "u", b"I": "i"}
    counts = header.get(b"COUNT", [b"1"] * len(header[b"FIELDS"]))
    for i, name in enumerate(header[b"FIELDS"]):
        kind = f"<{letters[header[b'TYPE'][i]]}{int(header[b'SIZE'][i])}"
        text = f"padding{i}" if name == b"_" else name.decode()
        fields.append((text, kind) if int(counts[i]) == 1 else (text, kind, (int(counts[i]),)))
    return np.dtype(fields)


def _ascii(lines: Lines, row: np.dtype, count: int) -> dict[str, np.ndarray]:
    """Read the columns of text points."""
    widths = [int(np.prod(row[name].shape)) for name in row.names or ()]
    if len(lines) > count:
        raise lines.fail(count, f"the end of the file after {count} points")
    table = lines.table(range(count), f"{sum(widths)} numbers of a point, of {count} points", sum(widths))
    start = np.cumsum([0, *widths])
    columns = {}
    for i, name in enumerate(row.names or ()):
        values = table[:, start[i]]
        columns[name] = values.astype(row[name]) if widths[i] == 1 else table[:, start[i]:start[i + 1]]
    return columns


def _decompress(path: Path, data: bytes, row: np.dtype, count: int) -> dict[str, np.ndarray]:
    """Unpack compressed points: two sizes, then all columns, one after the other, packed together."""
    packed, size = struct.unpack_from("<II", data) if len(data) >= 8 else (0, 0)
    if len(data) < 8 + packed or size != row.itemsize * count:
        raise MeshFileError(f"{path}: truncated or damaged: expected {row.itemsize * count} bytes of {count} points, "
                            f"packed in {packed}, found {size} in {max(len(data) - 8, 0)}")
    body = _lzf(path, data[8:8 + packed], size)
    columns, at = {}, 0
    for name in row.names or ():
        field = row[name]
        values = np.frombuffer(body, field.base, count * int(np.prod(field.shape)), at)
        columns[name] = values.reshape(count, *field.shape)
        at += count * field.itemsize
    return columns


def _lzf(path: Path, data: bytes, size: int) -> bytes:
    """Unpack LZF, the format of liblzf: literal runs of bytes, and copies of earlier output."""
    out, at = bytearray(), 0
    try:
        while at < len(data):
            control = data[at]
            at += 1
            if control < 32:             # a literal run of control + 1 bytes
                out += data[at:at + control + 1]
                at += control + 1
                continue
            # a copy: length and distance, both possibly in further bytes
            length, distance = control >> 5, (control & 31) << 8
            if length == 7:
                length += data[at]
                at += 1
            length, distance, at = length + 2, distance + data[at] + 1, at + 1
            if distance > len(out) or len(out) + length > size:
                raise IndexError
            run = out[-distance:][:length]                   # an overlapping copy repeats itself
            out += run if length <= distance else (run * (length // distance + 1))[:length]
    except IndexError:
        pass
    if len(out) != size or at != len(data):
        raise MeshFileError(f"{path}: damaged: its packed points cannot be unpacked")
    return bytes(out)


def _contents(columns: dict[str, np.ndarray]) -> Contents:
    """Make points, normals and colours of the columns."""
    points = np.stack([columns[name] for name in "xyz"], axis=1).astype(np.float64)
    normals = colors = None
    if {"normal_x", "normal_y", "normal_z"} <= set(columns):
        normals = np.stack([columns[f"normal_{a}"] for a in "xyz"], axis=1).astype(np.float64)
    packed = next((columns[name] for name in ("rgb", "rgba") if name in columns), None)
    if packed is not None and packed.dtype.itemsize == 4 and packed.ndim == 1:       # 0xrrggbb, possibly as a float
        bits = np.ascontiguousarray(packed).view(np.uint32)
        colors = np.stack([(bits >> shift) & 255 for shift in (16, 8, 0)], axis=1) / 255
    return Contents(points, None, normals, colors)


def encode(contents: Contents, double: bool) -> bytes:
    """Encode a binary PCD file."""
    packed = None
    if contents.colors is not None:
        packed = quantise_colors(contents.colors).astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], dtype=np.uint32)
    rows = as_rows([(("x", "y", "z"), "f8" if double else "f4", contents.vertices),
                    (("normal_x", "normal_y", "normal_z"), "f4", contents.normals),
                    (("rgb",), "u4", None if packed is None else packed[:, None])])
    fields = fields_of(rows)
    lines = ["VERSION 0.7", "FIELDS " + " ".join(n for n, _ in fields),
             "SIZE " + " ".join(k[2] for _, k in fields), "TYPE " + " ".join(k[1].upper() for _, k in fields),
             "COUNT " + " ".join("1" for _ in fields), f"WIDTH {len(rows)}", "HEIGHT 1",
             "VIEWPOINT 0 0 0 1 0 0 0", f"POINTS {len(rows)}", "DATA binary"]
    return ("\n".join(lines) + "\n").encode() + rows.tobytes()
