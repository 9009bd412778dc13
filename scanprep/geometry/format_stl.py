"""Read and write STL, ascii and binary. Triangles have their own corners; equal ones become one vertex."""
from __future__ import annotations

import contextlib
import warnings
from pathlib import Path

import numpy as np

from .format_common import Contents, Lines, MeshFileError, quote

_HEADER = 80             # bytes of free text before the count
_FACET = np.dtype([("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read(path: Path, data: bytes) -> Contents:
    """Read the triangles of an STL file; corners with equal coordinates become one vertex, in order of use."""
    corners = _ascii(path, data) if _is_ascii(data) else _binary(path, data)
    rows = np.ascontiguousarray(corners.reshape(-1, 3) + 0.0)            # + 0.0: minus zero is zero
    _, first, of_corner = np.unique(rows.view(np.dtype((np.void, 24))).ravel(), return_index=True,
                                    return_inverse=True)
    order = np.argsort(first)
    faces = np.argsort(order)[of_corner].reshape(-1, 3)
    return Contents(rows[first[order]], faces)


def _is_ascii(data: bytes) -> bool:
    """Test for ascii: binary files may also begin with 'solid', but contain zero bytes or have the expected length."""
    if data.lstrip()[:5].lower() != b"solid":
        return False
    return len(data) != _length(data) and b"\0" not in data[:_HEADER + 4 + 10 * _FACET.itemsize]


def _length(data: bytes) -> int:
    """Return the length of a binary file according to its count of triangles."""
    count = int(np.frombuffer(data, "<u4", 1, _HEADER)[0]) if len(data) >= _HEADER + 4 else 0
    return _HEADER + 4 + count * _FACET.itemsize


def _binary(path: Path, data: bytes) -> np.ndarray:
    """Read the corners (F, 3, 3) of a binary file."""
    if len(data) < _HEADER + 4:
        raise MeshFileError(f"{path}: expected an STL file, ascii or with a header of {_HEADER + 4} bytes, "
                            f"found {len(data)} bytes {quote(data[:20])}")
    if len(data) < _length(data):
        count = (_length(data) - _HEADER - 4) // _FACET.itemsize
        raise MeshFileError(f"{path}: truncated or not an STL file: expected {count} triangles, "
                            f"found {(len(data) - _HEADER - 4) // _FACET.itemsize}")
    if rest := len(data[_length(data):].strip(b"\0\r\n\t ")):
        if _length(data) == _HEADER + 4:
            raise MeshFileError(f"{path}: its header says that it holds no triangles, but {rest} bytes follow")
        count = (_length(data) - _HEADER - 4) // _FACET.itemsize
        warnings.warn(f"{path}: {rest} bytes behind the {count} triangles that its header tells of were left out",
                      stacklevel=2)
    facets = np.frombuffer(data, _FACET, (_length(data) - _HEADER - 4) // _FACET.itemsize, _HEADER + 4)
    return facets["corners"].astype(np.float64)


def _ascii(path: Path, data: bytes) -> np.ndarray:
    """Read the corners (F, 3, 3) of a text file."""
    lines = Lines(path, data)
    starts = [line.lstrip()[:8].lower().split()[0] for line in lines.text]
    rows = [i for i, word in enumerate(starts) if word == b"vertex"]
    if b"endsolid" not in starts:
        raise MeshFileError(f"{path}: truncated: expected 'endsolid' at the end of the ascii STL file, "
                            f"found {quote(lines.text[-1].strip())}")
    facets = starts.count(b"facet")
    if len(rows) != 3 * facets:
        raise MeshFileError(f"{path}: expected 3 vertex lines for each of {facets} facets, found {len(rows)}")
    text = [lines.text[row].lstrip()[len("vertex"):] for row in rows]
    with contextlib.suppress(ValueError):
        table = np.loadtxt(text, ndmin=2, comments=None) if any(map(bytes.strip, text)) else np.zeros((0, 3))
        if table.shape[1] == 3 and len(table) == len(rows):
            return table.reshape(-1, 3, 3)
    bad = next((row for row, line in zip(rows, text, strict=True) if not _is_vertex(line)), rows[0])
    raise lines.fail(bad, "'vertex x y z'")


def _is_vertex(line: bytes) -> bool:
    """Test whether a line holds three numbers."""
    try:
        return len([float(word) for word in line.split()]) == 3
    except ValueError:
        return False


def encode(contents: Contents, double: bool) -> bytes:
    """Encode a binary STL file, always in single precision."""
    assert contents.faces is not None, "an STL file is made of triangles"
    corners = contents.vertices[contents.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    facets = np.zeros(len(corners), dtype=_FACET)
    facets["corners"] = corners
    facets["normal"] = np.divide(normal, length, out=np.zeros_like(normal), where=length > 0)
    return b"binary STL, metres".ljust(_HEADER) + np.array(len(facets), dtype="<u4").tobytes() + facets.tobytes()
