"""Moving bodies as binary glTF 2.0."""
from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..geometry.format_glb import Glb, one_mesh, turn_up
from ..geometry.mesh import Mesh
from ..geometry.storage import write_file


def skin_material(color: Sequence[float] = (0.60, 0.57, 0.53)) -> dict[str, Any]:
    """Make a matt glTF material of one colour (linear light)."""
    return {"name": "skin", "pbrMetallicRoughness": {
        "baseColorFactor": [*color, 1], "metallicFactor": 0, "roughnessFactor": 0.75}}


def write_animated_glb(path: str | Path, faces: np.ndarray, frames: np.ndarray, rate: float, up: int = 2) -> None:
    """Write a moving mesh without a skeleton as GLB that any glTF 2.0 viewer plays.

    Every frame is a morph target with its own normals; the animation blends from one to the next. Only the core of glTF
    is used. A body with a skeleton gives a smaller file with `write_glb` of a motion.

    Parameters
    ----------
    path : str or Path
        File to write.
    faces : (F, 3) int
        Triangles.
    frames : (T, N, 3) float, metres
        Vertices of every frame.
    rate : float, frames per second
        How fast it is played.
    up : int
        Axis that points up, which is turned to y.
    """
    write_file(path, encode_animated_glb(faces, frames, rate, up))


def encode_animated_glb(faces: np.ndarray, frames: np.ndarray, rate: float, up: int = 2) -> bytes:
    """Return the bytes that `write_animated_glb` writes."""
    frames, faces = np.asarray(frames, dtype=float), np.asarray(faces)
    _check(frames, rate)
    turn = turn_up(up).T
    glb, count = Glb(), len(frames) - 1
    # the first frame is the mesh, every other one a morph target
    first = Mesh(frames[0] @ turn, faces)
    mesh: dict[str, Any] = {"name": "body", "primitives": [
        glb.add_surface(first, targets=[frame @ turn - first.vertices for frame in frames[1:]])]}
    document = one_mesh(mesh, skin_material(), {"name": "body"})
    if count:
        # the animation: at frame t the weight of target t is 1, all others are 0
        mesh["weights"] = [0] * count
        mesh["extras"] = {"targetNames": [f"frame {t}" for t in range(1, count + 1)]}
        times = glb.add(np.arange(count + 1) / rate, "SCALAR", None, bounds=True)
        weights = glb.add(np.eye(count + 1)[:, 1:].ravel(), "SCALAR", None)
        document["animations"] = [{
            "name": "motion", "samplers": [{"input": times, "output": weights, "interpolation": "LINEAR"}],
            "channels": [{"sampler": 0, "target": {"node": 0, "path": "weights"}}]}]
    return glb.pack(document, up)


def _check(frames: np.ndarray, rate: float) -> None:
    """Raise ValueError for frames or a rate that cannot be written."""
    if frames.ndim != 3 or frames.shape[2] != 3 or not len(frames):
        raise ValueError(f"frames: expected shape (T, N, 3) with at least one frame, got {frames.shape}")
    bad = np.flatnonzero(~np.isfinite(frames).all(axis=(1, 2)))
    if len(bad):
        raise ValueError(f"frames: {len(bad)} are not finite, the first is frame {bad[0]}")
    if not rate > 0:
        raise ValueError(f"rate: expected a positive number of frames a second, got {rate}")
