"""Reading a model file of any kind."""
from __future__ import annotations

import importlib
from pathlib import Path

from scanprep.geometry import storage

from .body import BodyModel

# by the name of the kind in files: the module and the class; a new kind is a new line
BUILT_IN = "people"                   # the name of the built-in model wherever a model file is asked for
KINDS = {"scape": ("model.scape", "ScapeModel"), "blendscape": ("model.scape", "BlendScapeModel"),
         "skinning": ("model.skinning", "SkinningModel")}


def load_model(path: str | Path) -> BodyModel:
    """Read a model file of any kind; the name "people" is that of the built-in model.

    Raises
    ------
    StorageError
        Missing, damaged, or of a kind or version that is not known.
    """
    # a folder of that name, as people keep, is no model file
    if str(path) == BUILT_IN and not Path(path).is_file():
        from .built_in import load_built_in_model

        return load_built_in_model()
    kind = storage.kind_of(path)
    if kind not in KINDS:
        raise storage.StorageError(f"{path}: expected a body model of kind {', '.join(KINDS)}, found '{kind}'")
    module, name = KINDS[kind]
    model: BodyModel = getattr(importlib.import_module(module), name).load(path)
    return model
