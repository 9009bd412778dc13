"""Features in a file: joint centres and surface points, as `scape pick --joints` writes them."""
from __future__ import annotations

from pathlib import Path

import numpy as np

from scanprep.geometry.landmarks import read_landmarks
from scanprep.geometry.mesh import Mesh

from ..control.model import ControlModel


def read_features(path: Path, control: ControlModel, scan: Mesh, unit: str | None = None,
                  scale: float = 1.0) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Read joint centres and surface points, metres, by the names of the control model's joints and landmarks.

    Any landmark file is read, in its `unit`. `scale` is by how much the scan is larger than in its file.
    """
    places = read_landmarks(path, scan.with_vertices(scan.vertices / scale), unit)
    known = {*control.skeleton.names, *control.landmarks}
    strange = [name for name in places if name not in known]
    if strange:
        raise ValueError(f"{path}: the control model has no joint or landmark '{strange[0]}'; its joints are "
                         f"{', '.join(control.skeleton.names)}; its landmarks {', '.join(control.landmarks)}")
    places = {name: scale * place for name, place in places.items()}
    joints = {name: place for name, place in places.items() if name in control.skeleton.names}
    return joints, {name: place for name, place in places.items() if name in control.landmarks}
