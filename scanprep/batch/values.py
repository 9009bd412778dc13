"""Results as files: numbers, text, arrays and the dataclasses of this project, in one `.npz`; never pickle."""
from __future__ import annotations

import dataclasses
import importlib
from pathlib import Path
from typing import Any

import numpy as np

from ..geometry import storage

KIND, VERSION = "result", 1
PACKAGES = ("scanprep", "model", "completion")


def save_value(path: Path, value: Any, header: dict[str, Any]) -> None:
    """Write a value and a JSON header that can be read without it.

    Values are None, bool, number, text, Path, array, and tuples, lists, dicts with text keys and dataclasses of these.
    """
    arrays: list[np.ndarray] = []
    told = {**header, "value": _pack(value, arrays)}
    storage.save(path, KIND, VERSION, {f"a{i}": array for i, array in enumerate(arrays)}, told, compress=False)


def load_step_header(path: Path) -> dict[str, Any] | None:
    """The header of a file of `save_value`, or None where there is no such file that can be read."""
    try:
        header = storage.load_header(path, KIND)
    except storage.StorageError:         # whatever is wrong with the file, the result is made anew
        return None
    return header if (header.get("kind"), header.get("version")) == (KIND, VERSION) else None


def load_value(path: Path) -> Any:
    """The value of a file of `save_value`; StorageError where it is missing, damaged or of another version."""
    header, arrays = storage.load(path, KIND, (VERSION,))
    with storage.taking_apart(path, "a result"):
        return _unpack(header["value"], [arrays[f"a{i}"] for i in range(len(arrays))])


def _pack(value: Any, arrays: list[np.ndarray]) -> Any:
    """JSON for a value; arrays are put aside."""
    if isinstance(value, np.ndarray | np.generic):           # before numbers: some scalars are Python's floats too
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


def _unpack(told: Any, arrays: list[np.ndarray]) -> Any:
    if isinstance(told, list):
        return [_unpack(v, arrays) for v in told]
    if not isinstance(told, dict):
        return told
    if "array" in told:
        found = arrays[told["array"]]
        return found[()] if told["scalar"] else found
    if "path" in told:
        return Path(told["path"])
    if "tuple" in told:
        return tuple(_unpack(v, arrays) for v in told["tuple"])
    if "dict" in told:
        return {_unpack(k, arrays): _unpack(v, arrays) for k, v in told["dict"]}
    # an object of a frozen dataclass of this project, by its constructor, which does nothing but check its values;
    # folders of results travel, so the name may be anything
    name, values = told["class"], {name: _unpack(v, arrays) for name, v in told["fields"].items()}
    module, _, qualified = name.partition(":")
    if module.split(".")[0] not in PACKAGES:
        raise ValueError(f"{name} is not of this project")
    kind: Any = importlib.import_module(module)
    for part in qualified.split("."):
        kind = getattr(kind, part)
    params = getattr(kind, "__dataclass_params__", None)
    if not isinstance(kind, type) or params is None or not params.frozen or kind.__module__ != module:
        raise ValueError(f"{name} is not a dataclass that is kept")
    if values.keys() != {f.name for f in dataclasses.fields(kind)}:
        raise ValueError(f"{name}: expected the values {', '.join(f.name for f in dataclasses.fields(kind))}")
    made = kind(**{f.name: values[f.name] for f in dataclasses.fields(kind) if f.init})
    for f in dataclasses.fields(kind):
        if not f.init:
            object.__setattr__(made, f.name, values[f.name])
    return made
