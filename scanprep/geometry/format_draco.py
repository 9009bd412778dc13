"""Draco, Google's compression of meshes and clouds: in files of its own, and inside glTF. Its library is an extra."""
from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from . import storage
from .format_common import Contents, MeshFileError, as_colors, polygons


def read(path: Path, data: bytes) -> Contents:
    """Read points, and triangles, normals and colours if any, of a `.drc` file."""
    mesh = decode_draco(path, data)
    with storage.taking_apart(path, "a whole Draco file", MeshFileError):
        vertices = np.asarray(mesh.points, dtype=np.float64).reshape(-1, 3)
        faces = getattr(mesh, "faces", None)
        if faces is not None and len(faces):
            faces = polygons(path, np.full(len(faces), 3), np.asarray(faces).ravel(), len(vertices))
        colors = getattr(mesh, "colors", None)
        colors = None if colors is None or not len(colors) else as_colors(np.asarray(colors)[:, :3], True)
        normals = getattr(mesh, "normals", None)
        return Contents(vertices, faces, None if normals is None or not len(normals) else np.asarray(normals), colors)


def decode_draco(path: Path, data: bytes) -> Any:
    """Decode Draco data; MeshFileError if it is damaged or the library is missing."""
    try:
        import DracoPy
    except ImportError:
        raise MeshFileError(f"{path}: it is compressed by Draco, whose library is not installed: "
                            "pip install 'scapekit[draco]'") from None
    with storage.taking_apart(path, "data compressed by Draco", MeshFileError):
        return DracoPy.decode(data)
