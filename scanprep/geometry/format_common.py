"""Shared by the readers of all formats: errors, contents of a file, polygons, tables of numbers, colours and units."""
from __future__ import annotations

import contextlib
import gzip
import io
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..words import number_of
from . import storage
from .budget import memory_for, reading, spend

FARTHEST = 1e9                       # largest coordinate in any unit; no scan has more
UNITS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "in": 0.0254}
UNKNOWN = "unknown"                  # the word for a unit that is to be found together with the person in a scan
_SPELLED = {"metres": "m", "meters": "m", "millimetres": "mm", "millimeters": "mm", "centimetres": "cm",
            "centimeters": "cm", "inches": "in"}


class MeshFileError(storage.StorageError):
    """A file of a mesh, points or landmarks cannot be read; names the file, what was expected and what came."""


class EmptyFileError(MeshFileError):
    """A file without any vertex; from a camera it means that nothing was seen."""


@dataclass(frozen=True, eq=False)
class Contents:
    """What a file of any format holds, in the file's own unit and order."""

    vertices: np.ndarray                    # (N, 3)
    faces: np.ndarray | None = None         # (F, 3)
    normals: np.ndarray | None = None       # (N, 3)
    colors: np.ndarray | None = None        # (N, 3) in [0, 1]
    objects: tuple[tuple[str, int], ...] = ()       # name and triangles of each, where the format has objects
    of_file: np.ndarray | None = None       # (M,) number of each vertex of the file here, -1 if left out
    up: int | None = None                   # axis that points up, if the format says it


def load_bytes(path: Path) -> bytes:
    """Read a whole file, unpacked if it ends in `.gz`; MeshFileError if it is missing, damaged or empty."""
    storage.check_regular(path, MeshFileError)
    with reading(path, MeshFileError):
        data = storage.read_bytes(path, error=MeshFileError)
        if path.suffix.lower() == ".gz":
            data = _unpack(path, data)
        spend(memory=len(data))
    if not data:
        raise EmptyFileError(f"{path}: the file is empty")
    return data


def _unpack(path: Path, data: bytes) -> bytes:
    """Unpack a gzip file, up to a limit that no real mesh reaches."""
    most = memory_for(len(data)) // 4          # a mesh in memory takes about four times its file
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as packed:
            out = packed.read(most + 1)
    except Exception as error:                   # gzip also raises errors of zlib and struct
        raise MeshFileError(f"{path}: truncated or damaged gzip file ({error})") from None
    if len(out) > most:
        raise MeshFileError(f"{path}: expected a packed mesh, found {len(data)} bytes that unpack to more than {most}")
    return out


def as_utf8(data: bytes) -> bytes:
    """Convert text with a byte order mark to UTF-8 without it; return anything else as it is."""
    if data[:2] in storage.UTF_16:
        with contextlib.suppress(UnicodeDecodeError):
            return data.decode("utf-16").encode()
    return data.removeprefix(b"\xef\xbb\xbf")


def check_extent(path: Path, points: np.ndarray) -> None:
    """Raise MeshFileError for coordinates that are too large for lengths and areas to be computed."""
    far = np.flatnonzero((np.abs(points) > FARTHEST).any(axis=1) & np.isfinite(points).all(axis=1))
    if len(far):
        raise MeshFileError(f"{path}: vertex {far[0]} lies at {points[far[0]].tolist()}, "
                            f"expected coordinates below {FARTHEST:g}")


def unit_named(text: str) -> str | None:
    """Find the key of `UNITS` that a file means; it may be spelt out, cut short or end with a dot. None if unknown.

    Examples
    --------
    >>> unit_named("Millimeters"), unit_named("mete"), unit_named("furlong")
    ('mm', 'm', None)
    """
    word = text.strip(" .[]()\0").lower()
    # four letters are enough: some programs cut the word there
    whole = (unit for full, unit in _SPELLED.items() if len(word) >= 4 and full.startswith(word))
    return word if word in UNITS else next(whole, None)


def metres_of(unit: str | None) -> float:
    """Return the length of a unit in metres, 1 without a unit; ValueError for an unknown one.

    A number written as text is the length itself, such as "0.3048" for feet.
    """
    if unit is None or unit in UNITS:
        return UNITS[unit or "m"]
    with contextlib.suppress(ValueError):
        if 0 < float(unit) < FARTHEST:
            return float(unit)
    raise ValueError(f"unit: expected one of {', '.join(UNITS)}, or its length in metres, got {unit!r}")


# Metres from end to end of a person, by unit: up to stretched arms; in millimetres from a bust or a toddler on. Nothing
# that is scanned is so large in metres: 51 to 91 are inches, 92 to 230 centimetres, and from 400 on millimetres.
PERSON = {"mm": (0.4, 2.3), "cm": (0.92, 2.3), "in": (1.3, 2.3)}


def guess_unit(extent: float) -> str | None:
    """Guess the unit, other than metres, in which `extent` is that of a person; None if none fits."""
    return next((unit for unit, (least, most) in PERSON.items() if least <= extent * UNITS[unit] <= most), None)


def metres_per_unit(path: Path, points: np.ndarray, unit: str | None, smallest: float = 0.1) -> float:
    """Find the factor from the unit of a file to metres.

    By default it is metres, but if the points span as much as a person in another unit, it is that unit. There is a
    warning if they span more than 10 m or less than `smallest`. Only the extent of the points counts, not their
    position.
    """
    if unit is not None:
        return metres_of(unit)
    extent = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
    if extent > 10:                          # many depth cameras write 65.535 m for missing points
        inner = float(np.ptp(np.quantile(points, [0.05, 0.95], axis=0), axis=0).max())
        # if nine points in ten span less than a tenth, the others are no body
        if inner < 0.1 * extent:
            warnings.warn(f"{path}: a few points lie far off the rest, which spans {inner:.3g} m and alone tells the "
                          "unit; scape prep clean drops them", stacklevel=3)
            extent = inner
    # another unit in which it is a person; else metres, with a warning for a giant or a dwarf
    likely = guess_unit(extent)
    if likely is not None:
        warnings.warn(f"{path}: read with unit='{likely}', in which it is {extent * UNITS[likely]:.2f} m from end to "
                      f"end; if these are metres, say unit='m'", stacklevel=3)
        return UNITS[likely]
    if extent > 10:
        nearest = min(("mm", "cm", "in"), key=lambda u: abs(np.log(extent * UNITS[u] / 1.7)))
        warnings.warn(f"{path}: {extent:.4g} m from end to end when read as metres; if it is not, say its unit: with "
                      f"unit='{nearest}' it is {extent * UNITS[nearest]:.3g} m", stacklevel=3)
    elif 0 < extent < smallest:
        warnings.warn(f"{path}: {extent:.2g} m from end to end when read as metres; it looks as if millimetres "
                      f"had been divided by 1000 twice ({extent * 1000:.3g} m)", stacklevel=3)
    return 1.0


def quote(text: bytes | str) -> str:
    """Quote the first 40 characters of a piece of a file, for an error message."""
    shown = text if isinstance(text, str) else text.decode("latin-1")
    return repr(shown if len(shown) <= 40 else shown[:40] + "...")


class Lines:
    """The non-empty lines of a text file with their numbers from `first` on, without comments."""

    def __init__(self, path: Path, data: bytes, first: int = 1, comment: bytes | None = None) -> None:
        self.path = path
        spend(memory=64 * (data.count(b"\n") + data.count(b"\r")))         # objects of Python, and a place in a list
        lines = data.splitlines()
        if comment is not None and comment in data:
            lines = [line.split(comment, 1)[0] for line in lines]
        self.text = list(filter(bytes.strip, lines))
        self.numbers: Sequence[int] = range(first, first + len(lines))
        if len(self.text) < len(lines):
            self.numbers = [number for number, line in enumerate(lines, first) if line.strip()]

    def __len__(self) -> int:
        return len(self.text)

    def fail(self, row: int, expected: str) -> MeshFileError:
        """Make the error for a row that is not as expected; past the last row the file is truncated."""
        if row >= len(self.text):
            return MeshFileError(f"{self.path}: truncated: expected {expected}, found the end of the file")
        return MeshFileError(f"{self.path}: line {self.numbers[row]}: expected {expected}, "
                             f"found {quote(self.text[row].strip())}")

    def table(self, rows: range, expected: str, columns: int, dtype: type = np.float64) -> np.ndarray:
        """Read numbers (rows, at least `columns`) of equally long rows; else raise the error of the first bad row."""
        if not rows:
            return np.zeros((0, columns), dtype=dtype)
        if rows.stop <= len(self.text) and any(map(bytes.strip, self.text[rows.start:rows.stop])):
            with contextlib.suppress(ValueError):
                values: np.ndarray = np.loadtxt(self.text[rows.start:rows.stop], dtype=dtype, ndmin=2, comments=None)
                if values.shape[1] >= columns:
                    return values
        # the fast reader failed: find the first bad row, for the message
        width = None
        for row in rows:
            words = self.text[row].split() if row < len(self.text) else []
            try:
                if len(words) < columns or len(words) != (width or len(words)):
                    raise ValueError
                width = len([dtype(word) for word in words])
            except (ValueError, OverflowError):
                raise self.fail(row, expected) from None
        raise self.fail(rows.start, expected)


def polygons(path: Path, sizes: np.ndarray, corners: np.ndarray, count: int,
             numbers: Sequence[int] | None = None, vertices: np.ndarray | None = None) -> np.ndarray:
    """Triangulate polygons of `sizes` (P,) corners into (F, 3), each as a fan around its first corner.

    The fan is around a later corner if a diagonal would coincide with an edge or diagonal of another polygon. Only
    vertex numbers decide, so that a mesh is triangulated alike in all poses. With `vertices` (count, 3), a UserWarning
    counts polygons that fold over because they are bent or concave.

    `corners` are the vertices, of `count`, one polygon after the other. `numbers` are line numbers for errors. Polygons
    with fewer than three corners are left out, with a UserWarning. MeshFileError for a vertex out of range.
    """
    sizes, corners = np.asarray(sizes, dtype=np.int64), np.asarray(corners, dtype=np.int64)
    start = np.cumsum(sizes) - sizes

    def where(p: int) -> str:
        """Name a polygon for an error message."""
        return f"{path}: " + (f"line {numbers[p]}: " if numbers is not None else "") + f"face {p}"

    outside = np.flatnonzero((corners < 0) | (corners >= count))
    if len(outside):
        p = int(np.searchsorted(start, outside[0], side="right")) - 1
        raise MeshFileError(f"{where(p)} refers to vertex {corners[outside[0]]}, expected 0..{count - 1}")
    too_small = np.flatnonzero(sizes < 3)
    if len(too_small):
        problem = f"{where(too_small[0])} has {sizes[too_small[0]]} corners, expected at least 3"
        if len(too_small) == len(sizes):
            raise MeshFileError(problem)
        warnings.warn(f"{problem}; {len(too_small)} such faces were left out", stacklevel=4)
        corners, sizes = corners[np.repeat(sizes >= 3, sizes)], sizes[sizes >= 3]
        start = np.cumsum(sizes) - sizes
    if (sizes == 3).all():
        return corners.reshape(-1, 3)
    # fan of n - 2 triangles around corner `first` of each polygon
    first = _cuts_that_meet_nothing(sizes, corners, count)
    of = np.repeat(np.arange(len(sizes)), sizes - 2)
    within = np.arange(len(of)) - np.repeat(np.cumsum(sizes - 2) - (sizes - 2), sizes - 2) + first[of]
    size, begin = sizes[of], start[of]
    faces = np.stack([corners[begin + first[of]], corners[begin + (within + 1) % size],
                      corners[begin + (within + 2) % size]], axis=1)
    if vertices is not None and len(folded := _find_folds(vertices, faces, of)):
        warnings.warn(f"{path}: {number_of(len(folded), 'polygon folds', 'polygons fold')} over where cut into "
                      f"triangles, the first is face {folded[0]}: cut them in the program they are from", stacklevel=4)
    return faces


def strip_triangles(corners: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Convert triangle strips to triangles (F, 3) of one orientation, without degenerate ones.

    `corners` are the vertices of one strip after the other, `sizes` (S,) their numbers. Scanners write tens of
    thousands of strips.
    """
    count = np.maximum(sizes - 2, 0)
    within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    at = np.repeat(np.cumsum(sizes) - sizes, count) + within
    faces = np.stack([corners[at], corners[at + 1], corners[at + 2]], axis=1)
    faces[within % 2 == 1] = faces[within % 2 == 1][:, [1, 0, 2]]
    return np.asarray(faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)])


def _find_folds(vertices: np.ndarray, faces: np.ndarray, of: np.ndarray) -> np.ndarray:
    """Find polygons with triangles (F, 3), of polygon `of` (F,), that face against the whole polygon."""
    c = vertices[faces]
    with np.errstate(all="ignore"):                          # values that are not finite are refused later
        area = np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0])
        whole = np.zeros((of[-1] + 1, 3))
        np.add.at(whole, of, area)
        return np.unique(of[(area * whole[of]).sum(axis=1) < -1e-6 * (whole[of]**2).sum(axis=1)])


def _cuts_that_meet_nothing(sizes: np.ndarray, corners: np.ndarray, count: int) -> np.ndarray:
    """Choose the fan corner (P,) of each polygon: the first whose diagonals are no edges of other polygons."""
    start = np.cumsum(sizes) - sizes
    # keys of all sides, and of all diagonals of fans around first corners; those used twice are crowded
    following = np.arange(len(corners)) + 1
    following[start + sizes - 1] = start
    sides = _edge_key(corners, corners[following], count)
    first, large = np.zeros(len(sizes), dtype=np.int64), np.flatnonzero(sizes > 3)
    of = np.repeat(large, sizes[large] - 3)
    within = np.arange(len(of)) - np.repeat(np.cumsum(sizes[large] - 3) - (sizes[large] - 3), sizes[large] - 3) + 2
    cuts = _edge_key(corners[start[of]], corners[start[of] + within], count)
    _, which, times = np.unique(cuts, return_inverse=True, return_counts=True)
    crowded = np.isin(cuts, sides) | (times[which] > 1)
    if not crowded.any():
        return first
    # for crowded polygons, try each corner and take the one whose diagonals meet fewest others
    users: dict[int, list[int]] = {}
    for key, p in zip(np.r_[sides, cuts[~crowded]].tolist(), np.r_[np.repeat(np.arange(len(sizes)), sizes),
                                                                   of[~crowded]].tolist(), strict=True):
        users.setdefault(key, []).append(p)
    rings = [set(ring.tolist()) for ring in np.split(corners, start[1:])]
    for p in np.unique(of[crowded]):
        ring, n = corners[start[p]:start[p] + sizes[p]], int(sizes[p])
        if len(rings[p]) < n:                # repeated corners: it meets itself anyway, and trying all corners is slow
            continue
        fewest, way, differs = float("inf"), list[int](), {int(p): False}
        for k in range(n):
            keys = _edge_key(ring[k], ring[(k + np.arange(2, n - 1)) % n], count).tolist()
            others = [q for key in keys for q in users.get(key, ())]
            spend(memory=40 * (n + len(others)))
            # duplicate polygons meet whatever the corner, so they do not count
            for q in set(others) - set(differs):
                differs[q] = not (rings[q] <= rings[p] or rings[p] <= rings[q])
                spend(memory=8 * n)
            met = sum(map(differs.__getitem__, others))
            if met < fewest:
                fewest, first[p], way = met, k, keys
            if not met:
                break
        for key in way:
            users.setdefault(key, []).append(int(p))
    return first


def _edge_key(a: np.ndarray, b: np.ndarray, count: int) -> np.ndarray:
    """Return one number per undirected edge."""
    return np.minimum(a, b) * count + np.maximum(a, b)


def as_colors(values: np.ndarray, whole: bool = False) -> np.ndarray:
    """Scale colours (N, 3) to [0, 1], for a file that does not say which value is white.

    White is 1; 255 if a value is larger or all are `whole` numbers; 65535 if one is above 255. Some programs write
    floats a little above 1 for highlights, so 255 starts at 2.
    """
    largest = np.nanmax(values, initial=0)
    white = 1 if largest <= 2 and not whole else 255 if largest <= 255 else 65535
    return np.clip(np.asarray(values, dtype=np.float64) / white, 0, 1)


def as_seen(linear: np.ndarray) -> np.ndarray:
    """Convert linear light, clipped to [0, 1], to sRGB values in [0, 1]."""
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def as_light(color: np.ndarray) -> np.ndarray:
    """Convert sRGB values in [0, 1] to linear light."""
    color = np.asarray(color, dtype=float)
    return np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)


def quantise_colors(colors: np.ndarray) -> np.ndarray:
    """Convert colours in [0, 1] to integers 0..255."""
    return np.clip(np.rint(255 * colors), 0, 255).astype(np.uint8)


def as_rows(columns: Iterable[tuple[Sequence[str], str, np.ndarray | None]]) -> np.ndarray:
    """Build rows with named little-endian fields from arrays (N, k), each with its column names and kind."""
    present = [(names, kind, values) for names, kind, values in columns if values is not None]
    rows = np.zeros(len(present[0][2]), dtype=[(name, "<" + kind) for names, kind, _ in present for name in names])
    for names, _, values in present:
        for name, column in zip(names, values.T, strict=True):
            rows[name] = column
    return rows


def fields_of(rows: np.ndarray) -> list[tuple[str, str]]:
    """Return name and kind, such as `<f4`, of every field."""
    return [(name, rows.dtype[name].str) for name in rows.dtype.names or ()]


def text_rows(form: str, *columns: np.ndarray) -> str:
    """Format arrays (N, k), side by side, one line per row; `form` is the format of a line."""
    return (form + "\n") * len(columns[0]) % tuple(np.hstack(columns).ravel().tolist())


def three_numbers(double: bool) -> str:
    """Return the format of a point in a line of text."""
    return "%.12g %.12g %.12g" if double else "%.8g %.8g %.8g"
