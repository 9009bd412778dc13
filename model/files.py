"""Reading a model file of any kind."""
from __future__ import annotations

import importlib
from pathlib import Path

from scanprep.geometry import storage

from .body import BodyModel

_KINDS = {"scape": ("scape", "ScapeModel"), "blendscape": ("scape", "BlendScapeModel"),
          "skinning": ("skinning", "SkinningModel")}


def load_model(path: str | Path) -> BodyModel:
    """Read a model file of any kind.

    Raises
    ------
    StorageError
        Missing, damaged, or of a kind or version that is not known.
    """
    kind = storage.kind_of(path)
    if kind not in _KINDS:
        raise storage.StorageError(f"{path}: expected a body model of kind {', '.join(_KINDS)}, found '{kind}'")
    room, name = _KINDS[kind]
    model: BodyModel = getattr(importlib.import_module(f".{room}", __package__), name).load(path)
    return model
