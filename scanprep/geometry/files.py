"""Read and write files of meshes and points, with errors that say what is wrong.

Vertices keep the order of the file. Along seams, where vertices are repeated for flat shading or textures, equal
positions are merged, with a warning. Coordinates become metres. Most files do not say their unit: the caller does, or
metres are assumed, with a warning if that makes a giant or a dwarf.
"""
from __future__ import annotations

import gzip
import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from ..words import number_of
from . import format_glb, format_pcd, format_ply, format_stl, format_text, storage
from .budget import reading
from .format_common import (
    UNITS,
    Contents,
    EmptyFileError,
    MeshFileError,
    check_extent,
    load_bytes,
    metres_per_unit,
)
from .mesh import Mesh, take_any_mesh
from .sanitise import sanitise
from .seams import mean_of_merged, seams_closed
from .thinning import thin_scan

__all__ = ["ENDINGS", "SCAN_ENDINGS", "UNITS", "EmptyFileError", "MeshFileError", "PointCloud", "Registered",
           "common_unit", "ending_of", "list_files", "list_meshes", "name_of", "read_mesh", "read_points",
           "read_registered", "read_scan", "read_scan_mesh", "read_view", "write_mesh", "write_points"]

Precision = Literal["double", "single"]


# an ending has a letter and no space: `.05` and `.01 anna` belong to the name; some endings are double
_ENDING = re.compile(r"\.[0-9a-z]*[a-z][0-9a-z]*(\.gz)?$|\.(landmarks|mrk|betas)\.json$", re.IGNORECASE)


def name_of(path: str | Path) -> str:
    """Return the name of a file without its ending; all other dots are kept.

    Parameters
    ----------
    path : str or Path
        Path of a scan, mesh, picture or landmark file; `.ply.gz` counts as one ending.

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


# readers and writers by ending: a new format needs a module and a line here; points never have triangles
_MESH_READERS: dict[str, Callable[[Path, bytes], Contents]] = {
    ".ply": format_ply.read, ".obj": format_text.read_obj, ".stl": format_stl.read, ".off": format_text.read_off,
    ".glb": format_glb.read, ".gltf": format_glb.read_gltf}
_READERS = {**_MESH_READERS, ".pcd": format_pcd.read,
            **dict.fromkeys((".xyz", ".pts", ".txt", ".asc", ".csv"), format_text.read_xyz)}
_Encode = Callable[[Contents, bool], bytes]                         # (contents, double precision)
_MESH_WRITERS: dict[str, _Encode] = {
    ".ply": format_ply.encode, ".obj": format_text.encode_obj, ".stl": format_stl.encode,
    ".off": format_text.encode_off, ".glb": format_glb.encode}
_POINT_WRITERS: dict[str, _Encode] = {
    ".ply": format_ply.encode, ".pcd": format_pcd.encode,
    **dict.fromkeys((".xyz", ".pts", ".txt"), format_text.encode_xyz)}

ENDINGS = tuple(_READERS)
# formats that are not read, with the export of a program that reads them
_EXPORTS = {**dict.fromkeys((".fbx", ".blend", ".usd", ".usda", ".usdc", ".usdz"),
                            "Blender (File > Open or Import, then Export) makes GLB of it"),
            ".dae": "Blender up to 4.5 (File > Import, then Export) makes GLB of it",
            **dict.fromkeys((".3mf", ".3ds", ".x3d", ".x3dv", ".wrl", ".ctm", ".qobj"),
                            "MeshLab (File > Import Mesh, then Export Mesh As) makes PLY of it"),
            **dict.fromkeys((".e57", ".ptx", ".las", ".laz"), "CloudCompare (File > Save as) makes PLY of it"),
            ".drc": "draco_decoder (-i FILE.drc -o FILE.ply) makes PLY of it"}
# in a folder, text may be notes and tables as well as points
SCAN_ENDINGS = tuple(ending for ending in ENDINGS if ending not in (".txt", ".csv"))


def ending_of(path: str | Path) -> str:
    """Return the ending of a name in lower case, without `.gz`; empty if there is none."""
    path = Path(path)
    return (Path(path.stem) if path.suffix.lower() == ".gz" and Path(path.stem).suffix else path).suffix.lower()


def read_mesh(path: str | Path, unit: str | None = None) -> Mesh:
    """Read a triangle mesh; polygons are triangulated.

    Parameters
    ----------
    path : str or Path
        PLY, OBJ, STL, OFF, GLB or glTF, also packed as `.ply.gz`.
    unit : 'm', 'mm', 'cm' or 'in', optional
        Unit of the file. By default the unit in which the mesh is as large as a person, with a UserWarning. Else
        metres, with a UserWarning above 10 m or below 0.1 m.

    Returns
    -------
    Mesh
        Vertices (N, 3), metres. A UserWarning reports each of these changes. Corners of an STL file at the same
        position become one vertex. Vertices repeated along seams are merged into the first one, with the mean of their
        colours; `of_file` maps the numbers. Vertices that are not finite are dropped with their triangles. Several
        objects become one mesh.

    Raises
    ------
    MeshFileError
        A missing or truncated file, another format, no triangles, or a face with a vertex that does not exist.

    Examples
    --------
    >>> write_mesh("triangle.ply", Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]))
    >>> read_mesh("triangle.ply", unit="m").vertices.shape
    (3, 3)
    """
    path = Path(path)
    contents = _read(path)
    if not _has_faces(contents):
        raise MeshFileError(f"{path}: expected a mesh, found {len(contents.vertices)} vertices and no faces")
    return _mesh(path, contents, unit)


def _has_faces(contents: Contents) -> bool:
    """Test whether a file has triangles."""
    return contents.faces is not None and len(contents.faces) > 0


def _mesh(path: Path, contents: Contents, unit: str | None) -> Mesh:
    """Make the mesh of a file, in metres and with its seams closed."""
    assert contents.faces is not None, "only files with triangles are meshes"
    try:
        mesh = Mesh(contents.vertices, contents.faces, contents.colors, contents.of_file, contents.up)
    except ValueError as error:
        raise MeshFileError(f"{path}: {error}") from None
    mesh = _seamless(path, mesh)
    if len(contents.objects) > 1:
        listed = ", ".join(f"{name} ({number_of(count, 'triangle')})" for name, count in contents.objects[:6])
        more = ", ..." if len(contents.objects) > 6 else ""
        warnings.warn(f"{path}: {len(contents.objects)} objects were taken for one mesh: {listed}{more}", stacklevel=2)
    scale = metres_per_unit(path, mesh.vertices, unit)
    return mesh if scale == 1 else mesh.with_vertices(scale * mesh.vertices, mesh.up)


def _seamless(path: Path, mesh: Mesh) -> Mesh:
    """Close the seams of a mesh, with a warning; return it as it is if it has none."""
    vertex_of = seams_closed(mesh.vertices, mesh.faces)
    if vertex_of is None:
        return mesh
    _, first = np.unique(vertex_of, return_index=True)
    colors = None if mesh.colors is None else mean_of_merged(mesh.colors, vertex_of)
    warnings.warn(f"{path}: {len(vertex_of) - len(first)} of {len(vertex_of)} vertices repeat others along seams "
                  "(flat shading or textures) and were merged with them", stacklevel=3)
    if mesh.of_file is not None:             # -1: left out before
        vertex_of_file = np.where(mesh.of_file < 0, -1, vertex_of[mesh.of_file])
    else:
        vertex_of_file = vertex_of
    return Mesh(mesh.vertices[first], vertex_of[mesh.faces], colors, vertex_of_file, mesh.up)


@take_any_mesh
def write_mesh(path: str | Path, mesh: Mesh, precision: Precision = "double") -> None:
    """Write a mesh in metres, atomically, in the format of the file's ending.

    Parameters
    ----------
    path : str or Path
        `.ply` (binary), `.ply.gz`, `.obj`, `.stl`, `.off` or `.glb`.
    mesh : Mesh
        The mesh, metres; colours are written where the format has them. What is attached to a body is written with it.
    precision : 'double' or 'single'
        Precision of the coordinates. A 'double' PLY file returns exactly the same numbers. STL and GLB always have
        single precision, a tenth of a micrometre at the size of a person.

    Raises
    ------
    MeshFileError
        An ending of no known format.

    Examples
    --------
    >>> from pathlib import Path
    >>> write_mesh("triangle.obj", Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]))
    >>> Path("triangle.obj").exists()
    True
    """
    mesh = mesh if mesh.attached is None else mesh.attached.mesh(mesh)
    _write(Path(path), Contents(mesh.vertices, mesh.faces, None, mesh.colors, up=mesh.up), precision, _MESH_WRITERS)


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points of a surface, with normals and colours if known."""

    points: np.ndarray                      # (n, 3), metres
    normals: np.ndarray | None = None       # (n, 3), unit
    colors: np.ndarray | None = None        # (n, 3) in [0, 1]


def read_points(path: str | Path, unit: str | None = None) -> PointCloud:
    """Read points, or the vertices of a mesh.

    Parameters
    ----------
    path : str or Path
        PLY, PCD, text (`.xyz`, `.txt`, `.pts`, `.asc`, `.csv`), or any format of `read_mesh`.
    unit : 'm', 'mm', 'cm' or 'in', optional
        As for `read_mesh`.

    Returns
    -------
    PointCloud
        Points (n, 3), metres. Normals (n, 3) are those of the file, zero where they are not finite, else those of the
        triangles if there are any. Points that are not finite are dropped, with a UserWarning.

    Raises
    ------
    MeshFileError
        A missing or truncated file, another format, or no points.

    Examples
    --------
    >>> from pathlib import Path
    >>> _ = Path("cloud.xyz").write_text("0 0 0\\n0.5 0 0\\n0 1.7 0\\n")
    >>> read_points("cloud.xyz", unit="m").points.shape
    (3, 3)
    """
    path = Path(path)
    return _cloud(path, _read(path), unit)


def _cloud(path: Path, contents: Contents, unit: str | None) -> PointCloud:
    """Make the points of a file in metres, with normals from the file or its triangles."""
    points = metres_per_unit(path, contents.vertices, unit) * contents.vertices
    normals = contents.normals
    if normals is not None:
        normals = np.where(np.isfinite(normals).all(axis=1, keepdims=True), normals, 0.0)
    if normals is None and contents.faces is not None and len(contents.faces):
        normals = Mesh(points, contents.faces).vertex_normals
    return PointCloud(points, normals, contents.colors)


def read_scan_mesh(path: str | Path, unit: str | None = None) -> Mesh:
    """Read a mesh as a scan: very fine scans are thinned and bad triangles repaired, both with a warning."""
    path = Path(path)
    storage.check_regular(path, MeshFileError)
    with reading(path, MeshFileError):
        return _sound(path, read_mesh(path, unit))


def _sound(path: Path, mesh: Mesh) -> Mesh:
    """Thin a very fine scan and repair its triangles."""
    return sanitise(thin_scan(mesh, str(path)), str(path))


def read_view(path: str | Path, unit: str | None = None) -> Mesh | PointCloud:
    """Read a scan as `read_scan_mesh` does, or the points of a file without triangles, with normals and colours."""
    path = Path(path)
    contents = _read(path)
    with reading(path, MeshFileError):
        return _sound(path, _mesh(path, contents, unit)) if _has_faces(contents) else _cloud(path, contents, unit)


def read_scan(path: str | Path, unit: str | None = None) -> Mesh | np.ndarray:
    """Read a scan as `read_scan_mesh` does, or points (n, 3), metres, of a file without triangles."""
    view = read_view(path, unit)
    return view if isinstance(view, Mesh) else view.points


def common_unit(paths: Sequence[Path], unit: str | None = None) -> str | None:
    """Find one unit for files that belong together, such as views, frames or registered meshes.

    The given unit, else that of the first readable file if it is not metres (`guess_unit`), with a UserWarning. So a
    view of a smaller part, or a child, gets the unit of the others.
    """
    for path in () if unit is not None else paths:
        try:
            points = read_points(path, unit="m").points
        except MeshFileError:                # reported when the file is read
            continue
        scale = metres_per_unit(path, points, None)
        return next((name for name in UNITS if UNITS[name] == scale), None) if scale != 1 else None
    return unit


def write_points(path: str | Path, cloud: PointCloud) -> None:
    """Write points in metres, atomically: `.ply`, `.ply.gz`, `.pcd`, `.xyz`, `.txt` or `.pts`."""
    contents = Contents(cloud.points, None, cloud.normals, cloud.colors)
    _write(Path(path), contents, "double", _POINT_WRITERS)


def advice(path: Path) -> str:
    """Return how a file of a known format that is not read gets readable; empty for any other file."""
    return _EXPORTS.get(ending_of(path), "")


def is_scan(path: Path) -> bool:
    """Test whether a name is that of a mesh or a point cloud."""
    return ending_of(path) in SCAN_ENDINGS


def list_meshes(folder: str | Path) -> list[Path]:
    """List the mesh files of a folder or RegisteredSet, sorted by name; MeshFileError if there is none."""
    inside = Path(folder) / "meshes" if (Path(folder) / "set.json").is_file() else Path(folder)
    return list_files(inside, lambda path: ending_of(path) in _MESH_READERS, f"meshes ({', '.join(_MESH_READERS)})")


def list_files(folder: Path, wanted: Callable[[Path], bool], least_one_of: str = "") -> list[Path]:
    """List the wanted files of a folder, sorted by name, without hidden ones.

    MeshFileError for a path that is no folder, and for an empty list if `least_one_of` names what is expected.
    """
    if not folder.is_dir():
        problem = "expected a folder, found a file" if folder.exists() else "no such folder"
        raise MeshFileError(f"{folder}: {problem}")
    files = sorted(p for p in folder.iterdir() if p.is_file() and not p.name.startswith(".") and wanted(p))
    if least_one_of and not files:
        raise MeshFileError(f"{folder}: expected {least_one_of}, found none")
    return files


class Registered(NamedTuple):
    """Meshes with shared triangles."""

    faces: np.ndarray           # (F, 3)
    vertices: np.ndarray        # (M, N, 3), metres
    names: tuple[str, ...]      # of the files, without their endings
    up: int | None = None       # axis that points up, if the files say it


def read_registered(folder: str | Path, unit: str | None = None) -> Registered:
    """Read all meshes of a folder or RegisteredSet, sorted by name; MeshFileError for different triangles."""
    paths = list_meshes(folder)
    unit = common_unit(paths, unit)
    first = read_mesh(paths[0], unit)
    vertices = np.empty((len(paths), *first.vertices.shape))
    for place, path in zip(vertices, paths, strict=True):        # of large meshes only the vertices are kept
        mesh = first if path == paths[0] else read_mesh(path, unit)
        check_same_topology(path, mesh, paths[0], first)
        place[:] = mesh.vertices
    return Registered(first.faces, vertices, tuple(map(name_of, paths)), first.up)


def check_same_topology(path: Path, mesh: Mesh, first_path: Path, first: Mesh) -> None:
    """Raise MeshFileError if a mesh does not have the triangles of the first one, and say how they differ."""
    counts, expected = (f"{len(m.vertices)} vertices and {len(m.faces)} faces" for m in (mesh, first))
    if counts != expected:
        raise MeshFileError(f"{path}: expected the topology of {first_path.name}, {expected}; found {counts}")
    if not np.array_equal(mesh.faces, first.faces):
        if any(np.array_equal(np.roll(mesh.faces[:, ::-1], shift, axis=1), first.faces) for shift in range(3)):
            raise MeshFileError(f"{path}: it is inside out: its faces are those of {first_path.name}, turned over")
        k = int(np.flatnonzero((mesh.faces != first.faces).any(axis=1))[0])
        raise MeshFileError(f"{path}: expected the faces of {first_path.name} in their order; there are as many, "
                            f"but from face {k} on they are others (another order, or edges flipped): "
                            f"expected {first.faces[k].tolist()}, found {mesh.faces[k].tolist()}")


def _read(path: Path) -> Contents:
    """Read a file of any format, without values that are not finite."""
    storage.check_regular(path, MeshFileError)
    ending = ending_of(path)
    if ending not in _READERS:           # checked before the contents, which may be empty
        raise MeshFileError(f"{path}: expected a name ending in {', '.join(ENDINGS)}, found {ending or 'none'!r}"
                            + (advice(path) and f"; {advice(path)}"))
    with reading(path, MeshFileError):
        contents = _READERS[ending](path, load_bytes(path))
    if not len(contents.vertices):
        raise EmptyFileError(f"{path}: the file holds no vertices")
    contents = _finite(path, contents)
    check_extent(path, contents.vertices)
    return contents


def _finite(path: Path, contents: Contents) -> Contents:
    """Drop points that are not finite with their triangles, and all colours if one is not finite; with a warning."""
    if contents.colors is not None and not np.isfinite(contents.colors).all():
        warnings.warn(f"{path}: colours that are not finite numbers; all colours were left out", stacklevel=2)
        contents = replace(contents, colors=None)
    finite = np.isfinite(contents.vertices).all(axis=1)
    if finite.all():
        return contents
    if not finite.any():
        raise EmptyFileError(f"{path}: none of its {len(finite)} points is finite")
    of_file, faces, lost = np.where(finite, np.cumsum(finite) - 1, -1), contents.faces, ""
    if faces is not None:
        kept = finite[faces].all(axis=1)
        faces = of_file[faces[kept]]
        lost = "" if kept.all() else f", with {number_of(int((~kept).sum()), 'triangle')}"
    warnings.warn(f"{path}: {np.count_nonzero(~finite)} of {len(finite)} points are not finite and were left out{lost}",
                  stacklevel=2)
    colors, normals = (None if values is None else values[finite] for values in (contents.colors, contents.normals))
    return replace(contents, vertices=contents.vertices[finite], faces=faces, colors=colors, normals=normals,
                   of_file=of_file)


def _write(path: Path, contents: Contents, precision: Precision, writers: dict[str, _Encode]) -> None:
    """Write a file in the format of its ending, packed if it ends in `.gz`."""
    if precision not in ("double", "single"):
        raise ValueError(f"precision: expected 'double' or 'single', got {precision!r}")
    if ending_of(path) not in writers:
        raise MeshFileError(f"{path}: expected a name ending in {', '.join(writers)}, "
                            f"found {ending_of(path) or 'none'!r}")
    data = writers[ending_of(path)](contents, precision == "double")
    if path.suffix.lower() == ".gz":
        data = gzip.compress(data, compresslevel=6, mtime=0)
    storage.write_file(path, data)
