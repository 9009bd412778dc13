"""Points as text, one a line: `x y z`, then normals or colours."""
from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from .format_common import Contents, Lines, MeshFileError, text_rows, three_numbers


def read(path: Path, data: bytes) -> Contents:
    """The points of a text file; a first line that is a heading or a count is skipped.

    Three more columns are normals when every row of them has length one, otherwise colours, 0..255 or 0..1;
    both may follow, in either order.
    """
    if b"\0" in data:
        raise MeshFileError(f"{path}: expected text with lines 'x y z', found a binary file")
    lines = Lines(path, re.sub(rb"[,;]", b" ", data), comment=b"#")
    first = 1 if len(lines) and not _is_point(lines.text[0]) and _is_heading(lines.text[0]) else 0
    if len(lines) == first:
        raise MeshFileError(f"{path}: expected lines 'x y z', found none")
    table = lines.table(range(first, len(lines)), "numbers 'x y z', as many on every line", 3)
    normals = colors = None
    for start in range(3, table.shape[1] - 2, 3):
        triple = table[:, start:start + 3]
        if normals is None and np.allclose(np.linalg.norm(triple, axis=1), 1, atol=1e-2):
            normals = triple
        elif colors is None and triple.min() >= 0 and triple.max() <= 255:
            colors = triple / (255 if triple.max() > 1 else 1)
    return Contents(table[:, :3], None, normals, colors)


def _is_point(line: bytes) -> bool:
    try:
        return len([float(word) for word in line.split()]) >= 3
    except ValueError:
        return False


def _is_heading(line: bytes) -> bool:
    words = line.split()
    return (len(words) == 1 and words[0].isdigit()) or words[0].lstrip(b'/"').lower() in (b"x", b"")


def encode(contents: Contents, double: bool) -> bytes:
    """Lines of coordinates, then normals, then colours 0..255."""
    form, columns = three_numbers(double), [contents.vertices]
    if contents.normals is not None:
        form, columns = form + " %.7g %.7g %.7g", [*columns, contents.normals]
    if contents.colors is not None:
        form, columns = form + " %.6g %.6g %.6g", [*columns, 255 * contents.colors]
    return text_rows(form, *columns).encode()
