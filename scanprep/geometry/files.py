"""Files of meshes: PLY, OBJ, STL, OFF and GLB in, the same out, with errors that say what is wrong.

Vertices keep the order of the file. Coordinates become metres: a file does not say its unit, so either the
caller does or metres are assumed, with a warning where that would make a giant or a dwarf.
"""
from __future__ import annotations

import gzip
import warnings
from pathlib import Path
from types import ModuleType
from typing import Literal

import numpy as np

from . import storage
from .formats import obj, ply
from .formats.common import Contents, MeshFileError, load_bytes
from .mesh import Mesh

__all__ = ["MeshFileError", "read_mesh", "write_mesh"]

UNITS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "in": 0.0254}
_MESHES: dict[str, ModuleType] = {".ply": ply, ".obj": obj}


def read_mesh(path: str | Path, unit: str | None = None) -> Mesh:
    """Read a triangle mesh; polygons are cut into triangles.

    Parameters
    ----------
    path : str or Path
        PLY, OBJ, STL, OFF or GLB, also packed as `.ply.gz`.
    unit : 'm', 'mm', 'cm' or 'in', optional
        Unit of the file. When it is not given metres are assumed, with a UserWarning where the mesh would be
        larger than 10 m or smaller than 0.1 m.

    Returns
    -------
    Mesh
        In metres.

    Raises
    ------
    MeshFileError
        Missing, truncated or of another format, no triangles, a coordinate that is not finite, a face that
        refers to a vertex that is not there.
    """
    path = Path(path)
    contents = _read(path, _MESHES)
    if contents.faces is None or not len(contents.faces):
        raise MeshFileError(f"{path}: expected a mesh, found {len(contents.vertices)} vertices and no faces")
    try:
        mesh = Mesh(contents.vertices, contents.faces, contents.colors)
    except ValueError as error:
        raise MeshFileError(f"{path}: {error}") from None
    scale = metres_per_unit(path, mesh.vertices, unit)
    return mesh if scale == 1 else mesh.with_vertices(scale * mesh.vertices)


def write_mesh(path: str | Path, mesh: Mesh, precision: Literal["double", "single"] = "double") -> None:
    """Write a mesh in metres, whole or not at all, in the format its name ends in.

    Parameters
    ----------
    path : str or Path
        `.ply` (binary), `.ply.gz`, `.obj`, `.stl`, `.off` or `.glb`.
    mesh : Mesh
    precision : 'double' or 'single'
        Of the coordinates: with 'double' a PLY file gives back the very same numbers. STL and GLB hold single
        precision whatever is said here, half a micrometre at the size of a person.

    Raises
    ------
    MeshFileError
        A name that ends in no known format.
    """
    path = Path(path)
    if precision not in ("double", "single"):
        raise ValueError(f"precision: expected 'double' or 'single', got {precision!r}")
    _write(path, Contents(mesh.vertices, mesh.faces, None, mesh.colors), precision == "double", _MESHES)


def metres_per_unit(path: Path, points: np.ndarray, unit: str | None) -> float:
    """What to multiply the coordinates of a file with; warns where metres are assumed and hard to believe."""
    if unit is not None:
        if unit not in UNITS:
            raise ValueError(f"unit: expected one of {', '.join(UNITS)}, got {unit!r}")
        return UNITS[unit]
    extent = float(np.ptp(points, axis=0).max()) if len(points) else 1.0
    if extent > 10:
        likely = min(("mm", "cm", "in"), key=lambda u: abs(np.log(extent * UNITS[u] / 1.7)))
        warnings.warn(f"{path}: {extent:.4g} m from end to end when read as metres; "
                      f"it looks like unit='{likely}' ({extent * UNITS[likely]:.3g} m)", stacklevel=3)
    elif 0 < extent < 0.1:
        warnings.warn(f"{path}: {extent:.2g} m from end to end when read as metres; it looks as if millimetres "
                      f"had been divided by 1000 twice ({extent * 1000:.3g} m)", stacklevel=3)
    return 1.0


def _format(path: Path, formats: dict[str, ModuleType]) -> ModuleType:
    suffixes = [s.lower() for s in path.suffixes]
    suffix = suffixes[-2] if len(suffixes) > 1 and suffixes[-1] == ".gz" else "".join(suffixes[-1:])
    if suffix not in formats:
        raise MeshFileError(f"{path}: expected a name ending in {', '.join(formats)}, found '{suffix}'")
    return formats[suffix]


def _read(path: Path, formats: dict[str, ModuleType]) -> Contents:
    reader = _format(path, formats)
    contents = reader.read(path, load_bytes(path))
    if not len(contents.vertices):
        raise MeshFileError(f"{path}: the file holds no vertices")
    return contents


def _write(path: Path, contents: Contents, double: bool, formats: dict[str, ModuleType]) -> None:
    data = _format(path, formats).encode(contents, double)
    if path.suffix.lower() == ".gz":
        data = gzip.compress(data, mtime=0)
    with storage.writing(path) as beside:
        beside.write_bytes(data)
