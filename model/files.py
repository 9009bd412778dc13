"""Read model files of any kind."""
from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path

from scanprep.geometry import storage

from .body import BodyModel

BUILT_IN = "people"                   # stands for the built-in model wherever a model file is expected
# built-in models: the module and the function that reads them
LOADERS = {BUILT_IN: ("model.built_in", "load_built_in_model"),
           "people-fingers": ("model.built_in", "load_fingered_model")}
# kinds of models, by their name in files: the module and the class; a new kind is a new line
KINDS = {"scape": ("model.scape", "ScapeModel"), "blendscape": ("model.scape", "BlendScapeModel"),
         "skinning": ("model.skinning", "SkinningModel")}


def load_model(path: str | Path) -> BodyModel:
    """Read a model file of any kind.

    Parameters
    ----------
    path : str or Path
        A model file (`.npz`), or "people" or "people-fingers" for the built-in models.

    Returns
    -------
    BodyModel
        A `ScapeModel`, `BlendScapeModel` or `SkinningModel`.

    Raises
    ------
    StorageError
        The file is missing, damaged, or of an unknown kind or version.

    Examples
    --------
    >>> model = load_model("people")
    >>> model.kind, model.n_betas
    ('scape', 30)
    """
    # a file called "people" is read as a file; a folder of that name is no model file
    if str(path) in LOADERS and not Path(path).is_file():
        module, name = LOADERS[str(path)]
        load: Callable[[], BodyModel] = getattr(importlib.import_module(module), name)
        return load()
    kind = storage.kind_of_stored(path)
    if kind not in KINDS:
        raise storage.StorageError(f"{path}: expected a body model of kind {', '.join(KINDS)}, found '{kind}'")
    module, name = KINDS[kind]
    model: BodyModel = getattr(importlib.import_module(module), name).load(path)
    return model
