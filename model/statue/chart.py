"""One flat chart of a control mesh: where every triangle lies in an image."""
from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from scanprep.geometry.mesh import Mesh


@dataclass(frozen=True, eq=False)
class Chart:
    """Texture coordinates of a mesh in one connected piece.

    Parameters
    ----------
    uv : (M, 2) float in [0, 1]
        (0, 0) is the lower left corner of the image, (1, 1) its upper right one. A vertex on a seam has several.
    faces : (F, 3) int
        The rows of `uv` at the corners of every triangle of the mesh, in its order.

    [Statues] Eq. 21
    """

    uv: np.ndarray
    faces: np.ndarray

    @cached_property
    def flat(self) -> Mesh:
        """The chart as a mesh in the plane z = 0."""
        return Mesh(np.column_stack([self.uv, np.zeros(len(self.uv))]), self.faces)
