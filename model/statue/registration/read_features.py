"""Features that somebody clicked: joint centres and points of the surface from a file."""
from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from scanprep.geometry.format_common import UNITS
from scanprep.geometry.landmarks import read_landmarks
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.storage import StorageError, numbers, read_json, taking_apart

from ..control.model import ControlModel
from .medial import MedialAxis

WANTED = 'features {name: [x, y, z]} or {name: {"ray": [[x, y, z], [x, y, z]], "depth": d}}'


def read_features(path: Path, control: ControlModel, scan: Mesh, unit: str | None = None
                  ) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Joint centres and surface points, metres, by the names of the control model's joints and landmarks.

    Any landmark file is read. In JSON a joint may also be a click, `{"ray": [origin, direction], "depth": d}`: its
    centre is then on the ray, where that is nearest to the medial axis of the scan, and d farther.

    Parameters
    ----------
    scan : Mesh, metres
    unit : of the file

    Raises
    ------
    ValueError
        Names that the control model does not have, a ray that misses the body.
    StorageError
        A file that is missing or damaged.
    """
    rays = _rays(path) if path.suffix == ".json" else {}
    found = read_landmarks(path, scan, unit) if not rays else _places(path, rays, unit)
    known = {*control.skeleton.names, *control.landmarks}
    strange = [name for name in [*rays, *found] if name not in known]
    if strange:
        raise ValueError(f"{path}: the control model has no joint or landmark '{strange[0]}'; its joints are "
                         f"{', '.join(control.skeleton.names)}; its landmarks {', '.join(control.landmarks)}")
    joints = {name: place for name, place in found.items() if name in control.skeleton.names}
    if rays:
        medial, metre = MedialAxis(scan), UNITS[unit or "m"]
        for name, (origin, direction, depth) in rays.items():
            try:
                joints[name] = medial.nearest_to_ray(metre * origin, direction, metre * depth)
            except ValueError as error:
                raise ValueError(f"{path}: {name}: {error}") from None
    return joints, {name: place for name, place in found.items() if name in control.landmarks}


def _rays(path: Path) -> dict[str, tuple[np.ndarray, np.ndarray, float]]:
    tree = read_json(path, WANTED)
    with taking_apart(path, WANTED):
        clicks = {name: one for name, one in tree.items() if isinstance(one, dict) and "ray" in one} \
            if isinstance(tree, dict) else {}
        return {name: (*_ray(name, one), float(one.get("depth", 0.0))) for name, one in clicks.items()}


def _ray(name: str, click: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    origin, direction = numbers({name: np.array(click["ray"], dtype=np.float64)}, name, 2, 3)
    return origin, direction


def _places(path: Path, rays: dict[str, Any], unit: str | None) -> dict[str, np.ndarray]:
    """The plain places of a file that has clicks as well."""
    with taking_apart(path, WANTED):
        places = {name: numbers({name: np.array(one, dtype=np.float64)}, name, 3)
                  for name, one in read_json(path, WANTED).items() if name not in rays}
    if unit is not None and unit not in UNITS:
        raise StorageError(f"{path}: unknown unit {unit}")
    return {name: UNITS[unit or "m"] * place for name, place in places.items()}
