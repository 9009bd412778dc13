"""The scan's surface on a control mesh, wherever that has moved, and how far it lies from the scan [Statues]."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array, diags_array, hstack

from scanprep.geometry import rotations, sparse
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.pictures.textures import bilinear

from ..control.model import FOLDED, HOLE, MEASURED, OUTSIDE, ControlModel, DisplacementMap, Statue
from .normal_volume import from_normal_volume, interpolate, to_normal_volume
from .subdivision import Displaced, Subdivision, chart_places, subdivide_adaptive, subdivide_uniform


class Reconstruction:
    """Vertices of the detailed surface for any vertices of the control mesh; what does not change is computed once.

    Heights follow the interpolated normal of the moved mesh. The rest of a vector displacement turns with the edges
    around each control vertex, and with its normal, so that a ring of edges in a plane has one answer.
    [Statues] Eq. 19, 20
    """

    def __init__(self, control: ControlModel, map: DisplacementMap, subdivision: Subdivision) -> None:
        self.faces, self.control = subdivision.faces, control
        mesh, count = control.mesh, len(subdivision.parent)
        heights, rest = _parts(control, map, subdivision.parent, subdivision.bary)
        corners = mesh.faces[subdivision.parent]
        share = csr_array((subdivision.bary.ravel(), (np.repeat(np.arange(count), 3), corners.ravel())),
                          shape=(count, len(mesh.vertices)))
        share.eliminate_zeros()
        self._spread = csr_array(hstack([share, diags_array(heights) @ share]))
        # control vertices that carry a vector displacement, and the edges around them at rest
        self._rotated = np.flatnonzero(rest.any(axis=1))
        self._rest, self._carriers = rest[self._rotated], np.unique(corners[self._rotated])
        self._share = csr_array(share[self._rotated][:, self._carriers])
        number = np.full(len(mesh.vertices), -1)
        number[self._carriers] = np.arange(len(self._carriers))
        ends = np.concatenate([mesh.edges, mesh.edges[:, ::-1]])
        self._a, self._b = ends[number[ends[:, 0]] >= 0].T
        self._edges = mesh.vertices[self._a] - mesh.vertices[self._b]
        self._normals = mesh.vertex_normals[self._carriers] * mesh.mean_edge**2
        self._sum = sparse.gatherer(number[self._a], len(self._carriers))

    def __call__(self, control_vertices: np.ndarray) -> np.ndarray:
        """Compute the detailed surface (n, 3), metres, on control vertices (N, 3)."""
        moved = self.control.mesh.with_vertices(control_vertices)
        v, n = moved.vertices, moved.vertex_normals
        out = self._spread @ np.concatenate([v, n])
        # vector displacements rotate with the edges around their control vertices
        if len(self._rotated):
            S = sparse.sum_groups(self._sum, (v[self._a] - v[self._b])[:, :, None] * self._edges[:, None])
            S = S + n[self._carriers][:, :, None] * self._normals[:, None]
            R = rotations.project(S).reshape(-1, 9)
            out[self._rotated] += np.einsum("nij,nj->ni", (self._share @ R).reshape(-1, 3, 3), self._rest)
        return out

    def mesh(self, control_vertices: np.ndarray | None = None) -> Mesh:
        """Build the mesh of the detailed surface; by default where the scan stood."""
        return Mesh(self(self.control.mesh.vertices if control_vertices is None else control_vertices), self.faces)


def coverage_at(control: ControlModel, map: DisplacementMap, faces: np.ndarray, bary: np.ndarray) -> np.ndarray:
    """Look up the coverage (n,) at places on triangles: MEASURED, FOLDED or HOLE; at a rim that of the pixel beside."""
    inwards = 0.9 * bary + 0.1 / 3                              # a pixel at a seam may lie outside the chart
    found = map.coverage[pixels_at(map, chart_places(control.chart, faces, inwards))]
    return np.where(found == OUTSIDE, MEASURED, found)


def displace_surface(control: ControlModel, map: DisplacementMap) -> Displaced:
    """Make the function of the detailed surface above any places of the control mesh, for `subdivide_adaptive`."""
    def displaced(faces: np.ndarray, bary: np.ndarray) -> np.ndarray:
        p, n = interpolate(control.mesh, faces, bary)
        heights, rest = _parts(control, map, faces, bary)
        return p + heights[:, None] * n + rest
    return displaced


def _parts(control: ControlModel, map: DisplacementMap, faces: np.ndarray, bary: np.ndarray
           ) -> tuple[np.ndarray, np.ndarray]:
    """Split the map into heights (n,) along the interpolated normal and, with vectors, the rest (n, 3)."""
    uv = chart_places(control.chart, faces, bary)
    heights = bilinear(map.heights, uv)
    rest = np.zeros((len(uv), 3)) if map.vectors is None else bilinear(map.vectors, uv)
    chosen = np.flatnonzero(rest.any(axis=1))
    _, n = interpolate(control.mesh, faces[chosen], bary[chosen])
    along = np.einsum("nd,nd->n", rest[chosen], n) / np.maximum(np.einsum("nd,nd->n", n, n), 1e-12)
    heights[chosen] += along
    rest[chosen] -= along[:, None] * n
    return heights, rest


def pixels_at(map: DisplacementMap, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find rows and columns (n,) of the pixels at texture coordinates (n, 2)."""
    height, width = map.coverage.shape
    return (np.clip(((1 - uv[:, 1]) * height).astype(int), 0, height - 1),
            np.clip((uv[:, 0] * width).astype(int), 0, width - 1))


@dataclass(frozen=True, eq=False)
class Level:
    """A reconstruction and how far it lies from the scan, where that has no hole."""

    name: str
    mesh: Mesh
    mean: float        # metres, [Statues] Eq. 22
    rms: float         # metres, [Statues] Eq. 23
    shown: np.ndarray  # (f,), triangles that are not in a hole of the scan


def measure_levels(statue: Statue, scan: Mesh, count: int = 4) -> tuple[list[Level], Subdivision]:
    """Reconstruct at every level and measure the distance to the scan; also return the finest subdivision.

    [Statues] Eq. 22, 23
    """
    levels = []
    for number in range(count):
        fine = subdivide_uniform(statue.control.mesh, statue.control.chart, number)
        levels.append(_level(f"level {number}", statue, fine, scan))
    return levels, fine


def adaptive_level(statue: Statue, scan: Mesh, tolerance: float = 0.0005, level: int = 4) -> Level:
    """Reconstruct on triangles that are small only where the displaced surface needs it, by a tolerance in metres."""
    control = statue.control
    fine = subdivide_adaptive(control.mesh, control.chart, displace_surface(control, statue.map), tolerance, level)
    return _level(f"adaptive, {1000 * tolerance:g} mm", statue, fine, scan)


def _level(name: str, statue: Statue, fine: Subdivision, scan: Mesh) -> Level:
    mesh = Reconstruction(statue.control, statue.map, fine).mesh()
    shown = (coverage_at(statue.control, statue.map, fine.parent, fine.bary)[fine.faces] != HOLE).all(axis=1)
    error = reconstruction_error(mesh.submesh(shown)[0], scan) if shown.any() else SurfaceError.of(np.zeros(0))
    return Level(name, mesh, error.mean, error.rms, shown)


@dataclass(frozen=True)
class SurfaceError:
    """Distances from one surface to another, over the area of the first, metres."""

    mean: float
    rms: float

    @staticmethod
    def of(distances: np.ndarray) -> SurfaceError:
        """Summarise distances (n,); NaN where there are none."""
        if not len(distances):
            return SurfaceError(np.nan, np.nan)
        return SurfaceError(float(distances.mean()), float(np.sqrt(np.mean(distances**2))))


def reconstruction_error(reconstructed: Mesh, scan: Mesh, count: int = 200_000) -> SurfaceError:
    """Measure the distance from a reconstructed surface to the scan, one way, at `count` even points.

    [Statues] Eq. 22, 23
    """
    points = reconstructed.sample(count, np.random.default_rng(14))[0]
    return SurfaceError.of(Surface(scan).closest(points).distances)


def remaining_error(control: ControlModel, map: DisplacementMap, scan: Mesh, count: int = 20_000,
                    reach: float = 0.03) -> SurfaceError:
    """Measure the distance of scan points to their reconstruction where the map is one-to-one: e in the paper's tables.

    NaN where no place of the scan is mapped one-to-one.
    """
    points = scan.sample(count, np.random.default_rng(14))[0]
    found = to_normal_volume(control.mesh, points, reach)
    faces = np.maximum(found.faces, 0)
    uv = chart_places(control.chart, faces, found.bary)
    good = found.inside & (found.solutions == 1) & (coverage_at(control, map, faces, found.bary) == MEASURED)
    stored = from_normal_volume(control.mesh, faces[good], found.bary[good], bilinear(map.heights, uv[good]))
    return SurfaceError.of(np.linalg.norm(stored - points[good], axis=1))


def find_inverted(control: ControlModel, vertices: np.ndarray, subdivision: Subdivision, detailed: np.ndarray
                  ) -> np.ndarray:
    """Find inverted fine triangles, with vertices `detailed` (n, 3): their normal opposes the control surface's.

    The control surface has vertices (N, 3), and its normal is interpolated. So a steep flank at an edge of the control
    mesh does not count as inverted.
    """
    _, n = interpolate(control.mesh.with_vertices(vertices), subdivision.parent, subdivision.bary)
    below = n[subdivision.faces].sum(axis=1)
    return np.flatnonzero(np.einsum("fd,fd->f", Mesh(detailed, subdivision.faces).face_normals, below) < 0)


def in_folds(control: ControlModel, map: DisplacementMap, subdivision: Subdivision) -> np.ndarray:
    """Find fine triangles with a corner or centre on, or beside, a pixel in a fold or hole: (f,) bool.

    With vectors, also where these are not zero around folds.
    """
    from scipy.ndimage import maximum_filter

    bad = (map.coverage == FOLDED) | (map.coverage == HOLE)
    if map.vectors is not None:
        bad |= map.vectors.any(axis=2) & (map.coverage != OUTSIDE)
    bad = maximum_filter(bad, 3)
    corners = subdivision.chart.uv[subdivision.chart.faces]
    uv = np.concatenate([corners, corners.mean(axis=1, keepdims=True)], axis=1).reshape(-1, 2)
    return bad[pixels_at(map, uv)].reshape(-1, 4).any(axis=1)
