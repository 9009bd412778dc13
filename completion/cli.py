"""What the commands of this package share."""
from __future__ import annotations

import warnings
from pathlib import Path
from typing import Annotated

import numpy as np

from model.body import BodyModel
from model.linear import Subject
from scanprep.arguments import Alias, Called

ModelOrNone = Annotated[Path | None, Alias("-m")]
Out = Annotated[Path, Alias("-o"), Called("--output")]


def read_model(path: Path | None) -> tuple[BodyModel, str]:
    """Read a model from a file, by default that of the built-in people; also return its name for reports."""
    from model.files import BUILT_IN, load_model

    if path is None:
        warnings.warn("no model named, so that of the built-in people is used: the shapes of soldiers (ANSUR II)",
                      stacklevel=2)
    return load_model(path or BUILT_IN), str(path or BUILT_IN)


def body_of(model: BodyModel, subject: str | None, unit: str | None) -> BodyModel | Subject:
    """Return the model where the person's shape is to be found, else a body of known shape (--subject)."""
    if subject is None and model.n_betas:
        return model
    from model.posing.cli import read_subject  # imported here, as it loads the learning code

    return read_subject(model, None if subject in (None, "template") else Path(str(subject)), unit)


def marks_of_template(model: BodyModel, file: Path | None, name: str, wanted: bool = True) -> dict[str, int]:
    """Return vertices of a model's template by name, from a file or the model itself.

    `name` is the model's, for messages. ValueError where there are no landmarks and they are wanted.
    """
    from scanprep.geometry.landmarks import read_landmark_vertices

    if file is not None:
        return read_landmark_vertices(file, model.template)
    stored = model.info.get("landmarks") or {}
    if wanted and not stored:
        raise ValueError(f"{name}: the model keeps no landmarks of its template; name them with --template-landmarks")
    return {name: int(vertex) for name, vertex in stored.items()}


def read_landmark_pairs(model: BodyModel, name: str, scan: Path, template: Path | None, unit: str | None
                        ) -> tuple[np.ndarray, np.ndarray] | None:
    """Return vertices (L,) and points (L, 3) of landmarks that file and model share; None where too few."""
    from scanprep.geometry.landmarks import read_landmarks, try_match_landmarks

    return try_match_landmarks(scan, marks_of_template(model, template, name), read_landmarks(scan, None, unit))
