"""One file = named arrays and a JSON header with kind and version; never pickle."""
from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

HEADER = "header"


class StorageError(ValueError):
    """A stored file that is missing, damaged, or of another kind or version."""


@contextlib.contextmanager
def writing(path: str | Path) -> Iterator[Path]:
    """A temporary path beside `path` that takes its place when the block ends without an error.

    The file is never seen half written, and what stood there before stays until the new one is whole.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    try:
        yield beside
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)


@contextlib.contextmanager
def writing_folder(path: str | Path) -> Iterator[Path]:
    """A folder beside `path` that takes its place, whatever stood there, when the block ends without an error.

    One that a killed run left half made is removed first.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    for left in path.parent.iterdir():
        if re.fullmatch(rf"\.{re.escape(path.name)}\.\d+\.part", left.name):
            shutil.rmtree(left, ignore_errors=True)
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        beside.mkdir()
        yield beside
        if path.exists():
            shutil.rmtree(path)
        os.replace(beside, path)
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def as_json(value: Any) -> Any:
    """A value as it comes back from a JSON file: tuples as lists, keys as strings."""
    return json.loads(json.dumps(value))


def write_json(path: str | Path, value: Any) -> None:
    """Write JSON, whole or not at all."""
    with writing(path) as beside:
        beside.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")


def save(path: str | Path, kind: str, version: int, arrays: dict[str, np.ndarray],
         header: dict[str, Any] | None = None) -> None:
    """Write arrays and a JSON header into one `.npz` file.

    Parameters
    ----------
    kind, version
        What the file holds and the number of its layout; `load` checks both.
    arrays : name -> array
        No object arrays.
    header : JSON-serialisable, optional
    """
    text = json.dumps({"kind": kind, "version": version, **(header or {})})
    with writing(path) as beside, open(beside, "wb") as out:
        np.savez_compressed(out, allow_pickle=False, **{HEADER: np.array(text)}, **arrays)


def load_arrays(path: str | Path, what: str = "an .npz file") -> dict[str, np.ndarray]:
    """All arrays of an `.npz` file, or StorageError when it is missing, damaged or holds objects."""
    try:
        with np.load(path, allow_pickle=False) as data:
            return {name: data[name] for name in data.files}
    except FileNotFoundError:
        raise StorageError(f"{path}: no such file") from None
    except (OSError, ValueError, EOFError, KeyError, AttributeError, zipfile.BadZipFile) as error:
        raise StorageError(f"{path}: expected {what}, cannot read it ({error})") from None


def kind_of(path: str | Path) -> str:
    """The kind of a file of `save`, read from its header alone, or StorageError."""
    try:
        with np.load(path, allow_pickle=False) as data:
            return str(_header(path, "scapekit", data[HEADER] if HEADER in data.files else None)["kind"])
    except FileNotFoundError:
        raise StorageError(f"{path}: no such file") from None
    except StorageError:
        raise
    except (OSError, ValueError, EOFError, KeyError, AttributeError, zipfile.BadZipFile) as error:
        raise StorageError(f"{path}: expected an .npz file with a header, cannot read it ({error})") from None


def _header(path: str | Path, kind: str, stored: np.ndarray | None) -> dict[str, Any]:
    if stored is None:
        raise StorageError(f"{path}: expected a {kind} file, found an .npz without a header")
    try:
        header = json.loads(str(stored))
    except ValueError as error:
        raise StorageError(f"{path}: expected a {kind} file, its header is damaged ({error})") from None
    if not isinstance(header, dict):
        raise StorageError(f"{path}: expected a {kind} file, its header is damaged (not a table)")
    return header


def load(path: str | Path, kind: str, versions: tuple[int, ...]) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read a file of `save`.

    Returns
    -------
    header, arrays

    Raises
    ------
    StorageError
        Missing, not such a file, damaged, another kind, or a version that is not in `versions`.
    """
    path = Path(path)
    arrays = load_arrays(path, f"a {kind} file")
    header = _header(path, kind, arrays.pop(HEADER, None))
    if header.get("kind") != kind:
        raise StorageError(f"{path}: expected kind '{kind}', found '{header.get('kind')}'")
    if header.get("version") not in versions:
        known = ", ".join(map(str, versions))
        raise StorageError(f"{path}: {kind} version {header.get('version')} is not known here (known: {known})")
    return header, arrays
