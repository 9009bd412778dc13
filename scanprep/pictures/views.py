"""Where to stand to look at a body whose axes nobody has named."""
from __future__ import annotations

import numpy as np

from ..geometry.mesh import Mesh
from .camera import Camera


def upright(mesh: Mesh) -> tuple[int, float]:
    """The axis that is probably up and the azimuth in degrees of a camera that probably sees the front.

    For pictures only: up is the axis of the largest extent, the front is where the toes point, that is, where the
    lowest twentieth of the body lies from the fifth above it. The widest horizontal direction is taken to be left
    to right.
    """
    extent = np.ptp(mesh.vertices, axis=0)
    up = int(extent.argmax())
    across = [(up + 1) % 3, (up + 2) % 3]
    height = (mesh.vertices[:, up] - mesh.vertices[:, up].min()) / extent[up]
    flat = mesh.vertices[:, across]
    _, directions = np.linalg.eigh(np.cov(flat.T, aweights=mesh.vertex_areas))
    forward = directions[:, 0]
    toes = flat[height < 0.05].mean(axis=0) - flat[(height >= 0.05) & (height < 0.25)].mean(axis=0)
    if forward @ toes < 0:
        forward = -forward
    return up, float(np.degrees(np.arctan2(forward[1], forward[0])))


def look_around(body: Mesh, poses: np.ndarray | None = None, turns: tuple[float, ...] = (0, 90, 180, 270),
                elevation: float = 8.0) -> list[Camera]:
    """Cameras around a body: by default from its front, its left, its back and its right."""
    up, front = upright(body)
    subject = body.vertices if poses is None else np.asarray(poses, dtype=float).reshape(-1, 3)
    return [Camera.around(subject, azimuth=front + turn, elevation=elevation, up=up) for turn in turns]
