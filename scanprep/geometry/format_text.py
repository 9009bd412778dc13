"""Read and write text formats: Wavefront OBJ; OFF, COFF, NOFF, CNOFF; and points, one `x y z` per line."""
from __future__ import annotations

import re
import warnings
from pathlib import Path

import numpy as np

from .format_common import (
    Contents,
    Lines,
    MeshFileError,
    as_colors,
    as_utf8,
    polygons,
    quantise_colors,
    quote,
    text_rows,
    three_numbers,
)
from .format_ply import Element, Property, ascii_element


def read_obj(path: Path, data: bytes) -> Contents:
    """Read vertices, triangles and vertex colours of an OBJ file; everything else is skipped."""
    lines = Lines(path, as_utf8(data).replace(b"\\\r\n", b" ").replace(b"\\\n", b" "), comment=b"#")
    starts = [line[:2] for line in map(bytes.lstrip, lines.text)]
    v_rows = [row for row, start in enumerate(starts) if start in (b"v ", b"v\t")]
    f_rows = [row for row, start in enumerate(starts) if start in (b"f ", b"f\t", b"f")]
    if not v_rows:
        raise MeshFileError(f"{path}: expected an OBJ file with lines 'v x y z', found none")
    table = _vertices(lines, v_rows)
    corners, sizes = _corners(lines, v_rows, f_rows)
    faces = polygons(path, sizes, corners, len(v_rows), [lines.numbers[row] for row in f_rows], table[:, :3])
    colors = as_colors(table[:, 3:6]) if table.shape[1] >= 6 else None
    o_rows = [row for row, start in enumerate(starts) if start in (b"o ", b"o\t")]
    return Contents(table[:, :3], faces, None, colors, _objects(lines, o_rows, f_rows, sizes))


def _objects(lines: Lines, o_rows: list[int], f_rows: list[int], sizes: np.ndarray) -> tuple[tuple[str, int], ...]:
    """Return name and triangle count of every non-empty object; the first may have no name."""
    of = np.searchsorted(o_rows, f_rows) - 1
    names = [text.strip().decode("utf-8", "replace") for text in _after(lines, o_rows)]
    counts = [(name, int((sizes[of == k] - 2).sum())) for k, name in enumerate(["without a name", *names], -1)]
    return tuple((name, count) for name, count in counts if count)


def _after(lines: Lines, rows: list[int]) -> list[bytes]:
    """Return what follows the one-letter keyword on these rows."""
    return [lines.text[row].lstrip()[1:] for row in rows]


def _vertices(lines: Lines, rows: list[int]) -> np.ndarray:
    """Read coordinates (N, 3), or (N, 6) if every line also has a colour."""
    text = _after(lines, rows)
    try:
        table = np.loadtxt(text, ndmin=2, comments=None) if any(map(bytes.strip, text)) else np.zeros((0, 3))
        if len(table) != len(rows) or table.shape[1] < 3:
            raise ValueError
        return table[:, :6 if table.shape[1] >= 6 else 3]
    except ValueError:               # lines of unequal length, or a bad one
        out = []
        for row, line in zip(rows, text, strict=True):
            try:
                x, y, z = map(float, line.split()[:3])
            except ValueError:
                raise lines.fail(row, "a vertex 'v x y z'") from None
            out.append((x, y, z))
        return np.array(out)


def _corners(lines: Lines, v_rows: list[int], f_rows: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Read the vertices of all faces, one after the other, counted from 0; and the number of each face."""
    text = _after(lines, f_rows)
    if any(b"/" in line for line in text):           # v/vt/vn: the first number is the vertex
        text = re.sub(rb"/\S*", b"", b"\n".join(text)).split(b"\n")
    try:
        table: np.ndarray = np.zeros((0, 3))
        if any(map(bytes.strip, text)):
            table = np.loadtxt(text, dtype=np.int64, ndmin=2, comments=None)
        if len(table) != len(text):
            raise ValueError
        corners, sizes = table.astype(np.int64).ravel(), np.full(len(text), table.shape[1])
    except (ValueError, OverflowError):      # polygons of several sizes, or a bad line
        words = [line.split() for line in text]
        bad = next((i for i, w in enumerate(words) if not all(re.fullmatch(rb"[+-]?\d{1,18}", x) for x in w)), None)
        if bad is not None:
            raise lines.fail(f_rows[bad], "a face 'f v v v' of vertex numbers") from None
        corners = np.array([x for w in words for x in w], dtype=np.int64)
        sizes = np.array([len(w) for w in words])
    zero = np.flatnonzero(corners == 0)
    if len(zero):
        face = int(np.searchsorted(np.cumsum(sizes), zero[0], side="right"))
        raise lines.fail(f_rows[face], "vertex numbers counted from 1")
    known = np.repeat(np.searchsorted(v_rows, f_rows), sizes)      # negative numbers count back from here
    return np.where(corners < 0, known + corners, corners - 1), sizes


def encode_obj(contents: Contents, double: bool) -> bytes:
    """Encode an OBJ file; colours, if any, follow the coordinates."""
    form, columns = f"v {three_numbers(double)}", [contents.vertices]
    if contents.colors is not None:
        form, columns = form + " %.4g %.4g %.4g", [contents.vertices, contents.colors]
    text = text_rows(form, *columns)
    return (text if contents.faces is None else text + text_rows("f %d %d %d", contents.faces + 1)).encode()


def read_off(path: Path, data: bytes) -> Contents:
    """Read vertices, polygons as triangles, normals and vertex colours of an ascii OFF file."""
    lines = Lines(path, as_utf8(data), comment=b"#")
    head = lines.text[0].split() if len(lines) else [b""]
    kind = re.match(rb"(ST)?(C)?(N)?OFF(?=\d|$)", head[0])
    if kind is None:
        raise MeshFileError(f"{path}: expected a file that begins with OFF or COFF, found {quote(data[:20])}")
    if kind.end() < len(head[0]):            # the counts follow without a space, as in ModelNet40
        head[:1] = [kind[0], head[0][kind.end():]]
    if head[1:2] == [b"BINARY"]:
        raise MeshFileError(f"{path}: expected an ascii OFF file, found a binary one")
    counts, place = (head[1:], 1) if len(head) > 1 else (lines.text[1].split() if len(lines) > 1 else [], 2)
    if len(counts) < 2 or not all(word.isdigit() and len(word) < 10 for word in counts[:2]):
        raise lines.fail(place - 1, "the numbers of vertices, faces and edges")
    n, f = int(counts[0]), int(counts[1])
    width = 6 if kind[3] else 3
    table = lines.table(range(place, place + n), f"{width} or more numbers of vertex 0..{n - 1}", width)
    colors = None
    if kind[2] and table.shape[1] >= width + 3:
        colors = as_colors(table[:, width:width + 3])
    place += n
    if place + f != len(lines):
        found = len(lines) - place
        raise MeshFileError(f"{path}: {'truncated: ' if found < f else ''}expected {f} faces after {n} vertices, "
                            f"found {found} lines")
    face = Element("face", f, (Property("corners", "i4", "u1"),))                 # as in PLY; face colours are skipped
    sizes, corners = ascii_element(lines, face, place)[0]["corners"]
    faces = polygons(path, sizes, corners, n, lines.numbers[place:place + f], table[:, :3])
    return Contents(table[:, :3], faces, table[:, 3:6] if kind[3] else None, colors)


def encode_off(contents: Contents, double: bool) -> bytes:
    """Encode an OFF file, or COFF with colours."""
    assert contents.faces is not None, "an OFF file is written for meshes"
    kind, form, columns = "OFF", three_numbers(double), [contents.vertices]
    if contents.colors is not None:
        kind, form = "COFF", form + " %d %d %d 255"
        columns.append(quantise_colors(contents.colors))
    return (f"{kind}\n{len(contents.vertices)} {len(contents.faces)} 0\n" + text_rows(form, *columns)
            + text_rows("3 %d %d %d", contents.faces)).encode()


# column names of CloudCompare, ParaView, MeshLab and others, without punctuation and units
_COLUMNS = {"points": {"x": "x", "y": "y", "z": "z", "points0": "x", "points1": "y", "points2": "z"},
            "normals": {"nx": "x", "ny": "y", "nz": "z", "normalx": "x", "normaly": "y", "normalz": "z",
                        "normals0": "x", "normals1": "y", "normals2": "z"},
            "colors": {"r": "x", "g": "y", "b": "z", "red": "x", "green": "y", "blue": "z"}}


def read_xyz(path: Path, data: bytes) -> Contents:
    """Read the points of a text file with columns separated by spaces, commas or semicolons.

    A heading names the columns. Without one the first three are coordinates. Three more are normals if every row has
    length one, or colours if they are in 0..255 or 0..1. In `.pts` an intensity may precede the colours. A line with a
    single number is a count of points.
    """
    data = as_utf8(data)
    if b"\0" in data:
        raise MeshFileError(f"{path}: expected text with lines 'x y z', found a binary file")
    lines = Lines(path, data, comment=b"#")
    # a heading, a count, or both in any order may precede the points
    first, names = 0, list[str]()
    while first < min(len(lines), 2) and not _is_point(lines.text[first]):
        words = [re.sub(r"[\[(].*|[^a-z0-9]", "", word) for word in _words(lines.text[first].decode("latin-1").lower())]
        if not words[0].isdigit() or len(words) > 1:
            if not set(_COLUMNS["points"]) & set(words):
                break
            names = [word for word in words if word]
        first += 1
    if len(lines) == first:
        raise MeshFileError(f"{path}: expected lines 'x y z', found none")
    lines.text = _with_decimal_points(lines, first)
    table = lines.table(range(first, len(lines)), "numbers 'x y z', as many on every line", 3)
    if names:
        return _columns_by_name(lines, names, table)
    # find normals and colours among the columns from `start` on; skip columns that begin neither. No program writes
    # more than some twenty
    start = 4 if path.name.lower().endswith(".pts") and table.shape[1] in (4, 7) else 3
    normals = colors = None
    while start + 3 <= min(table.shape[1], 64):
        triple = table[:, start:start + 3]
        if normals is None and np.allclose(np.linalg.norm(triple, axis=1), 1, atol=1e-2):
            normals, start = triple, start + 3
        elif colors is None and triple.min() >= 0 and triple.max() <= 255:
            colors, start = as_colors(triple), start + 3
        else:
            start += 1
    return Contents(table[:, :3], None, normals, colors)


def _words(line: str) -> list[str]:
    """Split a line at spaces, commas and semicolons."""
    return [word for word in re.split(r"[\s,;]+", line) if word] or [""]


def _is_point(line: bytes) -> bool:
    """Test whether a line holds three numbers or more."""
    try:
        return len([float(word) for word in re.split(rb"[\s,;]+", line) if word]) >= 3
    except ValueError:
        return False


def _with_decimal_points(lines: Lines, first: int) -> list[bytes]:
    """Convert lines from `first` on to columns separated by spaces, with decimal points.

    A comma is a decimal comma if every line has at least three words, each with at most one comma inside, and there is
    no point. Otherwise it separates columns.
    """
    body = b"\n".join(lines.text[first:]).replace(b";", b" ")
    if b"," in body:
        words = [line.split() for line in body.split(b"\n")]
        inside = all(len(row) >= 3 and all(re.fullmatch(rb"[^,]+(,[^,]+)?", word) for word in row) for row in words)
        if inside and b"." in body:
            row = next(k for k, line in enumerate(lines.text) if k >= first and b"," in line)
            raise lines.fail(row, "decimals with a point, or a comma between columns; it has both points and commas")
        if inside:
            warnings.warn(f"{lines.path}: its commas were read as decimal points", stacklevel=2)
        body = body.replace(b",", b"." if inside else b" ")
    return [*lines.text[:first], *body.split(b"\n")]


def _columns_by_name(lines: Lines, names: list[str], table: np.ndarray) -> Contents:
    """Select columns by the heading; MeshFileError if it lacks x, y or z, or has too many columns."""
    if len(names) > table.shape[1]:
        raise lines.fail(0, f"a heading of {table.shape[1]} columns, as the points have")
    found = {}
    for what, known in _COLUMNS.items():
        column = {known[name]: k for k, name in reversed(list(enumerate(names))) if name in known}
        if {*column} == {"x", "y", "z"}:
            found[what] = table[:, [column["x"], column["y"], column["z"]]]
    if "points" not in found:
        raise lines.fail(0, "a heading with x, y and z")
    colors = as_colors(found["colors"]) if "colors" in found else None
    return Contents(found["points"], None, found.get("normals"), colors)


def encode_xyz(contents: Contents, double: bool) -> bytes:
    """Encode lines of coordinates, then normals, then colours 0..255."""
    form, columns = three_numbers(double), [contents.vertices]
    if contents.normals is not None:
        form, columns = form + " %.7g %.7g %.7g", [*columns, contents.normals]
    if contents.colors is not None:
        form, columns = form + " %.6g %.6g %.6g", [*columns, 255 * contents.colors]
    return text_rows(form, *columns).encode()
