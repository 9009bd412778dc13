"""Images over a texture chart: pixels inside it and a little beyond its border, colours of a scan, normal maps."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanprep.geometry import sparse
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.pictures.textures import Look, Texture, bilinear, pad_charts

from ..control.chart import Chart, planar_barycentric
from ..control.model import ControlModel, DisplacementMap
from .normal_volume import interpolate
from .subdivision import Subdivision, chart_places, subdivide_uniform


@dataclass(frozen=True, eq=False)
class Texels:
    """Pixels of a square image over a chart."""

    size: int
    pixels: np.ndarray  # (n,), row times size plus column; row 0 is the upper one. Ascending
    faces: np.ndarray   # (n,), the control triangle of each
    bary: np.ndarray    # (n, 3)
    inside: np.ndarray  # (n,), in the chart; the others stand for the surface on the other side of the seam

    def image(self, values: np.ndarray, beyond: float | None = None) -> np.ndarray:
        """Make an image (size, size, ...) of values (n, ...) of the pixels.

        Elsewhere it is `beyond`. Without that, the nearest pixel fills 16 pixels around, which smaller copies of the
        image (mipmaps) read, and the rest is 0.
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
        """List pairs (m, 2) of pixels, as numbers in these arrays, that are neighbours in the image."""
        number = np.full((self.size, self.size), -1)
        number.ravel()[self.pixels] = np.arange(len(self.pixels))
        pairs = np.concatenate([np.stack([number[:, :-1].ravel(), number[:, 1:].ravel()], axis=1),
                                np.stack([number[:-1].ravel(), number[1:].ravel()], axis=1)])
        return pairs[(pairs >= 0).all(axis=1)]


def find_texels(mesh: Mesh, chart: Chart, size: int) -> Texels:
    """Find the pixels of a square image over the chart of a mesh, and those up to four pixels beyond its border."""
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
    """Compute the distance (size, size) of every pixel from given ones, and the nearest of these (2, size, size)."""
    from scipy.ndimage import distance_transform_edt

    empty = np.ones(size**2, dtype=bool)
    empty[pixels] = False
    return distance_transform_edt(empty.reshape(size, size), return_indices=True)


def continue_chart(mesh: Mesh, chart: Chart, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Continue the chart: places on the control mesh, triangles (n,) and bary (n, 3), of image points (n, 2) beside it.

    The triangle on the other side of the nearest seam is unfolded into the plane, and the point is a place on it. At a
    border of the mesh itself, the nearest border point is taken.
    """
    import igl

    flat = chart.flat
    found = Surface(flat).closest(np.column_stack([uv, np.zeros(len(uv))]))
    face, side = found.faces, (np.argmin(found.bary, axis=1) + 1) % 3
    other, back = igl.triangle_triangle_adjacency(mesh.faces)          # the triangle beyond each side, and its side
    beyond = np.where(flat.edge_use[flat.face_edges[face, side]] == 1, other[face, side], -1)
    bary = np.clip(found.bary, 0, None)
    seam = np.flatnonzero(beyond >= 0)
    f, s, g, t = face[seam], side[seam], beyond[seam], back[face[seam], side[seam]]
    # the point in the plane of the triangle: along the seam, and distance from it; then on the unfolded triangle
    at = np.einsum("nc,ncd->nd", planar_barycentric(uv[seam], *chart.uv[chart.faces[f]].swapaxes(0, 1)),
                   mesh.corners[f])
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


class Lattice:
    """A control mesh subdivided evenly: `subdivision`, and `fine`, its vertices on the control mesh.

    Holes are filled on three levels: edges of some 5 mm.
    """

    def __init__(self, control: ControlModel) -> None:
        self.control, self.subdivision = control, subdivide_uniform(control.mesh, control.chart, 3)
        self.fine = self.subdivision.mesh(control.mesh)
        self._surface = Surface(self.fine)

    def sample(self, values: np.ndarray, faces: np.ndarray, bary: np.ndarray) -> np.ndarray:
        """Interpolate values of the fine vertices at places of the control mesh: (n,) or (n, k)."""
        found = self._surface.closest(interpolate(self.control.mesh, faces, bary)[0])
        return np.einsum("nc,nc...->n...", found.bary, values[self.fine.faces[found.faces]])

    def gather(self, texels: Texels, values: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Sample pixel values (n,) at the fine vertices, from one side of a seam; also whether all around are known."""
        uv = chart_places(self.control.chart, self.subdivision.parent, self.subdivision.bary)
        image, sure = texels.image(np.where(known, values, 0.0), 0.0), texels.image(known.astype(float), 0.0)
        return bilinear(image, uv), bilinear(sure, uv) > 1 - 1e-9


def scan_look(scan: Mesh | Texture) -> Look:
    """Make a function of the colours of a scan, of vertices or texture, at the closest point; weight 0 without data."""
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
        # colours count within 1 cm, on surfaces that face the same way
        return colors, ((found.distances < 0.01) & (facing > 0)).astype(float)
    return look


def bake_texture(control: ControlModel, map: DisplacementMap, look: Look) -> np.ndarray:
    """Bake colours (H, W, 3) uint8 of the displaced surface over the chart of a control model.

    `look` maps places and normals to colours and weights. Where weights are 0, colours are filled smoothly from around,
    across seams too.
    """
    texels = find_texels(control.mesh, control.chart, len(map.heights))
    p, n = interpolate(control.mesh, texels.faces, texels.bary)
    places = p + map.heights.ravel()[texels.pixels, None] * n
    colors, weight = look(places, n / np.maximum(np.linalg.norm(n, axis=1), 1e-12)[:, None])
    known = weight > 0
    if not known.all():
        lattice = Lattice(control)
        found = [lattice.gather(texels, colors[:, k], known) for k in range(3)]
        values, sure = np.stack([value for value, _ in found], axis=1), found[0][1]
        # light grey where nothing at all is known
        values = sparse.harmonic(lattice.fine.vertex_adjacency, np.where(sure[:, None], values, 0.6), sure)
        colors[~known] = lattice.sample(values, texels.faces[~known], texels.bary[~known])
    return texels.image((255 * np.clip(colors, 0, 1) + 0.5).astype(np.uint8))


def vertex_of_row(mesh: Mesh, chart: Chart) -> np.ndarray:
    """Find the vertex (M,) of every row of a chart's `uv`."""
    out = np.zeros(len(chart.uv), dtype=np.int64)
    out[chart.faces] = mesh.faces
    return out


def chart_tangents(mesh: Mesh, chart: Chart) -> np.ndarray:
    """Compute tangents (M, 4) at every row of a chart as MikkTSpace does, the standard of glTF and Blender.

    A tangent is the direction in which u grows in each triangle, made perpendicular to the vertex normal and weighted
    by the triangle's angle there. The sign makes `cross(normal, tangent) * sign` the direction in which v grows.
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
    """Make the normal map (size, size, 3) uint8 of the detailed surface with vertices (n, 3).

    Normals are in the tangent frames of the control mesh: x to the right in the image, y upwards, z outwards. Values
    from -1 to 1 become 0 to 255, as in glTF.
    """
    # tangent frames T, B, N of the control mesh at every pixel, then the fine normal there
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
    return pad_charts(out, covered)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300)
