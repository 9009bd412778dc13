"""The scan's surface on a control mesh, wherever that has moved, and how far it lies from the scan [Statues]."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array, diags_array, hstack

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.pictures.textures import bilinear

from ..control.model import FOLDED, HOLE, MEASURED, OUTSIDE, ControlModel, DisplacementMap, Statue
from .normal_volume import from_normal_volume, interpolate, to_normal_volume
from .subdivision import Displaced, Subdivision, chart_places, subdivide_uniform


class Reconstruction:
    """Vertices of the detailed surface for any vertices of the control mesh; what does not change is computed once.

    Heights follow the interpolated normal of the moved mesh. [Statues] Eq. 19, 20
    """

    def __init__(self, control: ControlModel, map: DisplacementMap, subdivision: Subdivision) -> None:
        self.faces, self.control = subdivision.faces, control
        mesh, count = control.mesh, len(subdivision.parent)
        heights = bilinear(map.heights, chart_places(control.chart, subdivision.parent, subdivision.bary))
        corners = mesh.faces[subdivision.parent]
        share = csr_array((subdivision.bary.ravel(), (np.repeat(np.arange(count), 3), corners.ravel())),
                          shape=(count, len(mesh.vertices)))
        share.eliminate_zeros()
        self._spread = csr_array(hstack([share, diags_array(heights) @ share]))

    def __call__(self, control_vertices: np.ndarray) -> np.ndarray:
        """Compute the detailed surface (n, 3), metres, on control vertices (N, 3)."""
        moved = self.control.mesh.with_vertices(control_vertices)
        return np.asarray(self._spread @ np.concatenate([moved.vertices, moved.vertex_normals]))

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
        heights = bilinear(map.heights, chart_places(control.chart, faces, bary))
        return from_normal_volume(control.mesh, faces, bary, heights)
    return displaced


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


def measure_levels(statue: Statue, scan: Mesh) -> tuple[list[Level], Subdivision]:
    """Reconstruct at levels 0 to 3 and measure the distance to the scan; also return the finest subdivision.

    [Statues] Eq. 22, 23
    """
    levels = []
    for number in range(4):
        fine = subdivide_uniform(statue.control.mesh, statue.control.chart, number)
        mesh = Reconstruction(statue.control, statue.map, fine).mesh()
        shown = (coverage_at(statue.control, statue.map, fine.parent, fine.bary)[fine.faces] != HOLE).all(axis=1)
        distances = reconstruction_error(mesh.submesh(shown)[0], scan) if shown.any() else np.array([np.nan])
        levels.append(Level(f"level {number}", mesh, float(distances.mean()), float(np.sqrt(np.mean(distances**2))),
                            shown))
    return levels, fine


def reconstruction_error(reconstructed: Mesh, scan: Mesh) -> np.ndarray:
    """Measure the distances (n,), metres, from a reconstructed surface to the scan, one way, at 200,000 even points.

    [Statues] Eq. 22, 23
    """
    points = reconstructed.sample(200_000, np.random.default_rng(14))[0]
    return Surface(scan).closest(points).distances


def remaining_error(control: ControlModel, map: DisplacementMap, scan: Mesh) -> np.ndarray:
    """Measure distances (n,), metres, of scan points to their reconstruction where the map is one-to-one.

    Their mean is e in the paper's tables. They are of 20,000 even points, up to 3 cm off the control mesh.
    """
    points = scan.sample(20_000, np.random.default_rng(14))[0]
    found = to_normal_volume(control.mesh, points, 0.03)
    faces = np.maximum(found.faces, 0)
    uv = chart_places(control.chart, faces, found.bary)
    good = found.inside & (found.solutions == 1) & (coverage_at(control, map, faces, found.bary) == MEASURED)
    stored = from_normal_volume(control.mesh, faces[good], found.bary[good], bilinear(map.heights, uv[good]))
    return np.linalg.norm(stored - points[good], axis=1)


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
    """Find fine triangles with a corner or centre on, or beside, a pixel in a fold or hole: (f,) bool."""
    from scipy.ndimage import maximum_filter

    bad = maximum_filter((map.coverage == FOLDED) | (map.coverage == HOLE), 3)
    corners = subdivision.chart.uv[subdivision.chart.faces]
    uv = np.concatenate([corners, corners.mean(axis=1, keepdims=True)], axis=1).reshape(-1, 2)
    return bad[pixels_at(map, uv)].reshape(-1, 4).any(axis=1)
