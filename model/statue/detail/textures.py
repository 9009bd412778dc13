"""Other images over a chart: the colours of a scan, and normals for programs that shade the control mesh."""
from __future__ import annotations

import numpy as np

from scanprep.geometry import sparse
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.pictures.textures import Look, Texture, padded

from ..control.chart import Chart
from ..control.model import ControlModel, DisplacementMap
from .displacement import FILL_LEVEL
from .normal_volume import interpolate
from .subdivision import Subdivision
from .texels import Lattice, find_texels


def scan_look(scan: Mesh | Texture) -> Look:
    """The colours of a scan, of its vertices or its picture, at the closest place; weight 0 where it has none."""
    mesh = scan.mesh if isinstance(scan, Texture) else scan
    if not isinstance(scan, Texture) and mesh.colors is None:
        raise ValueError("scan: expected colours of its vertices or a texture, found neither")
    surface = Surface(mesh)

    def look(places: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        found = surface.closest(places)
        if isinstance(scan, Texture):
            colors = scan.sample(found.faces, found.bary)
        else:
            assert mesh.colors is not None, "a scan without colours was refused"
            colors = np.einsum("nc,ncd->nd", found.bary, mesh.colors[mesh.faces[found.faces]])
        facing = np.einsum("nd,nd->n", mesh.face_normals[found.faces], normals)
        # metres: farther away the scan does not say
        return colors, ((found.distances < 0.01) & (facing > 0)).astype(float)
    return look


def bake_texture(control: ControlModel, map: DisplacementMap, look: Look) -> np.ndarray:
    """(H, W, 3) uint8 colours over the chart of a control model, those of the displaced surface. Where `look` (places,
    normals -> colours, weights) says nothing, they go over smoothly from those around, across seams too.
    """
    texels = find_texels(control.mesh, control.chart, len(map.heights))
    p, n = interpolate(control.mesh, texels.faces, texels.bary)
    places = p + map.heights.ravel()[texels.pixels, None] * n
    if map.vectors is not None:
        places += map.vectors.reshape(-1, 3)[texels.pixels]
    colors, weight = look(places, n / np.maximum(np.linalg.norm(n, axis=1), 1e-12)[:, None])
    known = weight > 0
    if not known.all():
        lattice = Lattice(control.mesh, control.chart, FILL_LEVEL)
        found = [lattice.gather(texels, colors[:, k], known) for k in range(3)]
        values, sure = np.stack([value for value, _ in found], axis=1), found[0][1]
        # where nothing at all is known
        values = sparse.harmonic(lattice.fine.vertex_adjacency, np.where(sure[:, None], values, 0.6), sure)
        colors = np.where(known[:, None], colors, lattice.sample(values, texels.faces, texels.bary))
    return texels.image((255 * np.clip(colors, 0, 1) + 0.5).astype(np.uint8))


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


def normal_image(control: ControlModel, vertices: np.ndarray, subdivision: Subdivision, size: int) -> np.ndarray:
    """(size, size, 3) uint8, the normals of the detailed surface, vertices (n, 3), in the frames of the control mesh: x
    to the right in the image, y upwards, z outwards; -1 to 1 are 0 to 255, as glTF has them.
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
