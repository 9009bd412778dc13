"""Files of meshes and points, with errors that say what is wrong.

Vertices keep the order of the file. Only along seams, where vertices are repeated for flat shading or textures and so
cut the surface apart, equal places become one vertex, and a note says so. Coordinates become metres: most files do not
say their unit, so the caller does or metres are assumed, with a warning where that would make a giant or a dwarf.
"""
from __future__ import annotations

import gzip
import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from . import format_glb, format_pcd, format_ply, format_stl, format_text, storage
from .format_common import UNITS, Contents, MeshFileError, check_extent, load_bytes, metres_per_unit
from .mesh import Mesh
from .sanitise import sanitise
from .seams import merged_mean, seams_closed
from .thinning import thin_scan

__all__ = ["UNITS", "MeshFileError", "PointCloud", "Registered", "common_unit", "list_meshes", "name_of", "read_mesh",
           "read_points", "read_registered", "read_scan", "read_scan_mesh", "write_mesh", "write_points"]

Precision = Literal["double", "single"]

POINT_ENDINGS = (".xyz", ".pcd", ".txt", ".pts")


# an ending has a letter and no space: `.05` and `.01 anna` belong to the name; some endings are two
_ENDING = re.compile(r"\.[0-9a-z]*[a-z][0-9a-z]*(\.gz)?$|\.(landmarks|mrk|betas)\.json$", re.IGNORECASE)


def name_of(path: str | Path) -> str:
    """What the thing in a file is called: the name of the file without its ending, all other dots kept.

    Parameters
    ----------
    path : str or Path
        Of a scan, mesh, picture, landmark file ...; a packed one (`.ply.gz`) counts as what it holds.

    Returns
    -------
    str

    Examples
    --------
    >>> name_of("scans/2024.05.01 anna.ply"), name_of("anna.v2.ply.gz"), name_of("anna.landmarks.json")
    ('2024.05.01 anna', 'anna.v2', 'anna')
    """
    name = Path(path).name
    return _ENDING.sub("", name) or name


class _Format(NamedTuple):
    read: Callable[[Path, bytes], Contents]
    encode: Callable[[Contents, bool], bytes]         # with coordinates in double precision, or not


_PLY, _ROWS = _Format(format_ply.read, format_ply.encode), _Format(format_text.read_xyz, format_text.encode_xyz)
_MESHES = {".ply": _PLY, ".obj": _Format(format_text.read_obj, format_text.encode_obj),
           ".stl": _Format(format_stl.read, format_stl.encode),
           ".off": _Format(format_text.read_off, format_text.encode_off),
           ".glb": _Format(format_glb.read, format_glb.encode)}
_POINTS = {".ply": _PLY, ".pcd": _Format(format_pcd.read, format_pcd.encode), ".xyz": _ROWS, ".txt": _ROWS,
           ".pts": _ROWS}


def read_mesh(path: str | Path, unit: str | None = None) -> Mesh:
    """Read a triangle mesh; polygons are cut into triangles.

    Parameters
    ----------
    path : str or Path
        PLY, OBJ, STL, OFF or GLB, also packed as `.ply.gz`.
    unit : 'm', 'mm', 'cm' or 'in', optional
        Unit of the file. When it is not given: the one other than metres in which the mesh is as large as a person,
        with a UserWarning; else metres, with one where it would be larger than 10 m or smaller than 0.1 m.

    Returns
    -------
    Mesh
        In metres. From STL, which has no vertices of its own, equal corners make one vertex. In other formats the
        borders that run through the very same places are closed: a vertex that is repeated there becomes the first
        of its place, with the mean of their colours, and `of_file` tells which. Other vertices stay as they are. A
        UserWarning says so, and names the objects of a file that holds several.

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
        mesh = _seamless(path, Mesh(contents.vertices, contents.faces, contents.colors))
    except ValueError as error:
        raise MeshFileError(f"{path}: {error}") from None
    if len(contents.objects) > 1:
        told = ", ".join(f"{name} ({count} triangles)" for name, count in contents.objects[:6])
        more = ", ..." if len(contents.objects) > 6 else ""
        warnings.warn(f"{path}: {len(contents.objects)} objects were taken for one mesh: {told}{more}", stacklevel=2)
    scale = metres_per_unit(path, mesh.vertices, unit)
    return mesh if scale == 1 else mesh.with_vertices(scale * mesh.vertices)


def _seamless(path: Path, mesh: Mesh) -> Mesh:
    """The mesh with its seams closed, if it has any."""
    vertex_of = seams_closed(mesh.vertices, mesh.faces)
    if vertex_of is None:
        return mesh
    _, first = np.unique(vertex_of, return_index=True)
    colors = None if mesh.colors is None else merged_mean(mesh.colors, vertex_of)
    warnings.warn(f"{path}: {len(vertex_of) - len(first)} of {len(vertex_of)} vertices repeat others along seams "
                  "(flat shading or textures) and were merged with them", stacklevel=3)
    return Mesh(mesh.vertices[first], vertex_of[mesh.faces], colors, vertex_of)


def write_mesh(path: str | Path, mesh: Mesh, precision: Precision = "double") -> None:
    """Write a mesh in metres, whole or not at all, in the format its name ends in.

    Parameters
    ----------
    path : str or Path
        `.ply` (binary), `.ply.gz`, `.obj`, `.stl`, `.off` or `.glb`.
    mesh : Mesh
    precision : 'double' or 'single'
        Of the coordinates: with 'double' a PLY file gives back the very same numbers. STL and GLB hold single
        precision whatever is said here, a tenth of a micrometre at the size of a person.

    Raises
    ------
    MeshFileError
        A name that ends in no known format.
    """
    _write(Path(path), Contents(mesh.vertices, mesh.faces, None, mesh.colors), precision, _MESHES)


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points of a surface."""

    points: np.ndarray                      # (n, 3), metres
    normals: np.ndarray | None = None       # (n, 3), unit
    colors: np.ndarray | None = None        # (n, 3) in [0, 1]


def read_points(path: str | Path, unit: str | None = None) -> PointCloud:
    """Read points, or the vertices of a mesh.

    Parameters
    ----------
    path : str or Path
        PLY, PCD, text (`.xyz`, `.txt`, `.pts`) or any format of `read_mesh`.
    unit : 'm', 'mm', 'cm' or 'in', optional
        As for `read_mesh`.

    Returns
    -------
    PointCloud
        Normals are those of the file, zero where they are not finite, or of the triangles where there are triangles.

    Raises
    ------
    MeshFileError
        Missing, truncated or of another format, no points, a coordinate that is not finite.
    """
    path = Path(path)
    contents = _read(path, {**_MESHES, **_POINTS})
    bad = np.flatnonzero(~np.isfinite(contents.vertices).all(axis=1))
    if len(bad):
        raise MeshFileError(f"{path}: {len(bad)} points are not finite, the first is point {bad[0]}")
    points = metres_per_unit(path, contents.vertices, unit) * contents.vertices
    normals = contents.normals
    if normals is not None:
        normals = np.where(np.isfinite(normals).all(axis=1, keepdims=True), normals, 0.0)
    if normals is None and contents.faces is not None and len(contents.faces):
        normals = Mesh(points, contents.faces).vertex_normals
    return PointCloud(points, normals, contents.colors)


def read_scan_mesh(path: str | Path, unit: str | None = None) -> Mesh:
    """A mesh as a scan: thinned where it is finer than any work needs, its triangles made sound; both are told."""
    return sanitise(thin_scan(read_mesh(path, unit), str(path)), str(path))


def read_scan(path: str | Path, unit: str | None = None) -> Mesh | np.ndarray:
    """A scan as a mesh, its triangles made sound (`sanitise`), or as points (n, 3) where the file has no triangles."""
    if Path(path).suffix.lower() in POINT_ENDINGS:
        return read_points(path, unit).points
    try:
        return read_scan_mesh(path, unit)
    except ValueError as error:
        if "no faces" in str(error):
            return read_points(path, unit).points
        raise


def common_unit(paths: Sequence[Path], unit: str | None = None) -> str | None:
    """One unit for files that belong together, as views, frames or registered meshes do.

    That given, else that of the first file that can be read, where it tells one (`likely_unit`), with a UserWarning.
    A smaller part of a person, or a child, is then in the unit of the others.
    """
    for path in () if unit is not None else paths:
        try:
            points = read_points(path, unit="m").points
        except MeshFileError:                # whoever reads it says so
            continue
        scale = metres_per_unit(path, points, None)
        return next((name for name in UNITS if UNITS[name] == scale), None) if scale != 1 else None
    return unit


def write_points(path: str | Path, cloud: PointCloud) -> None:
    """Write points in metres, whole or not at all: `.ply`, `.ply.gz`, `.pcd`, `.xyz`, `.txt` or `.pts`."""
    _write(Path(path), Contents(cloud.points, None, cloud.normals, cloud.colors), "double", _POINTS)


def is_scan(path: Path) -> bool:
    """Whether a name is that of a mesh or a point cloud."""
    return _suffix(path) in {**_MESHES, **_POINTS}


def list_meshes(folder: str | Path) -> list[Path]:
    """The mesh files of a folder, sorted by name, at least one; of a RegisteredSet those in its `meshes`."""
    folder = Path(folder)
    if not folder.is_dir():
        problem = "expected a folder, found a file" if folder.exists() else "no such folder"
        raise MeshFileError(f"{folder}: {problem}")
    inside = folder / "meshes" if (folder / "set.json").is_file() else folder
    paths = sorted(p for p in inside.glob("*") if not p.name.startswith(".") and _suffix(p) in _MESHES)
    if not paths:
        raise MeshFileError(f"{inside}: expected meshes ({', '.join(_MESHES)}), found none")
    return paths


class Registered(NamedTuple):
    """Meshes that share their triangles."""

    faces: np.ndarray           # (F, 3)
    vertices: np.ndarray        # (M, N, 3), metres
    names: tuple[str, ...]      # of the files, without their endings


def read_registered(folder: str | Path, unit: str | None = None) -> Registered:
    """Every mesh of a folder, or of a RegisteredSet, sorted by name; MeshFileError where one has other triangles."""
    paths = list_meshes(folder)
    unit, meshes = common_unit(paths, unit), []
    for path in paths:
        meshes.append(read_mesh(path, unit))
        check_same_topology(path, meshes[-1], paths[0], meshes[0])
    return Registered(meshes[0].faces, np.stack([m.vertices for m in meshes]),
                      tuple(map(name_of, paths)))


def check_same_topology(path: Path, mesh: Mesh, first_path: Path, first: Mesh) -> None:
    """Raise MeshFileError where a mesh does not have the triangles of the first one, saying how they differ."""
    mine, theirs = (f"{len(m.vertices)} vertices and {len(m.faces)} faces" for m in (mesh, first))
    if mine != theirs:
        raise MeshFileError(f"{path}: expected the topology of {first_path.name}, {theirs}; found {mine}")
    if not np.array_equal(mesh.faces, first.faces):
        k = int(np.flatnonzero((mesh.faces != first.faces).any(axis=1))[0])
        raise MeshFileError(f"{path}: expected the faces of {first_path.name} in their order; there are as many, "
                            f"but from face {k} on they are others (another order, or edges flipped): "
                            f"expected {first.faces[k].tolist()}, found {mesh.faces[k].tolist()}")


def _suffix(path: Path) -> str:
    suffixes = [s.lower() for s in path.suffixes]
    return suffixes[-2] if len(suffixes) > 1 and suffixes[-1] == ".gz" else "".join(suffixes[-1:])


def _format(path: Path, formats: dict[str, _Format]) -> _Format:
    suffix = _suffix(path)
    if suffix not in formats:
        found = f"'{suffix}'" if suffix else "none"
        raise MeshFileError(f"{path}: expected a name ending in {', '.join(formats)}, found {found}")
    return formats[suffix]


def _read(path: Path, formats: dict[str, _Format]) -> Contents:
    if path.is_file():
        _format(path, formats)           # a wrong name is told even of a file that holds nothing
    data = load_bytes(path)
    contents = _format(path, formats).read(path, data)
    if not len(contents.vertices):
        raise MeshFileError(f"{path}: the file holds no vertices")
    check_extent(path, "vertex", contents.vertices)
    if contents.colors is not None and not np.isfinite(contents.colors).all():
        raise MeshFileError(f"{path}: expected colours that are finite numbers, found others")
    return contents


def _write(path: Path, contents: Contents, precision: Precision, formats: dict[str, _Format]) -> None:
    if precision not in ("double", "single"):
        raise ValueError(f"precision: expected 'double' or 'single', got {precision!r}")
    data = _format(path, formats).encode(contents, precision == "double")
    if path.suffix.lower() == ".gz":
        data = gzip.compress(data, compresslevel=6, mtime=0)
    storage.write(path, data)
