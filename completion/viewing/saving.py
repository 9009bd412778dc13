"""Save bodies and poses of the sliders, never over an existing file."""
from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np

from scanprep.geometry.files import name_of, write_mesh

from ..motion import Motion
from .controls import Controls
from .movable import MovableBody


def save_bodies(controls: Controls, folder: Path) -> list[Path]:
    """Save every body that is shown as `NAME_body.ply`, computed with the exact model."""
    return _save(controls, folder, "body.ply", lambda path, body: write_mesh(
        path, body.mesh(controls.betas_of(body), controls.pose_of(body))))


def save_poses(controls: Controls, folder: Path) -> list[Path]:
    """Save pose and shape of every body as `NAME_pose.npz`, a motion of one frame."""
    return _save(controls, folder, "pose.npz", lambda path, body: Motion(
        controls.pose_of(body)[None], np.zeros((1, 3)), controls.betas_of(body), 1.0, np.zeros((1, 0))).save(path))


def _save(controls: Controls, folder: Path, ending: str, write: Callable[[Path, MovableBody], None]) -> list[Path]:
    """Write a file for each body."""
    written = []
    for one in controls.shown:
        written.append(free_name(folder / f"{name_of(one.name)}_{ending}"))
        write(written[-1], one.body)
    return written


def free_name(path: Path) -> Path:
    """Return the path, or the first one with a number that does not exist yet."""
    candidate, number = path, 2
    while os.path.lexists(candidate):
        candidate, number = path.with_stem(f"{path.stem}_{number}"), number + 1
    return candidate
