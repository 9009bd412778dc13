"""What the commands of this package share."""
from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np

from model.body import BodyModel
from model.linear import Subject
from scanprep.arguments import Alias, Called
from scanprep.cli import Unit
from scanprep.console import say

ModelOrNone = Annotated[Path | None, Alias("-m")]
Out = Annotated[Path, Alias("-o"), Called("--output")]


def read_model(path: Path | None) -> tuple[BodyModel, str]:
    """Read the model of a file, or without one that of the built-in people; with the name that reports give it."""
    from model.files import BUILT_IN, load_model

    if path is None:
        say("note: no model named, so that of the built-in people is used: the shapes of soldiers (ANSUR II)")
    return load_model(path or BUILT_IN), str(path or BUILT_IN)


def body_of(model: BodyModel, subject: str | None, unit: Unit | None) -> BodyModel | Subject:
    """The model where the person's shape is to be found, else a body of known shape, as commands have --subject."""
    if subject is None and model.n_betas:
        return model
    from model.posing.cli import read_subject  # with all that makes models

    return read_subject(model, None if subject in (None, "template") else Path(str(subject)), unit)


def marks_of_template(model: BodyModel, given: Path | None, name: str, wanted: bool = True) -> dict[str, int]:
    """Vertices of a model's template by name, from a file or the model itself; `name` is the model's.

    ValueError where there are none and they are wanted.
    """
    from scanprep.geometry.landmarks import read_landmark_vertices

    if given is not None:
        return read_landmark_vertices(given, model.template)
    kept = model.info.get("landmarks") or {}
    if wanted and not kept:
        raise ValueError(f"{name}: the model keeps no landmarks of its template; name them with --template-landmarks")
    return {name: int(vertex) for name, vertex in kept.items()}


def read_landmark_pairs(model: BodyModel, name: str, scan: Path, template: Path | None, unit: Unit | None
                        ) -> tuple[np.ndarray, np.ndarray] | None:
    """Vertices (L,) and points (L, 3) of the landmarks that a file and the model have in common; None where too few."""
    from scanprep.geometry.landmarks import read_landmarks, try_match_landmarks

    return try_match_landmarks(scan, marks_of_template(model, template, name), read_landmarks(scan, None, unit))
