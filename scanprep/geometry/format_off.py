"""OFF and its variants with colours and normals (COFF, NOFF, CNOFF); ascii only."""
from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from .format_common import Contents, Lines, MeshFileError, as_bytes, polygons, quote, text_rows, three_numbers
from .format_ply import Element, Property, ascii_element


def read(path: Path, data: bytes) -> Contents:
    """The vertices, polygons as triangles, normals and vertex colours of an OFF file."""
    lines = Lines(path, data, comment=b"#")
    head = lines.text[0].split() if len(lines) else [b""]
    kind = re.fullmatch(rb"(ST)?(C)?(N)?OFF", head[0])
    if kind is None:
        raise MeshFileError(f"{path}: expected a file that begins with OFF or COFF, found {quote(data[:20])}")
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
        colors = table[:, width:width + 3] / (255 if table[:, width:width + 3].max(initial=0) > 1 else 1)
        colors = np.clip(colors, 0, 1)
    place += n
    if place + f != len(lines):
        found = len(lines) - place
        raise MeshFileError(f"{path}: {'truncated: ' if found < f else ''}expected {f} faces after {n} vertices, "
                            f"found {found} lines")
    face = Element("face", f, (Property("corners", "i4", "u1"),))                 # as in PLY; what follows is skipped
    sizes, corners = ascii_element(lines, face, place)[0]["corners"]
    faces = polygons(path, sizes, corners, n, lines.numbers[place:place + f])
    return Contents(table[:, :3], faces, table[:, 3:6] if kind[3] else None, colors)


def encode(contents: Contents, double: bool) -> bytes:
    """An OFF file, or COFF where there are colours."""
    assert contents.faces is not None, "an OFF file is written for meshes"
    kind, form, columns = "OFF", three_numbers(double), [contents.vertices]
    if contents.colors is not None:
        kind, form = "COFF", form + " %d %d %d 255"
        columns.append(as_bytes(contents.colors))
    return (f"{kind}\n{len(contents.vertices)} {len(contents.faces)} 0\n" + text_rows(form, *columns)
            + text_rows("3 %d %d %d", contents.faces)).encode()
