"""Bodies and poses of the sliders as files, never over one that is there."""
from __future__ import annotations

from pathlib import Path

import numpy as np

from scanprep.geometry.files import write_mesh

from ..motion import Motion
from .controls import Controls


def save_bodies(controls: Controls, folder: Path) -> list[Path]:
    """Every body that is shown as `NAME_body.ply`, made the exact way."""
    written = []
    for one in controls.shown:
        model, path = one.body.model, free_name(folder / f"{Path(one.name).stem}_body.ply")
        write_mesh(path, model.template.with_vertices(
            model.vertices(controls.pose_of(one.body), controls.betas_of(one.body), controls.trans)))
        written.append(path)
    return written


def save_poses(controls: Controls, folder: Path) -> list[Path]:
    """Pose, place and shape of every body as `NAME_pose.npz`, a motion of one frame."""
    written = []
    for one in controls.shown:
        path = free_name(folder / f"{Path(one.name).stem}_pose.npz")
        Motion(controls.pose_of(one.body)[None], controls.trans[None], controls.betas_of(one.body), 1.0,
               np.zeros((1, 0))).save(path)
        written.append(path)
    return written


def free_name(path: Path) -> Path:
    """The path, or the first with a number that is not there yet."""
    tried, number = path, 2
    while tried.exists():
        tried, number = path.with_stem(f"{path.stem}_{number}"), number + 1
    return tried
