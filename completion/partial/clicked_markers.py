"""Markers clicked on a scan of the person who wears them: the completed body gives their layout on the model."""
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


def extra_markers(places: Mapping[str, np.ndarray], marks: Mapping[str, int]) -> dict[str, np.ndarray]:
    """Return the clicked points that are not landmarks of the model."""
    return {name: place for name, place in places.items() if name not in marks}


def write_clicked_markers(folder: Path, done: Completion, places: Mapping[str, np.ndarray]) -> list[Metric]:
    """Write the layout of markers at places (3,) of the scan; return their number and distance from the body.

    [SCAPE] §8
    """
    if not places:
        return []
    layout, distances = layout_on(done.completed, {name: done.scale * place for name, place in places.items()})
    layout_file = "layout.json"
    layout.save(folder / layout_file)
    far = int(distances.argmax())
    return [Metric("markers clicked", len(places), f"places on the model in {layout_file}"),
            Metric(f"largest distance of a marker from the body ({layout.labels[far]})", MM * float(distances[far]),
                   "mm")]


def is_recording(path: Path) -> bool:
    """Tell whether a file is a recording of markers."""
    return path.suffix.lower() in READERS


def labels_of(source: str | Path) -> tuple[str, ...]:
    """Return the labels of a recording or of a built-in marker set; none for anything else."""
    if isinstance(source, Path):
        return read_markers(source, usual_rate=USUAL_RATE).labels if is_recording(source) else ()
    return set_labels(source) if source in layout_names() else ()
