"""Kinds of files, and what other files beside them say about them."""
from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from model.files import KINDS, LOADERS
from model.motion.files import is_motion
from scanprep.dataset import RegisteredSet
from scanprep.depth_camera.picture import camera_file, is_picture
from scanprep.geometry import storage
from scanprep.geometry.files import ENDINGS, ending_of
from scanprep.geometry.mesh import Mesh

from ..mocap.files.markers import READERS
from ..mocap.marker_sets.layout import MarkerLayout

DEEP = 3                             # levels of folders to search: people, their recordings, and the results of these


def viewable_kind(path: Path) -> str:
    """Return the kind of a file: model, motion, completion, markers, surface, picture, or a description of others."""
    if zipfile.is_zipfile(path):
        names = storage.names_in(path, "a model or a motion")
        if storage.HEADER not in names:
            return "motion" if is_motion(path) else f"an archive of {', '.join(sorted(names)) or 'nothing'}"[:100]
        kind = storage.kind_of_stored(path)
        return "model" if kind in KINDS else kind if kind == "completion" else f"a file of kind '{kind}'"
    suffix = path.suffix.lower()
    if suffix == ".bvh":
        return "motion"
    if suffix in READERS:
        return "markers"
    if is_picture(path):
        return "picture" if camera_file(path).exists() else f"a picture without {camera_file(path).name} beside it"
    return "surface" if ending_of(path) in ENDINGS else f"'{path.suffix or path.name}'"


def model_of_report(path: Path) -> Path | None:
    """Return the model named in the report of a command: a built-in one, or its file if it still exists; else None.

    Results and model may have been moved together: a file is sought in the folders above the report too.
    """
    try:
        settings: Any = storage.read_json(path, "a report").get("settings", {})
        model = Path(str(settings["model"]))
    except (storage.StorageError, AttributeError, KeyError, TypeError):
        return None
    places = [*(folder / model for folder in list(path.absolute().parents)[:DEEP]), model]
    return next((place for place in places if place.is_file()), model if str(model) in LOADERS else None)


def worst_first(registered: RegisteredSet) -> list[tuple[str, str]]:
    """Return names and main reason for doubt, worst first; in the order of the set where there are no figures."""
    from scanprep.pipeline.page import judge_set

    try:
        verdicts = judge_set(registered.folder)
    except (OSError, ValueError):
        return [(name, "") for name in registered.names]
    judged = {verdict.name: next(iter(verdict.reasons), "") for verdict in verdicts if verdict.name in registered.names}
    return [*judged.items(), *((name, "") for name in registered.names if name not in judged)]


def layout_places(path: Path, mesh: Mesh | None) -> dict[str, np.ndarray]:
    """Return where the markers of a layout are on a mesh; empty for a file that is not a layout."""
    if path.suffix.lower() != ".json" or mesh is None:
        return {}
    tree = storage.read_json(path, "landmarks or a layout")
    if not isinstance(tree, dict) or "markersets" not in tree:
        return {}
    layout = MarkerLayout.load(path, len(mesh.vertices))
    return dict(zip(layout.labels, layout.place(mesh), strict=True))
