"""Read, write and match landmarks of meshes and scans; the file formats are in `landmark_reading`."""
from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from . import storage
from .files import name_of
from .format_common import FARTHEST, UNITS, MeshFileError, load_bytes, metres_of, metres_per_unit
from .landmark_names import pair_names
from .landmark_reading import Entry, entries_of
from .landmark_writing import encode_landmarks
from .mesh import Mesh, take_any_mesh
from .surface import Surface

# those that are written come first: what was clicked on top of a file that is only read lies beside it
LANDMARK_ENDINGS = (".landmarks.json", ".json", ".mrk.json", ".pp", "_picked_points.pp", ".landmarks.csv", ".lnd",
                    ".landmarks.txt", ".fcsv", ".scalismo.json")


@take_any_mesh
def read_landmarks(path: str | Path, mesh: Mesh | np.ndarray | None = None, unit: str | None = None
                   ) -> dict[str, np.ndarray]:
    """Read named points.

    Parameters
    ----------
    path : str or Path
        JSON `{name: [x, y, z]}`, `{name: vertex}` or `{name: {"face": f, "bary": [a, b, c]}}`, or of scalismo
        (`[{"id": name, "coordinates": [x, y, z]}]`). MeshLab `.pp`. CAESAR `.lnd`. 3D Slicer `.mrk.json` and `.fcsv`.
        `.csv` with a heading `name,x,y,z`. An OpenSim marker set, `.xml`, with all markers in one frame. Otherwise
        text with lines `x y z name`.
    mesh : Mesh or (n, 3) float, metres, optional
        The scan that vertices and faces refer to, and on which the points must lie.
    unit : 'm', 'mm', 'cm' or 'in', optional
        Unit of the coordinates in the file. By default millimetres for `.lnd` and `.fcsv`, the file's own for
        `.mrk.json`, otherwise metres. If the points then do not lie on the scan, but do in another unit, that unit is
        used, with a UserWarning.

    Returns
    -------
    dict of str to (3,) float, metres
        In the order of the file; empty for a file without landmarks. Points of 3D Slicer are in its LPS frame, in
        which it reads and writes meshes, unless the mesh shows that they are in RAS.

    Raises
    ------
    MeshFileError
        A missing or damaged file, a value that is no point, a repeated name, a vertex or face out of range.
    ValueError
        A file that refers to vertices or faces, without a mesh.

    Examples
    --------
    >>> write_landmarks("scan.json", {"navel": np.array([0.0, 0.1, 1.0])})
    >>> read_landmarks("scan.json")["navel"].tolist()
    [0.0, 0.1, 1.0]
    """
    path = Path(path)
    return {name: _place(path, name, value, mesh) for name, value in _entries(path, mesh, unit).items()}


@take_any_mesh
def read_landmark_vertices(path: str | Path, mesh: Mesh, unit: str | None = None) -> dict[str, int]:
    """Read named vertices of a mesh from any file of `read_landmarks`.

    Parameters
    ----------
    path : str or Path
        Landmark file.
    mesh : Mesh
        The mesh that it belongs to.
    unit : 'm', 'mm', 'cm' or 'in', optional
        Unit of the coordinates in the file, as for `read_landmarks`.

    Returns
    -------
    dict of str to int
        For coordinates the nearest vertex, for a point of a face the nearest corner.

    Raises
    ------
    MeshFileError
        As `read_landmarks`, and for coordinates that are not on the mesh: see `check_on_surface`.

    Examples
    --------
    >>> write_landmarks("mesh.json", {"tip": 1})
    >>> read_landmark_vertices("mesh.json", Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]))
    {'tip': 1}
    """
    path = Path(path)
    entries = _entries(path, mesh, unit)
    tree = cKDTree(mesh.vertices)
    points = {name: _place(path, name, value, mesh) for name, value in entries.items()}
    check_on_surface(path, {name: points[name] for name, value in entries.items() if isinstance(value, np.ndarray)},
                     mesh.vertices)
    # a vertex as it is, of a face the nearest corner, of coordinates the nearest vertex
    out = {}
    for name, value in entries.items():
        if isinstance(value, int):
            out[name] = _vertex(path, name, value, mesh)
        elif isinstance(value, dict):
            corners = mesh.faces[value["face"]]
            out[name] = int(corners[np.linalg.norm(mesh.vertices[corners] - points[name], axis=1).argmin()])
        else:
            out[name] = int(tree.query(points[name])[1])
    return out


def landmarks_beside(path: str | Path, folder: Path | None = None) -> Path | None:
    """Find the landmark file of a scan or template by its name (`name_of`), beside it or in a folder; None without one.

    For a mesh called `template`, `landmarks.json` counts too, as in a registered set.
    """
    folder, stem = folder or Path(path).parent, name_of(path)
    names = [stem + ending for ending in LANDMARK_ENDINGS] + ["landmarks.json"] * (stem == "template")
    return next((folder / name for name in names if (folder / name).is_file()), None)


def names_no_landmark(path: Path) -> bool:
    """Return whether a landmark file holds no landmark; false for a damaged one, which its reader reports."""
    try:
        return not entries_of(path, load_bytes(path), None).pairs
    except MeshFileError:
        return False


def find_template_landmarks(template: Path, mesh: Mesh, given: Path | None = None) -> dict[str, int]:
    """Read named vertices of a template from a given file, or from the one beside it; empty where none are known."""
    path = given or landmarks_beside(template)
    return {} if path is None else read_landmark_vertices(path, mesh)


def read_template_landmarks(template: Path, mesh: Mesh, given: Path | None = None, flag: str = "--template-landmarks"
                            ) -> dict[str, int]:
    """Read named vertices of a template as `find_template_landmarks`; ValueError where none are known."""
    known = find_template_landmarks(template, mesh, given)
    if not known:
        raise ValueError(f"{template}: expected its landmarks in {name_of(template)}.landmarks.json beside "
                         f"it; name the file with {flag}")
    return known


def check_on_surface(path: str | Path, landmarks: Mapping[str, np.ndarray], surface: np.ndarray) -> None:
    """Raise MeshFileError for landmarks that cannot be on a surface (n, 3): another unit, or another object.

    A landmark is half the size of the surface away from it, or all landmarks lie within a hundredth of its size.
    """
    points, size = np.array(list(landmarks.values())).reshape(-1, 3), np.linalg.norm(np.ptp(surface, axis=0))
    far = cKDTree(surface).query(points)[0]
    span = np.linalg.norm(np.ptp(points, axis=0)) if len(points) > 2 else size
    if not (far <= 0.5 * size).all() or span < 0.01 * size:
        raise MeshFileError(f"{path}: expected landmarks on the surface, which is {size:.3g} m from corner to corner; "
                            f"they span {span:.3g} m, and '{list(landmarks)[far.argmax()]}' is {far.max():.3g} m from "
                            "it; are both in the same unit?")


def write_landmarks(path: str | Path, landmarks: Mapping[str, np.ndarray | int | Mapping[str, Any]],
                    unit: str | None = None) -> None:
    """Write named points, atomically.

    Parameters
    ----------
    path : str or Path
        The ending determines the format: `.json`, `.csv`, MeshLab `.pp`, or 3D Slicer `.mrk.json`.
    landmarks : dict of str to (3,) float, metres, or int, or {"face": f, "bary": [a, b, c]}
        Points, vertices, or points of faces; the last two in JSON only.
    unit : 'm', 'mm', 'cm' or 'in', optional
        Unit of the coordinates in the file, to be given to `read_landmarks` again. By default metres; in `.mrk.json`
        millimetres.

    Raises
    ------
    ValueError
        A format that is not written, or a point that is not finite or that the format cannot hold.

    Examples
    --------
    >>> from pathlib import Path
    >>> write_landmarks("scan.landmarks.json", {"navel": np.array([0.0, 0.1, 1.0]), "left toe": 17})
    >>> Path("scan.landmarks.json").exists()
    True
    """
    out: dict[str, Any] = {}
    for name, value in landmarks.items():
        if isinstance(value, int | np.integer | Mapping):
            out[name] = value if isinstance(value, Mapping) else int(value)
            continue
        point = np.asarray(value, dtype=np.float64)
        if point.shape != (3,) or not np.isfinite(point).all():
            raise ValueError(f"landmarks: '{name}' expected three finite numbers or a vertex, got {value}")
        out[name] = point
    # formats of other programs hold points only; JSON of ours holds vertices and points of faces too
    points = {name: value for name, value in out.items() if isinstance(value, np.ndarray)}
    data = encode_landmarks(Path(path), points, unit)
    if data is None:
        storage.write_json(path, {name: (value / metres_of(unit)).tolist() if name in points else value
                                  for name, value in out.items()})
    elif len(points) < len(out):
        raise ValueError(f"{path}: expected points; vertices and faces of a mesh can be written as JSON only")
    else:
        storage.write_file(path, data)


def match_landmarks(template_landmarks: Mapping[str, Any], scan_landmarks: Mapping[str, Any], minimum: int = 3
                    ) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """Find the landmarks that template and scan share, in the template's order.

    Synonyms match: `crown` and `top of head`, `LeftHand` and `left middle finger`.

    Parameters
    ----------
    template_landmarks : dict of str to value
        Landmarks of the template, usually vertices.
    scan_landmarks : dict of str to value
        Landmarks of the scan, usually points (3,), metres.
    minimum : int
        Least number of matches.

    Returns
    -------
    names : tuple of L str
        The template's names.
    template_values : (L, ...) array
        Values of the template's landmarks.
    scan_values : (L, ...) array
        Values of the scan's landmarks.

    Raises
    ------
    ValueError
        Fewer than `minimum` names match; the message lists both.

    Examples
    --------
    >>> match_landmarks({"top of head": 4, "navel": 7}, {"crown": 1, "navel": 2, "chin": 3}, minimum=2)[0]
    ('top of head', 'navel')
    """
    pairs = pair_names(template_landmarks, scan_landmarks)
    if len(pairs) < minimum:
        raise ValueError(f"landmarks: expected at least {minimum} names that template and scan share, found "
                         f"{len(pairs)}; template: {', '.join(template_landmarks) or 'none'}; "
                         f"scan: {', '.join(scan_landmarks) or 'none'}")
    return (tuple(name for name, _ in pairs), np.array([template_landmarks[name] for name, _ in pairs]),
            np.array([scan_landmarks[name] for _, name in pairs]))


def try_match_landmarks(path: Path, template_landmarks: Mapping[str, int], scan_landmarks: Mapping[str, np.ndarray]
                        ) -> tuple[np.ndarray, np.ndarray] | None:
    """Match landmarks: vertices (L,) and points (L, 3); None, with a warning, if too few match.

    `path` is the scan's landmark file, for the warning, which lists the names of both sides. A scan without landmarks
    needs no warning.
    """
    if not scan_landmarks:
        return None
    try:
        return match_landmarks(template_landmarks, scan_landmarks)[1:]
    except ValueError as problem:
        warnings.warn(f"{path}: {problem}; going on without landmarks", stacklevel=2)
        return None


def _entries(path: Path, mesh: Mesh | np.ndarray | None, unit: str | None) -> dict[str, Entry]:
    """Read and check the entries of a file, with points in metres."""
    pairs, own_unit, flipped = entries_of(path, load_bytes(path), unit)
    entries = dict(pairs)
    if len(entries) < len(pairs):
        twice = Counter(name for name, _ in pairs).most_common(1)[0][0]
        raise MeshFileError(f"{path}: landmark '{twice}' comes twice")
    points = [v for v in entries.values() if isinstance(v, np.ndarray)]
    for name, value in entries.items():
        if isinstance(value, np.ndarray):
            if not (np.abs(value) <= FARTHEST).all():
                problem = f"lies beyond {FARTHEST:g}" if np.isfinite(value).all() else "is not finite"
                raise MeshFileError(f"{path}: landmark '{name}' {problem}: {value.tolist()}")
    scale = np.ones(3)
    if points and mesh is None:
        scale = metres_per_unit(path, np.array(points), unit or own_unit, smallest=0.0) * scale
    elif points and mesh is not None:
        scale = _metres_on_surface(path, np.array(points), mesh, unit or own_unit, flipped)
    return {name: scale * v if isinstance(v, np.ndarray) else v for name, v in entries.items()}


def _metres_on_surface(path: Path, points: np.ndarray, scan: Mesh | np.ndarray, unit: str | None, flipped: bool
                       ) -> np.ndarray:
    """Find the factors (3,) by which points (L, 3) of a file lie on a scan, a mesh or points (n, 3).

    Programs write units that differ from the scan's: 3D Slicer calls everything millimetres. So the stated unit counts
    if the points then lie on the scan, else the unit in which they do. Front and back of a body look alike, so the
    stated axes are changed only if the others fit far better.
    """
    stated, of_scan = metres_of(unit), scan.vertices if isinstance(scan, Mesh) else scan
    size = float(np.linalg.norm(np.ptp(of_scan, axis=0)))
    surface = Surface(scan) if isinstance(scan, Mesh) and len(scan.faces) else cKDTree(of_scan)
    signs = [np.ones(3), np.array([-1.0, -1, 1])] if flipped else [np.ones(3)]

    def away(scale: np.ndarray) -> float:
        """Return the median distance from the scan."""
        places = points * scale
        return float(np.median(surface.closest(places).distances if isinstance(surface, Surface)
                               else surface.query(places)[0]))

    def misfit(scale: np.ndarray) -> float:
        """Return the distance, doubled for other axes than stated: they must fit twice as well."""
        return away(scale) * (1.0 if scale[0] > 0 else 2.0)

    def fits(scale: np.ndarray) -> bool:
        """Test whether the points lie on the scan: within 3% of its size, as clicks do, and spread over 20% of it."""
        spread = float(np.linalg.norm(np.ptp(points * scale, axis=0)))      # a single spot would always fit
        return spread > 0.2 * size and away(scale) <= 0.03 * size

    def fills(scale: np.ndarray) -> bool:
        """Test whether the points lie among those of the scan and over half of it, as joints inside a body do.

        Neighbouring units differ by 2.5, and such points would leave the scan in another unit or lie in a corner of it.
        """
        places, room = points * scale, 0.03 * size
        spread = float(np.linalg.norm(np.ptp(places, axis=0)))
        low, high = of_scan.min(axis=0) - room, of_scan.max(axis=0) + room
        return spread > 0.5 * size and bool(((places >= low) & (places <= high)).all())

    best = min((stated * sign for sign in signs), key=misfit)
    if len(points) < 3 or fits(best) or fills(best):
        return best
    # try every ratio of two units: either the scan or the landmarks may have been converted
    factors = {a / b for a in UNITS.values() for b in UNITS.values()}
    others = [scale for factor in factors for sign in signs if fits(scale := stated * factor * sign)]
    if not others:
        return best
    other = min(others, key=misfit)
    warnings.warn(f"{path}: read in {unit or 'm'} the landmarks do not lie on the scan; multiplied by "
                  f"{abs(other[0]) / stated:.4g} they do, and so they are used", stacklevel=4)
    return other


def _place(path: Path, name: str, value: Entry, mesh: Mesh | np.ndarray | None) -> np.ndarray:
    """Return the position (3,), metres, of one landmark."""
    if isinstance(value, np.ndarray):
        return value
    if not isinstance(mesh, Mesh):
        kind = "vertex" if isinstance(value, int) else "face"
        raise ValueError(f"mesh: {path} gives landmark '{name}' by {kind}, so the mesh is needed it refers to")
    if isinstance(value, int):
        return mesh.vertices[_vertex(path, name, value, mesh)].copy()
    _check_number(path, name, "face", value["face"], len(mesh.faces))
    return value["bary"] @ mesh.corners[value["face"]]


def _vertex(path: Path, name: str, number: int, mesh: Mesh) -> int:
    """Return the vertex of a mesh for a vertex number of its file."""
    _check_number(path, name, "vertex", number, len(mesh.vertices if mesh.of_file is None else mesh.of_file))
    if mesh.of_file is None:
        return number
    if mesh.of_file[number] < 0:
        raise MeshFileError(f"{path}: landmark '{name}': vertex {number} is not finite in the file of the mesh")
    return int(mesh.of_file[number])


def _check_number(path: Path, name: str, what: str, number: int, count: int) -> None:
    """Raise MeshFileError for a vertex or face that does not exist."""
    if not 0 <= number < count:
        raise MeshFileError(f"{path}: landmark '{name}' refers to {what} {number}, the mesh has 0..{count - 1}")
