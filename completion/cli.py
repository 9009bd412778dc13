"""What the commands of this package share."""
from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import tyro

from model.body import BodyModel
from scanprep.console import Metric, bar

ModelFile = Annotated[Path, tyro.conf.arg(aliases=["-m"])]
ModelOrNone = Annotated[Path | None, tyro.conf.arg(aliases=["-m"])]
Out = Annotated[Path, tyro.conf.arg(aliases=["-o"])]


def read_model(path: Path | None) -> tuple[BodyModel, str]:
    """The model of a file, or without one that of the embedded people, and the name that reports give it.

    The latter is built when it is first wanted, with a bar, and kept in the user's cache.
    """
    from model.files import load_model

    from .embedded import embedded_model, embedded_path

    if path is not None:
        return load_model(path), str(path)
    with bar("building the embedded people") as progress:
        model = embedded_model(progress)
    return model, f"embedded people, built {model.info['built']}, cached at {embedded_path()}"


def rows(metrics: list[Metric]) -> list[tuple[str, Any, str]]:
    """The table of a page."""
    return [(m.name, m.value, m.unit) for m in metrics]
