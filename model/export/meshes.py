"""A motion as a folder of meshes."""
from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from scanprep.geometry.files import write_mesh

from ..linear import Subject

Progress = Callable[[int, int], None]


def write_frames(folder: str | Path, subject: Subject, poses: np.ndarray, trans: np.ndarray | None = None,
                 ending: str = ".ply", progress: Progress | None = None) -> list[Path]:
    """Write the exact mesh of every frame, 00000.ply, 00001.ply, ...; the files in the order of the frames."""
    paths = []
    for t, pose in enumerate(poses):
        paths.append(Path(folder) / f"{t:05d}{ending}")
        vertices = subject.vertices(pose, None if trans is None else trans[t])
        write_mesh(paths[-1], subject.template.with_vertices(vertices), "single")
        if progress:
            progress(t + 1, len(poses))
    return paths
