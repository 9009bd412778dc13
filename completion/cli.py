"""What the commands of this package share."""
from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import tyro

from scanprep.console import Metric

ModelFile = Annotated[Path, tyro.conf.arg(aliases=["-m"])]
Out = Annotated[Path, tyro.conf.arg(aliases=["-o"])]


def rows(metrics: list[Metric]) -> list[tuple[str, Any, str]]:
    """The table of a page."""
    return [(m.name, m.value, m.unit) for m in metrics]
