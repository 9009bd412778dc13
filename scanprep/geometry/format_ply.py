"""Read and write PLY: ascii, and binary of either byte order, with colours and normals; the rest is skipped.

Triangles come from polygons, from strips (`tristrips`), or from the grid of a range scanner (`range_grid`).
"""
from __future__ import annotations

import contextlib
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from . import storage
from .budget import spend
from .format_common import (
    Contents,
    Lines,
    MeshFileError,
    as_colors,
    as_rows,
    fields_of,
    polygons,
    quantise_colors,
    quote,
    strip_triangles,
)

_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
          "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4",
          "uint32": "u4", "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8"}
_ORDERS = {b"ascii": "=", b"binary_little_endian": "<", b"binary_big_endian": ">"}
_COLORS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))


@dataclass(frozen=True)
class Property:
    """A property in the header of a PLY file."""

    name: str
    kind: str                        # numpy type code of the value or of the list's items
    length_kind: str | None = None   # type code of the list's length, None for a single value


@dataclass(frozen=True)
class Element:
    """An element in the header of a PLY file: rows with the same properties."""

    name: str
    count: int
    properties: Sequence[Property]


_Column = np.ndarray | tuple[np.ndarray, np.ndarray]     # values, or the lengths and the items of lists


def read(path: Path, data: bytes) -> Contents:
    """Read vertices, triangles, normals and colours of a PLY file."""
    order, elements, start, first_line = _header(path, data)
    names = [e.name for e in elements]
    if "vertex" not in names or len(set(names)) < len(names):
        raise MeshFileError(f"{path}: expected an element vertex, and each element once, the header has {names}")
    lines = Lines(path, data[start:], first_line) if order == "=" else None
    found: dict[str, dict[str, _Column]] = {}
    place = 0 if lines else start
    for element in elements:
        found[element.name], place = (ascii_element(lines, element, place) if lines
                                      else _binary_element(path, data, element, place, order))
    rest = len(lines) - place if lines else len(data[place:].rstrip(b"\0\r\n\t "))
    if rest > 0:
        counts = ", ".join(f"{e.count} {e.name}" for e in elements)
        raise MeshFileError(f"{path}: expected the end of the file after {counts}, found {rest} more "
                            f"{'lines' if lines else 'bytes'}")
    rows = [int(line.split()[2]) for line in data[:start].splitlines() if line.startswith(b"obj_info num_rows ")]
    return _contents(path, elements[names.index("vertex")], found, rows[0] if rows else 0)


def _header(path: Path, data: bytes) -> tuple[str, list[Element], int, int]:
    """Parse the header: byte order, elements, and position and line number of the body."""
    if not data.startswith(b"ply") or data[3:4] not in (b"\n", b"\r"):
        raise MeshFileError(f"{path}: expected a PLY file that begins with 'ply', found {quote(data[:20])}")
    last_line = re.search(rb"[\r\n]end_header[ \t]*(\r\n|\r|\n)", data)
    if last_line is None:
        raise MeshFileError(f"{path}: truncated: the PLY header has no end_header")
    # if all other lines end in CR alone, an LF behind this one belongs to the body
    alone = data[3:4] == b"\r" and data[4:5] != b"\n" and last_line[1] == b"\r\n"
    after = last_line.end() - alone
    order, elements, lines = None, list[Element](), data[:last_line.start() + 1].splitlines()
    properties: list[Property] = []          # of the last element
    for number, line in enumerate(lines[1:], 2):
        words = line.split()
        try:
            if not words or words[0] in (b"comment", b"obj_info") or words[:2] == [b"Created", b"by"]:   # Blender 2.4
                continue
            if words[0] == b"format":
                order = _ORDERS[words[1]]
            elif words[0] == b"element":
                elements.append(Element(words[1].decode(), int(words[2]), properties := []))
                if elements[-1].count < 0:
                    raise ValueError
            elif words[0] == b"property":
                if not elements:
                    raise IndexError
                properties.append(_property(words))
            else:
                raise KeyError
        except (KeyError, IndexError, ValueError):
            raise MeshFileError(f"{path}: line {number}: expected a line of a PLY header, "
                                f"found {quote(line)}") from None
    if order is None:
        raise MeshFileError(f"{path}: expected a format line in the PLY header, found none")
    return order, elements, after, len(lines) + 2


def _property(words: list[bytes]) -> Property:
    """Parse a property line."""
    text = [w.decode() for w in words]
    if text[1] == "list":
        if _TYPES[text[2]][0] == "f":
            raise ValueError
        return Property(text[4], _TYPES[text[3]], _TYPES[text[2]])
    return Property(text[2], _TYPES[text[1]])


def _binary_element(path: Path, data: bytes, element: Element, start: int, order: str
                    ) -> tuple[dict[str, _Column], int]:
    """Read all rows at once if every list has the length of the first row, else row by row."""
    fields, at = list[tuple](), start
    for i, p in enumerate(element.properties):
        n = 1
        if p.length_kind:
            n = _length(data, at, p.length_kind, order) if element.count else 0
            if n < 0:
                raise MeshFileError(f"{path}: row 0 of element {element.name}: a list of {n} values")
            fields.append((f"length{i}", order + p.length_kind))
            at += int(p.length_kind[1])
        fields.append((f"value{i}", order + p.kind, (n,) if p.length_kind else ()))
        at += n * int(p.kind[1])
        if at > len(data) and element.count:
            raise _truncation(path, element, 0)
    # the type of one row, with list lengths as in the first; check that all rows have them
    row = np.dtype(fields)
    if start + row.itemsize * element.count > len(data):
        return _binary_rows(path, data, element, start, order)
    table = np.frombuffer(data, row, element.count, start) if fields and element.count else np.zeros(0, row)
    columns: dict[str, _Column] = {}
    for i, p in enumerate(element.properties):
        values = table[f"value{i}"]
        if not p.length_kind:
            columns[p.name] = values
        elif (table[f"length{i}"] == values.shape[1]).all():
            columns[p.name] = np.full(element.count, values.shape[1]), values.reshape(-1)
        else:
            return _binary_rows(path, data, element, start, order)
    return columns, start + row.itemsize * element.count


def _binary_rows(path: Path, data: bytes, element: Element, start: int, order: str
                 ) -> tuple[dict[str, _Column], int]:
    """Read rows with lists of varying lengths, one by one."""
    sizes, items = [list[int]() for _ in element.properties], [bytearray() for _ in element.properties]
    for row in range(element.count):
        if row % 1000 == 999:
            spend(visits=1000)
        for p, size, item in zip(element.properties, sizes, items, strict=True):
            n = 1
            if p.length_kind:
                n = _length(data, start, p.length_kind, order)
                start += int(p.length_kind[1])
            end = start + n * int(p.kind[1])
            if n < 0:
                raise MeshFileError(f"{path}: row {row} of element {element.name}: a list of {n} values")
            if end > len(data):
                raise _truncation(path, element, row)
            size.append(n)
            item += data[start:end]
            start = end
    columns: dict[str, _Column] = {}
    for p, size, item in zip(element.properties, sizes, items, strict=True):
        values = np.frombuffer(item, order + p.kind)
        columns[p.name] = (np.array(size, dtype=np.int64), values) if p.length_kind else values
    return columns, start


def _length(data: bytes, at: int, kind: str, order: str) -> int:
    """Read the length of a list."""
    return int.from_bytes(data[at:at + int(kind[1])], "big" if order == ">" else "little", signed=kind[0] == "i")


def _truncation(path: Path, element: Element, found: int) -> MeshFileError:
    """Make the error for missing rows."""
    return MeshFileError(f"{path}: truncated: expected {element.count} rows of element {element.name}, "
                         f"found {found}")


def ascii_element(lines: Lines, element: Element, start: int) -> tuple[dict[str, _Column], int]:
    """Read all rows at once without lists, or with one integer list of constant length; else row by row."""
    stop = start + element.count
    if stop > len(lines):
        raise _truncation(lines.path, element, max(len(lines) - start, 0))
    properties, width = element.properties, len(element.properties)
    kind = np.int64 if all(p.kind[0] in "iu" for p in properties) else np.float64
    if not any(p.length_kind for p in properties):
        table = lines.table(range(start, stop), f"{width} values of element {element.name}", width, kind)
        return {p.name: table[:, i] for i, p in enumerate(properties)}, stop
    if width == 1 and kind is np.int64 and element.count:
        with contextlib.suppress(ValueError):
            table = np.loadtxt(lines.text[start:stop], dtype=kind, ndmin=2, comments=None)
            if (table[:, 0] == table.shape[1] - 1).all():
                return {properties[0].name: (table[:, 0], table[:, 1:].reshape(-1))}, stop
    return _ascii_rows(lines, element, range(start, stop)), stop


def _ascii_rows(lines: Lines, element: Element, rows: range) -> dict[str, _Column]:
    """Read text rows with lists of varying lengths, one by one."""
    sizes, items = [list[int]() for _ in element.properties], [list[float]() for _ in element.properties]
    for row in rows:
        if row % 1000 == 999:
            spend(visits=1000)
        words = iter(lines.text[row].split())
        try:
            for p, size, item in zip(element.properties, sizes, items, strict=True):
                size.append(int(next(words)) if p.length_kind else 1)
                values = list(islice(words, size[-1]))
                if len(values) != size[-1]:
                    raise ValueError
                item += map(int if p.kind[0] in "iu" else float, values)
        except (ValueError, StopIteration):
            raise lines.fail(row, f"a row of element {element.name} as its header says") from None
    columns: dict[str, _Column] = {}
    with storage.taking_apart(lines.path, f"numbers of element {element.name} as its header says", MeshFileError):
        for p, size, item in zip(element.properties, sizes, items, strict=True):
            found = np.array(item, dtype=np.int64 if p.kind[0] in "iu" else np.float64)
            columns[p.name] = (np.array(size, dtype=np.int64), found) if p.length_kind else found
    return columns


def _contents(path: Path, vertex: Element, found: dict[str, dict[str, _Column]], grid_rows: int) -> Contents:
    """Make the contents of the columns of all elements."""
    columns = found["vertex"]

    def triple(names: tuple[str, ...]) -> np.ndarray | None:
        """Return three columns (N, 3), or None if one is missing."""
        values = [columns.get(name) for name in names]
        if any(v is None or isinstance(v, tuple) for v in values):
            return None
        return np.stack([np.asarray(v, dtype=np.float64) for v in values], axis=1)

    vertices = triple(("x", "y", "z"))
    if vertices is None:
        raise MeshFileError(f"{path}: expected properties x, y, z of element vertex, "
                            f"found {[p.name for p in vertex.properties]}")
    kinds = {p.name: np.dtype(p.kind) for p in vertex.properties}
    # integer colours are multiples of 1/255 or 1/65535; floats may have any scale
    colors = next((as_colors(c, kinds[names[0]].kind in "iu") for names in _COLORS if (c := triple(names)) is not None),
                  None)
    return Contents(vertices, _faces(path, found, vertices, grid_rows), triple(("nx", "ny", "nz")), colors)


def _faces(path: Path, found: dict[str, dict[str, _Column]], vertices: np.ndarray, grid_rows: int) -> np.ndarray | None:
    """Return triangles (F, 3) of the first non-empty element of faces, strips or grid; None for a cloud."""
    for name in ("face", "tristrips", "range_grid"):
        lists = found.get(name, {}).get("vertex_indices", found.get(name, {}).get("vertex_index"))
        if name not in found or (isinstance(lists, tuple) and not len(lists[0])):
            continue
        if not isinstance(lists, tuple):
            if not any(map(len, found[name].values())):              # an element without rows needs no such property
                continue
            raise MeshFileError(f"{path}: expected a property list vertex_indices of element {name}, "
                                f"found {list(found[name])}")
        sizes, corners = lists
        if name == "face":
            return polygons(path, sizes, corners, len(vertices), vertices=vertices)
        faces = _strips(sizes, corners) if name == "tristrips" else _grid(path, sizes, corners, grid_rows, vertices)
        return polygons(path, np.full(len(faces), 3), faces.ravel(), len(vertices))
    return None


def _strips(sizes: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return triangles (F, 3) of strips; a strip ends with its list, or at a -1 in it."""
    strip = np.repeat(np.arange(len(sizes)), sizes) + np.cumsum(corners < 0)
    listed = corners >= 0
    return strip_triangles(corners[listed].astype(np.int64), np.unique(strip[listed], return_counts=True)[1])


def _grid(path: Path, sizes: np.ndarray, corners: np.ndarray, rows: int, vertices: np.ndarray) -> np.ndarray:
    """Triangulate the grid of a range scanner (F, 3), whose cells hold one vertex or none."""
    if rows <= 0 or len(sizes) % rows or not np.isin(sizes, (0, 1)).all():
        raise MeshFileError(f"{path}: expected a range_grid of one vertex or none a cell, and obj_info num_rows and "
                            f"num_cols that agree with its {len(sizes)} cells; found {rows} rows")
    if len(corners) and not 0 <= corners.min() <= corners.max() < len(vertices):
        raise MeshFileError(f"{path}: the range_grid refers to vertices {corners.min()}..{corners.max()}, "
                            f"expected 0..{len(vertices) - 1}")
    numbers = np.full(len(sizes), -1)
    numbers[sizes == 1] = corners
    cells: np.ndarray = numbers.reshape(rows, -1)
    a, b, c, d = (part.ravel() for part in (cells[:-1, :-1], cells[:-1, 1:], cells[1:, 1:], cells[1:, :-1]))
    # two triangles per square, along its shorter diagonal; one if a corner is missing
    shorter = np.linalg.norm(vertices[a] - vertices[c], axis=1) <= np.linalg.norm(vertices[b] - vertices[d], axis=1)
    along_ac = (shorter & (a >= 0) & (c >= 0)) | (b < 0) | (d < 0)
    faces = np.where(along_ac[:, None, None], np.stack([[a, d, c], [a, c, b]]).transpose(2, 0, 1),
                     np.stack([[a, d, b], [b, d, c]]).transpose(2, 0, 1)).reshape(-1, 3)
    faces = faces[(faces >= 0).all(axis=1)]
    longest = np.linalg.norm(vertices[faces] - vertices[np.roll(faces, 1, axis=1)], axis=2).max(axis=1, initial=0)
    # orient towards +z: range scanners look along -z, whatever the direction of their rows
    a, b, c = vertices[faces].transpose(1, 0, 2)
    if np.cross(b - a, c - a)[:, 2].sum() < 0:
        faces = faces[:, ::-1]
    # edges longer than four medians span a jump between surfaces: triangles seen at 75 degrees have edges four times as
    # long as those seen from the front
    kept = longest <= 4.0 * np.median(longest) if len(longest) else np.zeros(0, bool)
    warnings.warn(f"{path}: a range grid of {rows} x {cells.shape[1]}: neighbours were joined by {kept.sum()} "
                  f"triangles, {len(kept) - kept.sum()} that span jumps were left out", stacklevel=2)
    return np.asarray(faces[kept])


def encode(contents: Contents, double: bool) -> bytes:
    """Encode a binary little-endian PLY file; coordinates as `double` or, smaller, as `float`."""
    number = "f8" if double else "f4"
    rows = as_rows([(("x", "y", "z"), number, contents.vertices), (("nx", "ny", "nz"), number, contents.normals),
                    (_COLORS[0], "u1", None if contents.colors is None else quantise_colors(contents.colors))])
    words = {"<f8": "double", "<f4": "float", "|u1": "uchar"}
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property {words[kind]} {name}" for name, kind in fields_of(rows)]
    body = rows.tobytes()
    if contents.faces is not None:
        header += [f"element face {len(contents.faces)}", "property list uchar int vertex_indices"]
        faces = np.zeros(len(contents.faces), dtype=[("length", "u1"), ("corners", "<i4", (3,))])
        faces["length"], faces["corners"] = 3, contents.faces
        body += faces.tobytes()
    return ("\n".join([*header, "end_header"]) + "\n").encode() + body
