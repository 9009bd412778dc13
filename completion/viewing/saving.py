"""Bodies and poses of the sliders as files, never over one that is there."""
from __future__ import annotations

from pathlib import Path

import numpy as np

from scanprep.geometry.files import name_of, write_mesh

from ..motion import Motion
from .controls import Controls, Shown


def save_bodies(controls: Controls, folder: Path) -> list[Path]:
    """Every body that is shown as `NAME_body.ply`, made the exact way."""
    written = []
    for one in whole(controls):
        path = free_name(folder / f"{name_of(one.name)}_body.ply")
        write_mesh(path, one.body.mesh(controls.betas_of(one.body), controls.pose_of(one.body), controls.trans))
        written.append(path)
    return written


def save_poses(controls: Controls, folder: Path) -> list[Path]:
    """Pose, place and shape of every body as `NAME_pose.npz`, a motion of one frame."""
    written = []
    for one in whole(controls):
        path = free_name(folder / f"{name_of(one.name)}_pose.npz")
        Motion(controls.pose_of(one.body)[None], controls.trans[None], controls.betas_of(one.body), 1.0,
               np.zeros((1, 0))).save(path)
        written.append(path)
    return written


def whole(controls: Controls) -> list[Shown]:
    """The bodies without those that lie below one."""
    return [one for one in controls.shown if not any(one.body in other.body.layers[1:] for other in controls.shown)]


def free_name(path: Path) -> Path:
    """The path, or the first with a number that is not there yet."""
    tried, number = path, 2
    while tried.exists():
        tried, number = path.with_stem(f"{path.stem}_{number}"), number + 1
    return tried
