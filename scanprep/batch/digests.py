"""Digests of what a result depends on: short texts that change with files, models, arrays, tables or settings."""
from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import importlib.metadata
import time
import weakref
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from stat import S_ISREG
from typing import Any

import numpy as np
from scipy.sparse import sparray

from ..geometry import storage
from .values import PACKAGES

INSTALLED = Path(__file__).parents[2]   # the folder of the three packages
# nanoseconds: clocks of file systems tick in steps of up to two seconds, so a younger file may change unnoticed
SETTLED = 2_000_000_000


class Digests:
    """Compute digests of values and files, and remember those of files between runs.

    Digests of files are kept in the file at `path`, and hold as long as size and modification times stay the same.
    A file changed less than two seconds before it was read is read again the next time.
    """

    DIGITS = 32                    # hexadecimal digits of SHA-256 that are kept: 128 bits, no collision in practice

    def __init__(self, path: Path | None = None) -> None:
        self.path = path
        self._changed = False
        self._values: dict[int, tuple[weakref.ref[Any], bytes]] = {}
        self._known: dict[str, list[Any]] = {}
        if path is not None and path.exists():
            with contextlib.suppress(storage.StorageError):        # a damaged cache does no harm: files are read again
                known = storage.read_json(path, "digests of files")
                self._known = known if isinstance(known, dict) else {}

    def save(self) -> None:
        """Write the digests of files for the next run."""
        if self.path is not None and self._changed:
            storage.write_json(self.path, self._known)
            self._changed = False

    def of(self, *values: Any) -> str:
        """Compute a digest of values: a path counts as the contents of the file, a dataclass as its fields."""
        hasher = hashlib.sha256()
        for value in values:
            self._update(hasher, value)
        return hasher.hexdigest()[:self.DIGITS]

    def key(self, *values: Any) -> str:
        """Compute a digest of values together with the version and sources of this program."""
        return self.of(program(), *values)

    def of_file(self, path: Path) -> str:
        """Compute a digest of the contents of a file, or of all files in a folder, hidden ones left out.

        It is "missing" where there is no such file.
        """
        if path.is_dir():
            # a folder: names and contents of all files, in a fixed order
            names = [p.relative_to(path).as_posix() for p in sorted(path.rglob("*")) if p.is_file()]
            return self.of([(name, path / name) for name in names if not f"/{name}".count("/.")])
        try:
            stat = path.stat()
            if not S_ISREG(stat.st_mode):        # a pipe or device may never end
                return "missing"
            # an unchanged signature of the file means unchanged contents: no need to read it
            signature = [stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino]
            key = str(path.absolute())
            remembered = self._known.get(key)
            if isinstance(remembered, list) and remembered[:-1] == signature:
                return str(remembered[-1])
            hasher = hashlib.sha256()
            with open(path, "rb") as file:
                # read in pieces of a megabyte, as scans may be larger than the memory
                while block := file.read(1 << 20):
                    hasher.update(block)
            digest = hasher.hexdigest()[:self.DIGITS]
        except OSError:
            return "missing"
        # remember it only when a later change would show in the modification time
        if time.time_ns() - max(stat.st_mtime_ns, stat.st_ctime_ns) > SETTLED:
            self._known[key], self._changed = [*signature, digest], True
        return digest

    def of_files(self, folder: Path) -> dict[str, str]:
        """Compute the digests of all files in a folder: relative path -> digest."""
        return {path.relative_to(folder).as_posix(): self.of_file(path)
                for path in sorted(folder.rglob("*")) if path.is_file()}

    def _update(self, hasher: Any, value: Any) -> None:
        """Add a value to a hash, with its kind and length in front so that no two values run together."""
        if isinstance(value, Path):
            hasher.update(b"file" + self.of_file(value).encode())
        elif isinstance(value, np.ndarray | np.generic):
            array = np.ascontiguousarray(value)
            hasher.update(f"array{array.dtype.str}{np.shape(value)}".encode())
            hasher.update(array.view(np.uint8).data if array.size else b"")
        elif value is None or isinstance(value, bool | int | float | str):
            text = repr(value).encode()
            hasher.update(f"{type(value).__name__}{len(text)}:".encode() + text)
        elif isinstance(value, Mapping):
            self._several(hasher, "map", sorted(((str(k), v) for k, v in value.items()), key=lambda kv: kv[0]))
        elif isinstance(value, list | tuple):
            self._several(hasher, "list", value)
        elif isinstance(value, sparray):
            entries = value.tocoo()
            self._several(hasher, "sparse", [entries.shape, *entries.coords, entries.data])
        elif isinstance(value, set | frozenset):
            self._several(hasher, "set", sorted(value))
        elif dataclasses.is_dataclass(value) and not isinstance(value, type):
            hasher.update(self._of_dataclass(value))
        else:
            raise TypeError(f"cannot tell when a {type(value).__name__} changes")

    def _several(self, hasher: Any, kind: str, values: Any) -> None:
        """Add several values to a hash, with their number in front."""
        hasher.update(f"{kind}{len(values)}:".encode())
        for value in values:
            self._update(hasher, value)

    def _of_dataclass(self, value: Any) -> bytes:
        """Compute the digest of a dataclass's fields.

        Those of frozen dataclasses without files are remembered: models are large and come often.
        """
        remembered = self._values.get(id(value))
        if remembered is not None and remembered[0]() is value:
            return remembered[1]
        hasher = hashlib.sha256(f"{type(value).__module__}.{type(value).__qualname__}".encode())
        for field in dataclasses.fields(value):
            # fields marked digest=False follow from others or change no result
            if field.metadata.get("digest", True):
                self._update(hasher, field.name)
                self._update(hasher, getattr(value, field.name))
        if type(value).__dataclass_params__.frozen and not any(paths_of(value)):
            self._values[id(value)] = (weakref.ref(value), hasher.digest())
        return hasher.digest()


def paths_of(value: Any) -> Iterator[Path]:
    """Yield all paths in a value of paths, tuples, lists, dicts and dataclasses."""
    if isinstance(value, Path):
        yield value
    elif isinstance(value, Mapping):
        yield from paths_of(tuple(value.values()))
    elif isinstance(value, list | tuple):
        for each in value:
            yield from paths_of(each)
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        yield from paths_of([getattr(value, field.name) for field in dataclasses.fields(value)])


def with_paths(value: Any, change: Callable[[Path], Path]) -> Any:
    """Return the same value with every path in it changed by a function."""
    if isinstance(value, Path):
        return change(value)
    if isinstance(value, list | tuple):
        return type(value)(with_paths(v, change) for v in value)
    if isinstance(value, Mapping):
        return {k: with_paths(v, change) for k, v in value.items()}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {f.name: getattr(value, f.name) for f in dataclasses.fields(value) if f.init}
        changed = {name: with_paths(v, change) for name, v in fields.items()}
        # an unchanged dataclass is returned as it is, which keeps its cached properties
        if any(changed[name] is not v for name, v in fields.items()):
            return dataclasses.replace(value, **changed)
    return value


def program() -> str:
    """Return version and source digest of this project: results of another version are computed again."""
    return _program_in(INSTALLED)


@functools.cache
def _program_in(folder: Path) -> str:
    """Compute the version text of the packages in a folder; reading them once takes less than 0.1 seconds."""
    try:
        version = importlib.metadata.version("scapekit")
    except importlib.metadata.PackageNotFoundError:
        version = "not installed"
    sources = hashlib.sha256()
    computes = {".py", ".json", ".npz"}  # files that can change results: modules, tables, stored bodies
    files = {path.relative_to(folder).as_posix(): path for name in PACKAGES for path in (folder / name).rglob("*")
             if path.suffix in computes}
    for name in sorted(files):
        # sources of viewer.js are not installed with the package, so they must not count
        if not name.startswith("scanprep/viewer/source/"):
            content = files[name].read_bytes()
            sources.update(f"{name} {len(content)} ".encode() + content)
    return f"{version}, sources {sources.hexdigest()[:12]}"
