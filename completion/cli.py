"""What the commands of this package share."""
from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np

from model.body import BodyModel
from scanprep.arguments import Alias, Called
from scanprep.console import Metric, bar, say

ModelFile = Annotated[Path, Alias("-m")]
ModelOrNone = Annotated[Path | None, Alias("-m")]
Out = Annotated[Path, Alias("-o"), Called("--output")]


def read_model(path: Path | None) -> tuple[BodyModel, str]:
    """The model of a file, or without one that of the synthetic people, and the name that reports give it.

    The latter is built when it is first wanted, with a bar, and kept in the user's cache.
    """
    from model.files import load_model

    from .synthetic_people import synthetic_model, synthetic_path

    if path is not None:
        return load_model(path), str(path)
    say("note: no model named; that of the synthetic people, who are made and not measured, gives a first answer")
    with bar("building the synthetic people") as progress:
        model = synthetic_model(progress)
    return model, f"synthetic people, built {model.info['built']}, cached at {synthetic_path()}"


def read_landmark_pairs(model: BodyModel, name: str, scan: Path, template: Path | None, unit: str | None
                        ) -> tuple[np.ndarray, np.ndarray] | None:
    """Vertices (L,) and points (L, 3) of the landmarks that a file and the model have in common; None where too few."""
    from scanprep.geometry.landmarks import read_landmark_vertices, read_landmarks, shared_landmarks

    kept = model.info.get("landmarks") if template is None else read_landmark_vertices(template, model.template)
    if not kept:
        raise ValueError(f"{name}: the model keeps no landmarks of its template; name them with --template-landmarks")
    return shared_landmarks(scan, kept, read_landmarks(scan, None, unit))


def rows(metrics: list[Metric]) -> list[tuple[str, Any, str]]:
    """The table of a page."""
    return [(m.name, m.value, m.unit) for m in metrics]
