"""Values at the vertices of an evenly subdivided control mesh, read from an image and interpolated anywhere."""
from __future__ import annotations

import numpy as np

from scanprep.geometry.mesh import Mesh

from ..control.chart import Chart
from .subdivision import subdivide
from .texels import Texels


class Lattice:
    """A control mesh subdivided evenly, whose triangles are found by their place without a search.

    Parameters
    ----------
    mesh, chart : Mesh, Chart
    level : int

    Attributes
    ----------
    mesh : Mesh
        The control mesh.
    subdivision : Subdivision
    fine : Mesh
        Its vertices on the control mesh.
    """

    def __init__(self, mesh: Mesh, chart: Chart, level: int) -> None:
        self.subdivision = subdivide(mesh, chart, level)
        self.fine = self.subdivision.mesh(mesh)
        self.mesh, self._chart, self._steps = mesh, chart, 2**level
        uv_corners = chart.uv[chart.faces]
        fine_uv = self.subdivision.chart.uv[self.subdivision.chart.faces]
        parent = self.subdivision.face_parent[:, None]
        e, f = (uv_corners[parent, k] - uv_corners[parent, 0] for k in (1, 2))
        w = fine_uv - uv_corners[parent, 0]
        area = e[..., 0] * f[..., 1] - e[..., 1] * f[..., 0]
        i = np.rint((w[..., 0] * f[..., 1] - w[..., 1] * f[..., 0]) / area * self._steps).astype(int)
        j = np.rint((e[..., 0] * w[..., 1] - e[..., 1] * w[..., 0]) / area * self._steps).astype(int)
        self._vertex = np.full((len(mesh.faces), self._steps + 2, self._steps + 2), -1)
        self._vertex[parent, i, j] = self.subdivision.faces

    def places(self, faces: np.ndarray, bary: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """For places of the control mesh the three fine vertices (n, 3) around each, and their shares (n, 3)."""
        x, y = np.clip(bary[:, 1:] * self._steps, 0, self._steps).T
        i, j = np.minimum(x.astype(int), self._steps - 1), np.minimum(y.astype(int), self._steps - 1)
        i, j = np.where(i + j >= self._steps, self._steps - 1 - j, i), j
        i = np.maximum(i, 0)
        x, y = x - i, y - j
        upper = (x + y > 1) & (i + j + 2 <= self._steps)
        one = np.stack([i + upper, j + upper], axis=1)
        a = self._vertex[faces, one[:, 0], one[:, 1]]
        b, c = self._vertex[faces, i + 1, j], self._vertex[faces, i, j + 1]
        u, v = np.where(upper, 1 - y, x), np.where(upper, 1 - x, y)
        share = np.clip(np.stack([1 - u - v, u, v], axis=1), 0, 1)
        return np.stack([a, b, c], axis=1), share / share.sum(axis=1, keepdims=True)

    def sample(self, values: np.ndarray, faces: np.ndarray, bary: np.ndarray) -> np.ndarray:
        """Values (n,) or (n, k) at places of the control mesh, linear between those of the fine vertices."""
        vertex, share = self.places(faces, bary)
        return np.einsum("nc,nc...->n...", share, values[vertex])

    def gather(self, texels: Texels, values: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What the pixels (n,) say of the fine vertices, and of which they say anything.

        Bilinear, from one side of a seam; a vertex is known where all four pixels around it are.
        """
        size = texels.size
        image, sure = np.zeros(size**2), np.zeros(size**2, dtype=bool)
        image[texels.pixels], sure[texels.pixels] = np.where(known, values, 0), known
        corners = self._chart.uv[self._chart.faces[self.subdivision.parent]]
        x, y = (np.einsum("nc,ncd->nd", self.subdivision.bary, corners) * size - 0.5).T
        left, low = np.floor(x).astype(int), np.floor(y).astype(int)
        out, all_known = np.zeros(len(x)), np.ones(len(x), dtype=bool)
        for dx in (0, 1):
            for dy in (0, 1):
                pixel = np.clip(size - 1 - low - dy, 0, size - 1) * size + np.clip(left + dx, 0, size - 1)
                out += np.abs(1 - dx - (x - left)) * np.abs(1 - dy - (y - low)) * image[pixel]
                all_known &= sure[pixel]
        return out, all_known
