"""What a result depends on, as a short text that changes with it: whole files, models, arrays, tables, settings."""
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

DIGITS = 32
INSTALLED = Path(__file__).parents[2]   # the folder of the three packages
SETTLED = 2_000_000_000        # nanoseconds after which a file's time of change tells of every later change


class Digests:
    """Digests of values and files; those of files are remembered as long as size and times of change stay, from run to
    run in the file at `path`.

    A file that was changed less than two seconds before it was read is read again the next time: clocks of file
    systems are coarse.
    """

    def __init__(self, path: Path | None = None) -> None:
        self.path = path
        self._changed = False
        self._values: dict[int, tuple[weakref.ref[Any], bytes]] = {}
        self._known: dict[str, list[Any]] = {}
        if path is not None and path.exists():
            with contextlib.suppress(storage.StorageError):        # only a memory: files are read again
                known = storage.read_json(path, "digests of files")
                self._known = known if isinstance(known, dict) else {}

    def save(self) -> None:
        """Remember digests of files for the next run."""
        if self.path is not None and self._changed:
            storage.write_json(self.path, self._known)
            self._changed = False

    def of(self, *values: Any) -> str:
        """A digest of values: paths count as what the files hold, dataclasses as their fields."""
        whole = hashlib.sha256()
        for value in values:
            self._update(whole, value)
        return whole.hexdigest()[:DIGITS]

    def key(self, *values: Any) -> str:
        """What a result depends on: some values, and the program that makes it of them."""
        return self.of(program(), *values)

    def of_file(self, path: Path) -> str:
        """A digest of what a file holds; "missing" where there is none, and of a folder of all files in it."""
        if path.is_dir():
            names = [p.relative_to(path).as_posix() for p in sorted(path.rglob("*")) if p.is_file()]
            return self.of([(name, path / name) for name in names if not f"/{name}".count("/.")])
        try:
            stat = path.stat()
            if not S_ISREG(stat.st_mode):        # a pipe or device may never end
                return "missing"
            now = [stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino]
            key = str(path.absolute())
            known = self._known.get(key)
            if isinstance(known, list) and known[:-1] == now:
                return str(known[-1])
            whole = hashlib.sha256()
            with open(path, "rb") as file:
                while block := file.read(1 << 20):
                    whole.update(block)
            found = whole.hexdigest()[:DIGITS]
        except OSError:
            return "missing"
        if time.time_ns() - max(stat.st_mtime_ns, stat.st_ctime_ns) > SETTLED:
            self._known[key], self._changed = [*now, found], True
        return found

    def of_files(self, folder: Path) -> dict[str, str]:
        """File -> digest of all files in a folder."""
        return {path.relative_to(folder).as_posix(): self.of_file(path)
                for path in sorted(folder.rglob("*")) if path.is_file()}

    def _update(self, whole: Any, value: Any) -> None:
        """Every value with its kind and length before it, so that no two run together."""
        if isinstance(value, Path):
            whole.update(b"file" + self.of_file(value).encode())
        elif isinstance(value, np.ndarray | np.generic):
            array = np.ascontiguousarray(value)
            whole.update(f"array{array.dtype.str}{np.shape(value)}".encode())
            whole.update(array.view(np.uint8).data if array.size else b"")
        elif value is None or isinstance(value, bool | int | float | str):
            told = repr(value).encode()
            whole.update(f"{type(value).__name__}{len(told)}:".encode() + told)
        elif isinstance(value, Mapping):
            self._several(whole, "map", sorted(((str(k), v) for k, v in value.items()), key=lambda kv: kv[0]))
        elif isinstance(value, list | tuple):
            self._several(whole, "list", value)
        elif isinstance(value, sparray):
            entries = value.tocoo()
            self._several(whole, "sparse", [entries.shape, *entries.coords, entries.data])
        elif isinstance(value, set | frozenset):
            self._several(whole, "set", sorted(value))
        elif dataclasses.is_dataclass(value) and not isinstance(value, type):
            whole.update(self._of_dataclass(value))
        else:
            raise TypeError(f"cannot tell when a {type(value).__name__} changes")

    def _several(self, whole: Any, kind: str, values: Any) -> None:
        whole.update(f"{kind}{len(values)}:".encode())
        for value in values:
            self._update(whole, value)

    def _of_dataclass(self, value: Any) -> bytes:
        """Of the fields; remembered for frozen ones without files in them, as models are large and come often."""
        known = self._values.get(id(value))
        if known is not None and known[0]() is value:
            return known[1]
        own = hashlib.sha256(f"{type(value).__module__}.{type(value).__qualname__}".encode())
        for field in dataclasses.fields(value):
            if field.metadata.get("digest", True):
                self._update(own, field.name)
                self._update(own, getattr(value, field.name))
        if type(value).__dataclass_params__.frozen and not any(paths_of(value)):
            self._values[id(value)] = (weakref.ref(value), own.digest())
        return own.digest()


def paths_of(value: Any) -> Iterator[Path]:
    """All paths in a value of paths, tuples, lists, dicts and dataclasses."""
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
    """The same value with other paths in it."""
    if isinstance(value, Path):
        return change(value)
    if isinstance(value, list | tuple):
        return type(value)(with_paths(v, change) for v in value)
    if isinstance(value, Mapping):
        return {k: with_paths(v, change) for k, v in value.items()}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {f.name: getattr(value, f.name) for f in dataclasses.fields(value) if f.init}
        changed = {name: with_paths(v, change) for name, v in fields.items()}
        if any(changed[name] is not v for name, v in fields.items()):
            return dataclasses.replace(value, **changed)
    return value


def program() -> str:
    """Version and sources of this project, in short: what another one made is made anew."""
    return _program_in(INSTALLED)


@functools.cache
def _program_in(folder: Path) -> str:
    """The same of the packages in a folder; they are read once, which takes less than a tenth of a second."""
    try:
        version = importlib.metadata.version("scapekit")
    except importlib.metadata.PackageNotFoundError:
        version = "not installed"
    sources = hashlib.sha256()
    computes = {".py", ".json", ".npz"}  # endings of what changes results: modules, layouts, the humanoid, people
    found = {path.relative_to(folder).as_posix(): path for name in PACKAGES for path in (folder / name).rglob("*")
             if path.suffix in computes}
    for name in sorted(found):
        # sources of viewer.js, which wheels do not have
        if not name.startswith("scanprep/viewer/source/"):
            content = found[name].read_bytes()
            sources.update(f"{name} {len(content)} ".encode() + content)
    return f"{version}, sources {sources.hexdigest()[:12]}"
