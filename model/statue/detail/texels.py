"""The pixels of a chart: places of the control mesh, inside it and a little beyond its borders."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface

from ..control.chart import Chart, barycentric
from .subdivision import subdivide


@dataclass(frozen=True, eq=False)
class Texels:
    """Pixels of a square image over a chart."""

    size: int
    pixels: np.ndarray  # (n,), row times size plus column; row 0 is the upper one. Ascending
    faces: np.ndarray   # (n,), the control triangle of each
    bary: np.ndarray    # (n, 3)
    inside: np.ndarray  # (n,), in the chart; the others stand for the surface on the other side of the seam

    def image(self, values: np.ndarray, beyond: float | None = None) -> np.ndarray:
        """An image (size, size, ...) of values (n, ...) of the pixels.

        Elsewhere a number; or that of the nearest pixel as far as smaller copies of the image look, and 0 beyond.
        """
        out = np.full((self.size**2, *values.shape[1:]), 0 if beyond is None else beyond, dtype=values.dtype)
        out[self.pixels] = values
        out = out.reshape(self.size, self.size, *values.shape[1:])
        if beyond is None:
            far, (row, column) = _away(self.pixels, self.size)
            around = (far > 0) & (far <= 16)
            out[around] = out[row[around], column[around]]
        return out

    def neighbours(self) -> np.ndarray:
        """(m, 2) pairs of pixels, as numbers in these arrays, that lie side by side in the image."""
        number = np.full((self.size, self.size), -1)
        number.ravel()[self.pixels] = np.arange(len(self.pixels))
        pairs = np.concatenate([np.stack([number[:, :-1].ravel(), number[:, 1:].ravel()], axis=1),
                                np.stack([number[:-1].ravel(), number[1:].ravel()], axis=1)])
        return pairs[(pairs >= 0).all(axis=1)]


def find_texels(mesh: Mesh, chart: Chart, size: int) -> Texels:
    """The pixels of a square image of `size` pixels each way over the chart of a mesh, and four beyond its border."""
    rows, columns, faces, bary = chart.texels(size)
    pixels = rows * size + columns
    far = _away(pixels, size)[0].ravel()
    beside = np.flatnonzero((far > 0) & (far <= 4))
    x, y = (beside % size + 0.5) / size, 1 - (beside // size + 0.5) / size
    face, place = continue_chart(mesh, chart, np.stack([x, y], axis=1))
    order = np.argsort(np.concatenate([pixels, beside]))
    inside = np.repeat([True, False], [len(pixels), len(beside)])
    return Texels(size, np.concatenate([pixels, beside])[order], np.concatenate([faces, face])[order],
                  np.concatenate([bary, place])[order], inside[order])


def _away(pixels: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """How far (size, size) every place of an image is from some pixels, and the nearest of these (2, size, size)."""
    from scipy.ndimage import distance_transform_edt

    empty = np.ones(size**2, dtype=bool)
    empty[pixels] = False
    return distance_transform_edt(empty.reshape(size, size), return_indices=True)


def continue_chart(mesh: Mesh, chart: Chart, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places of the control mesh, triangles (n,) and bary (n, 3), for points of the image (n, 2) beside the chart.

    The triangle at the nearest border goes on in its plane; what lies beyond the seam is laid onto the triangle on its
    other side, as if that were unfolded into the plane. At a border of the mesh itself the border's place is taken.
    """
    flat = chart.flat
    found = Surface(flat).closest(np.column_stack([uv, np.zeros(len(uv))]))
    face, side = found.faces, (np.argmin(found.bary, axis=1) + 1) % 3
    other, back = _across(mesh)
    beyond = np.where(flat.edge_use[flat.face_edges[face, side]] == 1, other[face, side], -1)
    bary = np.clip(found.bary, 0, None)
    seam = np.flatnonzero(beyond >= 0)
    f, s, g, t = face[seam], side[seam], beyond[seam], back[face[seam], side[seam]]
    at = np.einsum("nc,ncd->nd", barycentric(uv[seam], *chart.uv[chart.faces[f]].swapaxes(0, 1)), mesh.corners[f])
    a, b = mesh.vertices[mesh.faces[f, s]], mesh.vertices[mesh.faces[f, (s + 1) % 3]]
    length = np.maximum(np.linalg.norm(b - a, axis=1), 1e-30)
    along = np.einsum("nd,nd->n", at - a, b - a) / length**2
    away = np.linalg.norm(at - a - along[:, None] * (b - a), axis=1)
    apex = mesh.vertices[mesh.faces[g, (t + 2) % 3]]
    foot = np.einsum("nd,nd->n", apex - a, b - a) / length**2
    share = away / np.maximum(np.linalg.norm(apex - a - foot[:, None] * (b - a), axis=1), 1e-30)
    place = np.zeros((len(seam), 3))
    rows = np.arange(len(seam))
    place[rows, (t + 2) % 3] = share
    place[rows, t] = along - share * foot                   # side t of g runs from b to a
    place[rows, (t + 1) % 3] = 1 - share - place[rows, t]
    place = np.clip(place, 0, None)
    face[seam], bary[seam] = g, place
    return face, bary / bary.sum(axis=1, keepdims=True)


def _across(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """The triangle beyond each side (F, 3) and which of its sides that is; -1 at a border."""
    other, back = np.full(mesh.faces.shape, -1), np.full(mesh.faces.shape, -1)
    order = np.argsort(mesh.face_edges.ravel(), kind="stable")
    start = np.concatenate([[0], np.cumsum(mesh.edge_use)[:-1]])[mesh.edge_use == 2]
    one, two = order[start], order[start + 1]
    for a, b in ((one, two), (two, one)):
        other.ravel()[a], back.ravel()[a] = np.divmod(b, 3)
    return other, back


class Lattice:
    """A control mesh subdivided evenly, whose fine triangles are found by their place without a search: `subdivision`,
    and `fine`, its vertices on the control mesh.
    """

    def __init__(self, mesh: Mesh, chart: Chart, level: int) -> None:
        self.subdivision = subdivide(mesh, chart, level)
        self.fine = self.subdivision.mesh(mesh)
        self.mesh, self._chart, self._steps = mesh, chart, 2**level
        corners = np.repeat(chart.uv[chart.faces[self.subdivision.face_parent]], 3, axis=0).swapaxes(0, 1)
        fine_uv = self.subdivision.chart.uv[self.subdivision.chart.faces].reshape(-1, 2)
        _, i, j = np.rint(barycentric(fine_uv, *corners) * self._steps).astype(int).reshape(-1, 3, 3).transpose(2, 0, 1)
        parent = self.subdivision.face_parent[:, None]
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
