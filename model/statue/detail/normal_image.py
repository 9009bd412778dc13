"""Tangents of a chart, and the image of a detailed surface's normals for programs that shade the control mesh."""
from __future__ import annotations

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.pictures.textures import padded

from ..control.chart import Chart
from ..control.model import ControlModel
from .subdivision import Subdivision

SIZE = 2048                          # pixels of a side


def vertex_of_row(mesh: Mesh, chart: Chart) -> np.ndarray:
    """(M,) the vertex of every row of a chart's `uv`."""
    out = np.zeros(len(chart.uv), dtype=np.int64)
    out[chart.faces] = mesh.faces
    return out


def chart_tangents(mesh: Mesh, chart: Chart) -> np.ndarray:
    """(M, 4) tangents at every row of a chart, as MikkTSpace makes them, which glTF and Blender go by.

    Of each triangle the direction in which u grows, made perpendicular to the vertex normal, weighted by the
    triangle's angle there; then the sign of `cross(normal, tangent) * sign`, the direction in which v grows.
    """
    x, n = mesh.corners, mesh.vertex_normals[mesh.faces]                 # (F, 3, 3)
    uv = chart.uv[chart.faces]
    (a, b), (p, q) = ((w[:, 1] - w[:, 0], w[:, 2] - w[:, 0]) for w in (uv, x))
    area = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    along = (b[:, 1, None] * p - a[:, 1, None] * q) * np.sign(area)[:, None]
    level = _unit(along[:, None] - np.einsum("fkd,fd->fk", n, along)[..., None] * n)
    sides = [np.roll(x, -step, axis=1) - x for step in (1, 2)]
    sides = [_unit(side - np.einsum("fkd,fkd->fk", n, side)[..., None] * n) for side in sides]
    angle = np.arccos(np.clip(np.einsum("fkd,fkd->fk", *sides), -1, 1))
    tangents, sign = np.zeros((len(chart.uv), 3)), np.zeros(len(chart.uv))
    np.add.at(tangents, chart.faces, angle[..., None] * level)
    np.add.at(sign, chart.faces, angle * np.sign(area)[:, None])
    tangents = _unit(tangents)
    tangents[~tangents.any(axis=1)] = (1, 0, 0)
    return np.column_stack([tangents, np.where(sign < 0, -1, 1)])


def normal_image(control: ControlModel, vertices: np.ndarray, subdivision: Subdivision, size: int = SIZE) -> np.ndarray:
    """The normals of the detailed surface in the frames of the control mesh.

    Parameters
    ----------
    control : ControlModel
        Fitted.
    vertices : (n, 3) float, metres
        The detailed surface in the control mesh's default pose.
    subdivision : Subdivision
        Its triangles.
    size : int, pixels of a side

    Returns
    -------
    (size, size, 3) uint8
        x to the right in the image, y upwards, z outwards; -1 to 1 are 0 to 255, as glTF has them.
    """
    rows, columns, face, bary = control.chart.texels(size)
    N = np.einsum("nc,ncd->nd", bary, control.mesh.vertex_normals[control.mesh.faces[face]])
    T = np.einsum("nc,ncd->nd", bary, chart_tangents(control.mesh, control.chart)[control.chart.faces[face]])
    T, side = T[:, :3], np.sign(T[:, 3:])
    B = np.cross(N, T) * side
    detail, at = Mesh(vertices, subdivision.faces), np.full((size, size), -1)
    there = subdivision.chart.texels(size)
    at[there[0], there[1]] = np.arange(len(there[0]))
    known = at[rows, columns] >= 0
    fine_face, fine_bary = there[2][at[rows, columns][known]], there[3][at[rows, columns][known]]
    fine = np.einsum("nc,ncd->nd", fine_bary, detail.vertex_normals[detail.faces[fine_face]])
    rows, columns = rows[known], columns[known]
    T, B, N, side = T[known], B[known], N[known], side[known]
    # T, B and N are not quite perpendicular: fine = x T + y B + z N is solved, up to its length
    local = side * _unit(np.stack([np.einsum("nd,nd->n", fine, np.cross(*pair)) for pair in ((B, N), (N, T), (T, B))],
                                  axis=1))
    out, covered = np.full((size, size, 3), (128, 128, 255), dtype=np.uint8), np.zeros((size, size), dtype=bool)
    out[rows, columns] = np.round(127.5 * (local + 1))
    covered[rows, columns] = True
    return padded(out, covered)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300)
