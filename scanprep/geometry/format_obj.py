"""Wavefront OBJ: vertices, with colours behind the coordinates, and polygons; everything else is skipped."""
from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from .format_common import Contents, Lines, MeshFileError, polygons, text_rows, three_numbers


def read(path: Path, data: bytes) -> Contents:
    """The vertices, triangles and vertex colours of an OBJ file, vertices in their order in the file."""
    lines = Lines(path, data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" "), comment=b"#")
    starts = [line[:2] for line in map(bytes.lstrip, lines.text)]
    v_rows = [row for row, start in enumerate(starts) if start in (b"v ", b"v\t")]
    f_rows = [row for row, start in enumerate(starts) if start in (b"f ", b"f\t", b"f")]
    if not v_rows:
        raise MeshFileError(f"{path}: expected an OBJ file with lines 'v x y z', found none")
    table = _vertices(lines, v_rows)
    corners, sizes = _corners(lines, v_rows, f_rows)
    faces = polygons(path, sizes, corners, len(v_rows), [lines.numbers[row] for row in f_rows])
    return Contents(table[:, :3], faces, None, np.clip(table[:, 3:6], 0, 1) if table.shape[1] >= 6 else None)


def _after(lines: Lines, rows: list[int]) -> list[bytes]:
    """What follows the keyword, one letter, on these rows."""
    return [lines.text[row].lstrip()[1:] for row in rows]


def _vertices(lines: Lines, rows: list[int]) -> np.ndarray:
    """(N, 3) coordinates, or (N, 6) and more where every line has a colour as well."""
    text = _after(lines, rows)
    try:
        table = np.loadtxt(text, ndmin=2, comments=None) if any(map(bytes.strip, text)) else np.zeros((0, 3))
        if len(table) != len(rows) or table.shape[1] < 3:
            raise ValueError
        return table[:, :6 if table.shape[1] >= 6 else 3]
    except ValueError:               # lines of unequal length, or one that is wrong
        out = []
        for row, line in zip(rows, text, strict=True):
            try:
                x, y, z = map(float, line.split()[:3])
            except ValueError:
                raise lines.fail(row, "a vertex 'v x y z'") from None
            out.append((x, y, z))
        return np.array(out)


def _corners(lines: Lines, v_rows: list[int], f_rows: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """The vertices of all faces one after the other, counted from 0, and how many each face has."""
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
    except (ValueError, OverflowError):      # polygons of several sizes, or one that is wrong
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
    known = np.repeat(np.searchsorted(v_rows, f_rows), sizes)      # a negative number counts back from here
    return np.where(corners < 0, known + corners, corners - 1), sizes


def encode(contents: Contents, double: bool) -> bytes:
    """An OBJ file; colours, when there are any, behind the coordinates."""
    form, columns = f"v {three_numbers(double)}", [contents.vertices]
    if contents.colors is not None:
        form, columns = form + " %.4g %.4g %.4g", [contents.vertices, contents.colors]
    text = text_rows(form, *columns)
    return (text if contents.faces is None else text + text_rows("f %d %d %d", contents.faces + 1)).encode()
