"""Results as files: numbers, text, arrays and dataclasses of this project in one `.npz`, without pickle."""
from __future__ import annotations

import dataclasses
import importlib
from pathlib import Path
from typing import Any

import numpy as np

from ..geometry import storage

# what the header of a file says; another version is computed again
KIND, VERSION = "result", 1
# only dataclasses of these are stored and restored: a file from elsewhere must not start other code
PACKAGES = ("scanprep", "model", "completion")


def save_value(path: Path, value: Any, header: dict[str, Any]) -> None:
    """Write a value, and a JSON header that can be read without loading the value.

    A value is None, bool, number, text, Path, array, or tuples, lists, dicts with text keys and dataclasses of these.
    """
    arrays: list[np.ndarray] = []
    packed = {**header, "value": _pack(value, arrays)}
    storage.save(path, KIND, VERSION, {f"a{i}": array for i, array in enumerate(arrays)}, packed, compress=False)


def load_step_header(path: Path) -> dict[str, Any] | None:
    """Read the header of a file of `save_value`; None where the file is missing or cannot be read."""
    try:
        header = storage.load_header(path, KIND)
    except storage.StorageError:         # whatever is wrong with the file, the result is computed again
        return None
    return header if (header.get("kind"), header.get("version")) == (KIND, VERSION) else None


def load_value(path: Path) -> Any:
    """Read the value of a file of `save_value`; StorageError where it is missing, damaged or of another version."""
    header, arrays = storage.load(path, KIND, (VERSION,))
    with storage.taking_apart(path, "a result"):
        return _unpack(header["value"], [arrays[f"a{i}"] for i in range(len(arrays))])


def _pack(value: Any, arrays: list[np.ndarray]) -> Any:
    """Convert a value to JSON; arrays go into the list, and their place in it into the JSON."""
    if isinstance(value, np.ndarray | np.generic):           # before numbers: np.float64 is a float too
        if value.dtype.hasobject:
            raise TypeError("arrays of objects are not kept")
        arrays.append(np.asarray(value))
        return {"array": len(arrays) - 1, "scalar": isinstance(value, np.generic)}
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, Path):
        return {"path": str(value)}
    if isinstance(value, list):
        return [_pack(v, arrays) for v in value]
    if isinstance(value, tuple):
        return {"tuple": [_pack(v, arrays) for v in value]}
    if isinstance(value, dict):
        return {"dict": [[_pack(k, arrays), _pack(v, arrays)] for k, v in value.items()]}
    if dataclasses.is_dataclass(value) and type(value).__module__.split(".")[0] in PACKAGES:
        kept = {f.name: _pack(getattr(value, f.name), arrays) for f in dataclasses.fields(value)}
        return {"class": f"{type(value).__module__}:{type(value).__qualname__}", "fields": kept}
    raise TypeError(f"cannot keep a {type(value).__name__}")


def _unpack(packed: Any, arrays: list[np.ndarray]) -> Any:
    """Convert JSON of `_pack` back to the value."""
    if isinstance(packed, list):
        return [_unpack(v, arrays) for v in packed]
    if not isinstance(packed, dict):
        return packed
    if "array" in packed:
        array = arrays[packed["array"]]
        return array[()] if packed["scalar"] else array
    if "path" in packed:
        return Path(packed["path"])
    if "tuple" in packed:
        return tuple(_unpack(v, arrays) for v in packed["tuple"])
    if "dict" in packed:
        return {_unpack(k, arrays): _unpack(v, arrays) for k, v in packed["dict"]}
    # restore a frozen dataclass of this project through its constructor, which only checks its values;
    # folders of results are passed around, so the name in the file is not trusted
    name, values = packed["class"], {name: _unpack(v, arrays) for name, v in packed["fields"].items()}
    module, _, qualified = name.partition(":")
    if module.split(".")[0] not in PACKAGES:
        raise ValueError(f"{name} is not of this project")
    kind: Any = importlib.import_module(module)
    for part in qualified.split("."):
        kind = getattr(kind, part)
    options = getattr(kind, "__dataclass_params__", None)
    if not isinstance(kind, type) or options is None or not options.frozen or kind.__module__ != module:
        raise ValueError(f"{name} is not a dataclass that is kept")
    if values.keys() != {f.name for f in dataclasses.fields(kind)}:
        raise ValueError(f"{name}: expected the values {', '.join(f.name for f in dataclasses.fields(kind))}")
    return kind(**values)
