"""What lines of sight tell about space: it is empty as far as the surface that was seen [VRIP]."""
from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..fusion.tsdf import mesh_and_camera
from .surface import Rays


class SeenSpace:
    """Space that views look through.

    Parameters
    ----------
    views : sequence of RangeView, or of (Mesh, camera position (3,)) pairs
        In the frame of the points that are asked about.

    [VRIP] space carving
    """

    def __init__(self, views: Sequence[Any]) -> None:
        self._views = [(Rays(mesh), camera) for mesh, camera in map(mesh_and_camera, views)]

    def ahead(self, points: np.ndarray) -> np.ndarray:
        """How far points (n, 3) lie in front of what was seen behind them, along the line of sight.

        Returns
        -------
        (n,) float, metres
            The largest over all views; negative behind the surface of every view, -inf where no line of sight
            through the point ends on a surface.
        """
        best = np.full(len(points), -np.inf)
        for rays, camera in self._views:
            along = points - camera
            depth = np.linalg.norm(along, axis=1)
            along = along / np.maximum(depth, 1e-12)[:, None]
            _, hit = rays.cast(np.broadcast_to(camera, points.shape), along)
            best = np.maximum(best, np.nan_to_num(hit - depth, nan=-np.inf))
        return best
