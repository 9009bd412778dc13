"""Markers clicked on a scan of the person who wears them: the completed body tells where they sit on the model."""
from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from model.motion.bvh import USUAL_RATE
from scanprep.cli import MM
from scanprep.console import Metric

from ..mocap.files.markers import READERS, read_markers
from ..mocap.marker_sets.named import layout_names, layout_on, set_labels
from .completion import Completion

LAYOUT = "layout.json"


def extra_markers(places: Mapping[str, np.ndarray], marks: Mapping[str, int]) -> dict[str, np.ndarray]:
    """Of all that was clicked on a scan what is no landmark of the model."""
    return {name: place for name, place in places.items() if name not in marks}


def write_worn(folder: Path, done: Completion, places: Mapping[str, np.ndarray]) -> list[Metric]:
    """Write the layout of markers at places (3,) of the scan; how many there are and how far from the completed body.

    [SCAPE] §8
    """
    if not places:
        return []
    layout, distances = layout_on(done.completed, {name: done.scale * place for name, place in places.items()})
    layout.save(folder / LAYOUT)
    far = int(distances.argmax())
    return [Metric("markers clicked", len(places), f"places on the model in {LAYOUT}"),
            Metric(f"largest distance of a marker from the body ({layout.labels[far]})", MM * float(distances[far]),
                   "mm")]


def is_recording(path: Path) -> bool:
    """Whether a file is one of measured markers."""
    return path.suffix.lower() in READERS


def labels_of(given: str | Path) -> tuple[str, ...]:
    """The labels of a recording, or of a marker set that comes along; none of anything else."""
    if isinstance(given, Path):
        return read_markers(given, usual_rate=USUAL_RATE).labels if is_recording(given) else ()
    return set_labels(given) if given in layout_names() else ()
