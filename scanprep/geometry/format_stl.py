"""STL, ascii and binary. Each triangle has its own corners there; equal ones become one vertex."""
from __future__ import annotations

from pathlib import Path

import numpy as np

from .format_common import Contents, Lines, MeshFileError, quote

_HEADER = 80
_FACET = np.dtype([("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read(path: Path, data: bytes) -> Contents:
    """The triangles of an STL file; corners with the very same coordinates are one vertex, in order of use."""
    corners = _ascii(path, data) if _is_ascii(data) else _binary(path, data)
    rows = np.ascontiguousarray(corners.reshape(-1, 3) + 0.0)            # + 0.0: minus zero is zero
    _, first, of_corner = np.unique(rows.view(np.dtype((np.void, 24))).ravel(), return_index=True,
                                    return_inverse=True)
    order = np.argsort(first)
    faces = np.argsort(order)[of_corner].reshape(-1, 3)
    return Contents(rows[first[order]], faces)


def _is_ascii(data: bytes) -> bool:
    """Binary files may begin with 'solid' too; their length gives them away."""
    if not data.lstrip().startswith(b"solid"):
        return False
    return len(data) != _length(data) and b"\0" not in data[:_HEADER]


def _length(data: bytes) -> int:
    """The length of a binary file according to its count of triangles."""
    count = int(np.frombuffer(data, "<u4", 1, _HEADER)[0]) if len(data) >= _HEADER + 4 else 0
    return _HEADER + 4 + count * _FACET.itemsize


def _binary(path: Path, data: bytes) -> np.ndarray:
    if len(data) < _HEADER + 4:
        raise MeshFileError(f"{path}: expected an STL file, ascii or with a header of {_HEADER + 4} bytes, "
                            f"found {len(data)} bytes {quote(data[:20])}")
    if len(data) < _length(data):
        count = (_length(data) - _HEADER - 4) // _FACET.itemsize
        raise MeshFileError(f"{path}: truncated or not an STL file: expected {count} triangles, "
                            f"found {(len(data) - _HEADER - 4) // _FACET.itemsize}")
    if data[_length(data):].strip(b"\0\r\n\t "):
        raise MeshFileError(f"{path}: expected {_length(data)} bytes of binary STL by its count of triangles, "
                            f"found {len(data)}")
    facets = np.frombuffer(data, _FACET, (_length(data) - _HEADER - 4) // _FACET.itemsize, _HEADER + 4)
    return facets["corners"].astype(np.float64)


def _ascii(path: Path, data: bytes) -> np.ndarray:
    lines = Lines(path, data)
    starts = [line.split(None, 1)[0].lower() for line in lines.text]
    rows = [i for i, word in enumerate(starts) if word == b"vertex"]
    if b"endsolid" not in starts:
        raise MeshFileError(f"{path}: truncated: expected 'endsolid' at the end of the ascii STL file, "
                            f"found {quote(lines.text[-1].strip())}")
    facets = starts.count(b"facet")
    if len(rows) != 3 * facets:
        raise MeshFileError(f"{path}: expected 3 vertex lines for each of {facets} facets, found {len(rows)}")
    corners = []
    for row in rows:
        try:
            x, y, z = map(float, lines.text[row].split()[1:])
        except ValueError:
            raise lines.fail(row, "'vertex x y z'") from None
        corners.append((x, y, z))
    return np.array(corners).reshape(-1, 3, 3)


def encode(contents: Contents, double: bool) -> bytes:
    """A binary STL file, which holds single precision whatever `double` says."""
    assert contents.faces is not None, "an STL file is made of triangles"
    corners = contents.vertices[contents.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    facets = np.zeros(len(corners), dtype=_FACET)
    facets["corners"] = corners
    facets["normal"] = np.divide(normal, length, out=np.zeros_like(normal), where=length > 0)
    return b"binary STL, metres".ljust(_HEADER) + np.array(len(facets), dtype="<u4").tobytes() + facets.tobytes()
