"""What lines of sight tell about space: it is empty as far as the surface that was seen [VRIP]."""
from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from .mesh import Mesh
from .surface import Rays


def mesh_and_camera(view: Any) -> tuple[Mesh, np.ndarray]:
    """The surface and the camera position of a RangeView or a pair."""
    mesh, camera = view if isinstance(view, tuple) else (view.mesh, view.camera)
    camera = np.asarray(camera, dtype=float)
    if not isinstance(mesh, Mesh) or camera.shape != (3,) or not np.isfinite(camera).all():
        raise ValueError("views: expected RangeViews or pairs of a Mesh and a camera position (3,)")
    return mesh, camera


class SeenSpace:
    """Space that views look through: RangeViews, or pairs of a Mesh and a camera position (3,).

    [VRIP] space carving
    """

    def __init__(self, views: Sequence[Any]) -> None:
        self._views = [(Rays(mesh), camera) for mesh, camera in map(mesh_and_camera, views)]

    def ahead(self, points: np.ndarray) -> np.ndarray:
        """How far points (n, 3) lie in front of what was seen behind them, along the line of sight, metres.

        The largest over all views; negative behind the surface of every view, -inf where no line of sight through
        the point ends on a surface.
        """
        best = np.full(len(points), -np.inf)
        for rays, camera in self._views:
            along = points - camera
            depth = np.linalg.norm(along, axis=1)
            along = along / np.maximum(depth, 1e-12)[:, None]
            _, hit = rays.cast(np.broadcast_to(camera, points.shape), along)
            best = np.maximum(best, np.nan_to_num(hit - depth, nan=-np.inf))
        return best
