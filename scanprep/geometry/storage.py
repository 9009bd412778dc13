"""Read and write JSON, and `.npz` files of named arrays with a JSON header of kind and version; never pickle.

Every problem with a file is a StorageError that names it. A small file never makes the reader use much memory.
"""
from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import os
import secrets
import stat
import zipfile
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path, PureWindowsPath
from typing import IO, Any

import numpy as np

from ..words import printable
from .budget import memory_for

HEADER = "header"
LARGEST = 1e30                       # larger numbers count as infinite: their squares may overflow
LARGEST_TEXT = 2**28                 # bytes: larger JSON files and tables are refused


class StorageError(ValueError):
    """A missing or damaged file, or one of another kind or version; names the file, what was expected and what came.

    The message is one line, whatever stands in the file.
    """

    def __init__(self, message: str = "") -> None:
        super().__init__(printable(message))


class ObjectsError(ValueError):
    """An array of Python objects, which only a pickle could restore."""


@contextlib.contextmanager
def taking_apart(path: str | Path, what: str, error: type[StorageError] = StorageError) -> Iterator[None]:
    """Convert any exception inside to an `error` that names the file: damaged files fail in many ways."""
    try:
        yield
    except StorageError:                 # names the file already
        raise
    except FileNotFoundError:
        raise error(f"{path}: no such file; expected {what}") from None
    except Exception as problem:
        raise error(f"{path}: expected {what}, {_reason(problem)}") from problem


def _reason(problem: Exception) -> str:
    """Describe an exception in one short line."""
    if isinstance(problem, KeyError):
        return f"it lacks {problem}"
    if isinstance(problem, RecursionError):
        return "it is nested too deeply"
    if isinstance(problem, MemoryError):
        return "it needs more memory than there is"
    text = (getattr(problem, "strerror", None) or " ".join(str(problem).split()))[:200]
    return f"cannot read it ({text or type(problem).__name__})"


def check_regular(path: str | Path, error: type[StorageError] = StorageError, what: str = "a file") -> None:
    """Raise `error` for what is no regular file: missing, a folder, or a pipe or device, which may never end."""
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError:
        raise error(f"{path}: no such file; expected {what}") from None
    except (OSError, ValueError) as problem:
        raise error(f"{path}: cannot be read ({getattr(problem, 'strerror', None) or problem})") from None
    if not stat.S_ISREG(mode):
        raise error(f"{path}: expected {what}, found a {'folder' if stat.S_ISDIR(mode) else 'pipe or a device'}")


def path_inside(folder: str | Path, name: object, source: str | Path) -> Path:
    """Return the path of a file that another file names; it must be inside a folder.

    Folders of results are shared, and their records may name anything. So a name must be a relative path without `..`,
    and no link may lead out of the folder.

    Parameters
    ----------
    folder : str or Path
        Where the file must lie.
    name : str
        A relative path, as it was read.
    source : str or Path
        The file that it was read from, for the error.

    Returns
    -------
    Path
        `folder / name`.

    Raises
    ------
    StorageError
        Not text, absolute, with `..` in it, or a link that leads out of the folder.

    Examples
    --------
    >>> path_inside("set", "meshes/anna.ply", "set/set.csv").as_posix()
    'set/meshes/anna.ply'
    """
    refused = StorageError(f"{source}: expected the name of a file inside {folder}, found {name!r}")
    if not isinstance(name, str) or not name or "\0" in name:
        raise refused
    # the rules of Windows are stricter: drives, and backslashes as separators
    parts = PureWindowsPath(name)
    if parts.drive or parts.root or ".." in parts.parts:
        raise refused
    path = Path(folder) / name
    with taking_apart(source, f"the name of a file, not {name[:80]!r}"):      # too long, or links in a circle
        inside = path.resolve().is_relative_to(Path(folder).resolve())
    if not inside:
        raise StorageError(f"{source}: {path} is a link that leads out of {folder}; expected a file inside")
    return path


def place_to_write(folder: str | Path, name: str, source: str | Path) -> Path:
    """Return the place of a new file inside a folder, as `path_inside`; StorageError for a link on the way to it."""
    path = path_inside(folder, name, source)
    for place in list(path.parents)[:len(Path(name).parts) - 1]:
        if place.is_symlink():
            raise StorageError(f"{place}: expected a folder that {path.name} is written to, found a link; remove it, "
                               "or name another output")
    return path


def read_bytes(path: str | Path, what: str = "a file", error: type[StorageError] = StorageError) -> bytes:
    """Read a whole file; raise `error` with its name on any problem."""
    check_regular(path, error, what)
    with taking_apart(path, what, error):
        return Path(path).read_bytes()


def write_file(path: str | Path, data: bytes | str) -> None:
    """Write a file, atomically; text as UTF-8, with undecodable characters of file names as `\\udce9`."""
    with writing(path) as beside:
        beside.write_bytes(data.encode("utf-8", "backslashreplace") if isinstance(data, str) else data)


@contextlib.contextmanager
def writing(path: str | Path) -> Iterator[Path]:
    """Yield a temporary file that replaces `path` when the block succeeds; until then the old file stays.

    Folders come from strangers, with links in them. So the temporary file is new, under a name that nobody can guess,
    and a link at `path` is replaced: what it leads to stays as it is.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f".{secrets.token_hex(8)}.part{path.suffix}")
    try:
        create_file(beside)
        yield beside
        os.replace(beside, path)
    except OSError as problem:           # a full disk names no file
        if problem.filename not in (None, str(beside), beside):
            raise
        raise type(problem)(problem.errno, problem.strerror or str(problem), str(path)) from problem
    finally:
        beside.unlink(missing_ok=True)


def create_file(path: str | Path, data: bytes = b"") -> None:
    """Write a new file; FileExistsError where there is anything of that name, also a link that leads nowhere."""
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0)
    file = open(os.open(path, flags, 0o666), "wb")
    try:
        with file:
            file.write(data)
    except OSError:                      # a full disk: half a copy would count as one
        os.unlink(path)
        raise


def keep_former(path: Path) -> None:
    """Copy a file beside itself before its first change; an earlier copy stays.

    StorageError for a link in the place of the copy: a copy would overwrite what it leads to.
    """
    copy = path.with_name(path.name + ".before")
    if copy.is_symlink():
        raise StorageError(f"{copy}: expected a copy of {path.name}, or nothing, found a link; remove it")
    with contextlib.suppress(FileExistsError):
        create_file(copy, read_bytes(path))


def text(arrays: Mapping[str, np.ndarray], name: str, usual: str) -> str:
    """Return the text of this name, `usual` if there is none; ValueError for anything else."""
    value = arrays.get(name, np.array(usual))
    if value.size != 1 or value.dtype.kind not in "US":
        raise ValueError(f"{name}: expected one text, found {value.dtype} of shape {value.shape}")
    return value.item().decode() if value.dtype.kind == "S" else str(value.item())


def as_json(value: Any) -> Any:
    """Return a value as `write_json` and `read_json` give it back: tuples as lists, keys as strings."""
    return json.loads(_json(value))


def write_json(path: str | Path, value: Any) -> None:
    """Write JSON, atomically: dataclasses as objects, arrays as lists, null for values that are not finite."""
    write_file(path, _json(value, 1) + "\n")


def _json(value: Any, indent: int | None = None) -> str:
    """Encode JSON, with null for values that are not finite."""
    try:
        return json.dumps(value, indent=indent, allow_nan=False, default=_plain)
    except ValueError:
        text = json.dumps(value, default=_plain)
        return json.dumps(json.loads(text, parse_constant=lambda name: None), indent=indent)


def _plain(value: Any) -> Any:
    """Convert dataclasses, arrays and paths to what JSON can hold."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"JSON holds no {type(value).__name__}")


def read_json(path: str | Path, what: str, error: type[StorageError] = StorageError) -> Any:
    """Read a JSON file of finite numbers; `what` says in errors what was expected."""
    return parse_json(path, read_bytes(path, what, error), what, error)


def parse_json(path: str | Path, data: bytes, what: str, error: type[StorageError] = StorageError, nan: bool = False
               ) -> Any:
    """Parse JSON as `read_json` does; with `nan`, numbers need not be finite."""
    with taking_apart(path, f"{what} in JSON", error):
        if len(data) > LARGEST_TEXT:
            raise ValueError(f"{len(data)} bytes, more than {LARGEST_TEXT}")
        try:
            text = data.decode("utf-16" if data[:2] in UTF_16 else "utf-8-sig")
        except UnicodeDecodeError as problem:
            raise ValueError(f"it is not saved as UTF-8: byte {problem.start}") from None
        return json.loads(text) if nan else json.loads(text, parse_constant=_number, parse_float=_number)


UTF_16 = (b"\xff\xfe", b"\xfe\xff")


def _number(text: str) -> float:
    """Parse a finite number."""
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is not a finite number")
    return value


def save(path: str | Path, kind: str, version: int, arrays: dict[str, np.ndarray],
         header: dict[str, Any] | None = None, compress: bool = True) -> None:
    """Write arrays and a JSON header with kind and version into one `.npz` file, for `load`."""
    text = json.dumps({"kind": kind, "version": version, **(header or {})})
    save_arrays(path, {HEADER: np.array(text), **arrays}, compress)


def save_arrays(path: str | Path, arrays: dict[str, np.ndarray], compress: bool = True) -> None:
    """Write arrays into one `.npz` file; ValueError for arrays of objects."""
    for name, array in arrays.items():                     # before NumPy 2.2 savez cannot refuse them itself
        if np.asarray(array).dtype.hasobject:
            raise ValueError(f"{path}: expected arrays of numbers or text, {name} holds objects")
    with writing(path) as beside, open(beside, "wb") as out:
        (np.savez_compressed if compress else np.savez)(out, **arrays)     # type: ignore[arg-type]


def load_arrays(path: str | Path, what: str = "an .npz file", only: Collection[str] | None = None
                ) -> dict[str, np.ndarray]:
    """Read all arrays of an `.npz` file, or those of some names; StorageError if missing, damaged or with objects."""
    return _arrays(path, what, only)


def names_in(path: str | Path, what: str = "an .npz file") -> tuple[str, ...]:
    """List the names of the arrays in an `.npz` file, without reading them; StorageError if missing or damaged."""
    check_regular(path, what=what)
    with taking_apart(path, what), zipfile.ZipFile(path) as archive:
        return tuple(name[:-4] for name in archive.namelist() if name.endswith(".npy"))


def kind_of_stored(path: str | Path) -> str:
    """Read the kind of a file of `save` from its header; StorageError without one."""
    return str(load_header(path, "scapekit").get("kind"))


def load_header(path: str | Path, kind: str) -> dict[str, Any]:
    """Read only the header of a file of `save`, of any kind and version; StorageError without one."""
    return _header(path, kind, _arrays(path, "an .npz file with a header", (HEADER,)).get(HEADER))


def _arrays(path: str | Path, what: str, only: Collection[str] | None) -> dict[str, np.ndarray]:
    """Read arrays of an archive, with sizes checked; NumPy's own reader trusts the headers."""
    check_regular(path, what=what)
    with taking_apart(path, what), zipfile.ZipFile(path) as archive:
        members = {info.filename[:-4]: info for info in archive.infolist() if info.filename.endswith(".npy")}
        # refuse decompression bombs, and too many arrays
        unpacked, packed = sum(info.file_size for info in members.values()), os.path.getsize(path)
        if unpacked > memory_for(packed) or len(members) > packed // 64:
            raise ValueError(f"{packed} bytes that would unpack to {len(members)} arrays of {unpacked} bytes")
        found = {}
        for name, info in members.items():
            if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise ValueError(f"array {name}: packed in a way that is not read here")
            if only is None or name in only:
                with archive.open(info) as stream:
                    found[name] = _array(stream, info.file_size, name)
        return found


def _array(stream: IO[bytes], size: int, name: str) -> np.ndarray:
    """Read an array in NumPy's format; its header must agree with `size` bytes."""
    try:
        version = np.lib.format.read_magic(stream)
        read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}[version]
        shape, fortran, kind = read(stream)
    except Exception:                    # NumPy's message advises to allow pickles
        raise ValueError(f"array {name}: its header is damaged") from None
    if kind.hasobject:
        raise ObjectsError(f"array {name}: expected numbers or text, found Python objects, which are not read here, "
                           "because they can run programs")
    if kind.kind not in "biufcSU":
        raise ValueError(f"array {name}: expected numbers or text, found {kind}")
    count = math.prod(shape)
    if min(shape, default=0) < 0 or count * max(kind.itemsize, 1) != size - stream.tell():
        raise ValueError(f"array {name}: expected {count} of {kind}, found {size - stream.tell()} bytes")
    data = bytearray(stream.read(size))
    if len(data) != count * kind.itemsize:
        raise ValueError(f"array {name}: truncated")
    values: np.ndarray = np.frombuffer(data, kind, count) if count else np.zeros(shape, kind)
    return values.reshape(shape[::-1]).T if fortran else values.reshape(shape)


def numbers(arrays: Mapping[str, np.ndarray], name: str, *shape: int | None, finite: bool = True, kinds: str = "iuf"
            ) -> np.ndarray:
    """Return the array of this name, checked for shape (None: any length), NumPy kind and finite values.

    KeyError or ValueError otherwise; see `taking_apart`.
    """
    values = arrays[name]
    if values.dtype.kind not in kinds:
        raise ValueError(f"{name}: expected numbers, found {values.dtype}")
    if len(shape) != values.ndim or any(n not in (None, found) for n, found in zip(shape, values.shape, strict=True)):
        wanted = ", ".join("any" if n is None else str(n) for n in shape)
        raise ValueError(f"{name}: expected shape ({wanted}), found {values.shape}")
    if finite and not (np.abs(values) <= LARGEST).all():
        raise ValueError(f"{name}: {np.count_nonzero(~(np.abs(values) <= LARGEST))} values are not finite")
    return values


def _header(path: str | Path, kind: str, stored: np.ndarray | None) -> dict[str, Any]:
    """Parse a stored header; StorageError if it is missing or damaged."""
    if stored is None:
        raise StorageError(f"{path}: expected a {kind} file, found an .npz without a header")
    what = f"a {kind} file with a header in JSON"
    with taking_apart(path, what):
        header = parse_json(path, str(stored).encode("utf-8"), what, nan=True)
    if not isinstance(header, dict):
        raise StorageError(f"{path}: expected a {kind} file, its header is damaged")
    return header


def load(path: str | Path, kind: str, versions: tuple[int, ...]) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read header and arrays of a file of `save` of this kind and one of these versions; StorageError otherwise."""
    path = Path(path)
    arrays = load_arrays(path, f"a {kind} file")
    header = _header(path, kind, arrays.pop(HEADER, None))
    if header.get("kind") != kind:
        raise StorageError(f"{path}: expected kind '{kind}', found '{header.get('kind')}'")
    if header.get("version") not in versions:
        known = ", ".join(map(str, versions))
        raise StorageError(f"{path}: {kind} version {header.get('version')} is not known here (known: {known})")
    return header, arrays
