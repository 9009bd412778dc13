"""The pixels of a chart: places of the control mesh, inside it and a little beyond its borders."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface

from ..control.chart import Chart

PADDING = 4                          # pixels that the surface is continued beyond the border of a chart
MARGIN = 16                          # pixels more that the last value is repeated


@dataclass(frozen=True, eq=False)
class Texels:
    """Pixels of a square image over a chart.

    Attributes
    ----------
    size : int
    pixels : (n,) int
        Row times size plus column; row 0 is the upper one. Ascending.
    faces : (n,) int
        The control triangle of each.
    bary : (n, 3) float
    inside : (n,) bool
        In the chart. The others lie beside it, and stand for the surface on the other side of the seam.
    """

    size: int
    pixels: np.ndarray
    faces: np.ndarray
    bary: np.ndarray
    inside: np.ndarray

    def image(self, values: np.ndarray, beyond: float | None = None) -> np.ndarray:
        """An image (size, size, ...) of values (n, ...) of the pixels.

        Elsewhere a number; or that of the nearest pixel as far as smaller copies of the image look, and 0 beyond.
        """
        out = np.full((self.size**2, *values.shape[1:]), 0 if beyond is None else beyond, dtype=values.dtype)
        out[self.pixels] = values
        out = out.reshape(self.size, self.size, *values.shape[1:])
        if beyond is None:
            from scipy.ndimage import distance_transform_edt

            empty = np.ones(self.size**2, dtype=bool)
            empty[self.pixels] = False
            far, (row, column) = distance_transform_edt(empty.reshape(self.size, self.size), return_indices=True)
            around = (far > 0) & (far <= MARGIN)
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
    """The pixels of a square image of `size` pixels each way over the chart of a mesh."""
    rows, columns, faces, bary = chart.texels(size)
    pixels = rows * size + columns
    beside = _beside(pixels, size)
    x, y = (beside % size + 0.5) / size, 1 - (beside // size + 0.5) / size
    face, place = continue_chart(mesh, chart, np.stack([x, y], axis=1))
    order = np.argsort(np.concatenate([pixels, beside]))
    inside = np.repeat([True, False], [len(pixels), len(beside)])
    return Texels(size, np.concatenate([pixels, beside])[order], np.concatenate([faces, face])[order],
                  np.concatenate([bary, place])[order], inside[order])


def _beside(pixels: np.ndarray, size: int) -> np.ndarray:
    """Pixels outside a set, at most PADDING from it."""
    from scipy.ndimage import distance_transform_edt

    empty = np.ones(size**2, dtype=bool)
    empty[pixels] = False
    far = distance_transform_edt(empty.reshape(size, size))
    return np.flatnonzero((far > 0) & (far <= PADDING))


def continue_chart(mesh: Mesh, chart: Chart, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places of the control mesh for points of the image (n, 2) beside the chart.

    The triangle at the nearest border goes on in its plane; what lies beyond the seam is laid onto the triangle on its
    other side, as if that were unfolded into the plane. At a border of the mesh itself the border's place is taken.

    Returns
    -------
    (n,) int
        Triangles.
    (n, 3) float
        Barycentric coordinates, not negative.
    """
    flat = chart.flat
    found = Surface(flat).closest(np.column_stack([uv, np.zeros(len(uv))]))
    face, side = found.faces, (np.argmin(found.bary, axis=1) + 1) % 3
    other, turned = _across(mesh)
    beyond = np.where(flat.edge_use[flat.face_edges[face, side]] == 1, other[face, side], -1)
    bary = np.clip(found.bary, 0, None)
    seam = np.flatnonzero(beyond >= 0)
    f, s, g, t = face[seam], side[seam], beyond[seam], turned[face[seam], side[seam]]
    at = np.einsum("nc,ncd->nd", _extended(uv[seam], chart.uv[chart.faces[f]]), mesh.corners[f])
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


def _extended(uv: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Barycentric coordinates (n, 3) of points (n, 2), negative outside triangles (n, 3, 2)."""
    e, h, w = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], uv - corners[:, 0]
    area = e[:, 0] * h[:, 1] - e[:, 1] * h[:, 0]
    one = (w[:, 0] * h[:, 1] - w[:, 1] * h[:, 0]) / area
    two = (e[:, 0] * w[:, 1] - e[:, 1] * w[:, 0]) / area
    return np.stack([1 - one - two, one, two], axis=1)


def _across(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """The triangle beyond each side (F, 3) and which of its sides that is; -1 at a border."""
    other, turned = np.full(mesh.faces.shape, -1), np.full(mesh.faces.shape, -1)
    order = np.argsort(mesh.face_edges.ravel(), kind="stable")
    start = np.concatenate([[0], np.cumsum(mesh.edge_use)[:-1]])[mesh.edge_use == 2]
    one, two = order[start], order[start + 1]
    for a, b in ((one, two), (two, one)):
        other.ravel()[a], turned.ravel()[a] = np.divmod(b, 3)
    return other, turned
