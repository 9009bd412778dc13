"""Wavefront OBJ: vertices, with colours behind the coordinates, and polygons; everything else is skipped."""
from __future__ import annotations

from pathlib import Path

import numpy as np

from .common import Contents, Lines, MeshFileError, polygons


def read(path: Path, data: bytes) -> Contents:
    """The vertices, triangles and vertex colours of an OBJ file, vertices in their order in the file."""
    lines = Lines(path, data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" "), comment=b"#")
    words = [line.split() for line in lines.text]
    v_rows = [row for row, w in enumerate(words) if w[0] == b"v"]
    f_rows = [row for row, w in enumerate(words) if w[0] == b"f"]
    if not v_rows:
        raise MeshFileError(f"{path}: expected an OBJ file with lines 'v x y z', found none")
    table = _vertices(lines, words, v_rows)
    corners, sizes = _corners(lines, words, v_rows, f_rows)
    faces = polygons(path, sizes, corners, len(v_rows), [lines.numbers[row] for row in f_rows])
    return Contents(table[:, :3], faces if f_rows else None, None, table[:, 3:6] if table.shape[1] >= 6 else None)


def _vertices(lines: Lines, words: list[list[bytes]], rows: list[int]) -> np.ndarray:
    """(N, 3) coordinates, or (N, 6) where every line has a colour as well."""
    width = 6 if min(len(words[row]) for row in rows) >= 7 else 3
    try:
        return np.array([words[row][1:width + 1] for row in rows], dtype=np.float64)
    except ValueError:
        for row in rows:
            try:
                if len([float(word) for word in words[row][1:]]) < 3:
                    raise ValueError
            except ValueError:
                raise lines.fail(row, "a vertex 'v x y z'") from None
        raise


def _corners(lines: Lines, words: list[list[bytes]], v_rows: list[int], f_rows: list[int]
             ) -> tuple[np.ndarray, np.ndarray]:
    """The vertices of all faces one after the other, counted from 0, and how many each face has."""
    sizes = np.array([len(words[row]) - 1 for row in f_rows], dtype=np.int64)
    flat = [word for row in f_rows for word in words[row][1:]]
    if any(b"/" in word for word in flat):
        flat = [word.split(b"/", 1)[0] for word in flat]
    try:
        corners = np.array(flat, dtype=np.int64)
    except ValueError:
        for row in f_rows:
            for word in words[row][1:]:
                if not word.split(b"/", 1)[0].lstrip(b"+-").isdigit():
                    raise lines.fail(row, "a face 'f v v v' of vertex numbers") from None
        raise
    zero = np.flatnonzero(corners == 0)
    if len(zero):
        face = int(np.searchsorted(np.cumsum(sizes), zero[0], side="right"))
        raise lines.fail(f_rows[face], "vertex numbers counted from 1")
    known = np.repeat(np.searchsorted(v_rows, f_rows), sizes)      # a negative number counts back from here
    return np.where(corners < 0, known + corners, corners - 1), sizes


def encode(contents: Contents, double: bool) -> bytes:
    """An OBJ file; colours, when there are any, behind the coordinates."""
    digits = "%.12g" if double else "%.8g"
    rows, form = contents.vertices, " ".join([digits] * 3)
    if contents.colors is not None:
        rows, form = np.hstack([contents.vertices, contents.colors]), form + " %.4g %.4g %.4g"
    text = (f"v {form}\n" * len(rows)) % tuple(rows.ravel().tolist())
    if contents.faces is not None:
        text += ("f %d %d %d\n" * len(contents.faces)) % tuple((contents.faces + 1).ravel().tolist())
    return text.encode()
