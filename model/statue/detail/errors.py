"""How far a reconstruction lies from the scan, at every level of detail, and where it is inverted [Statues]."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.pictures.textures import bilinear

from ..control.model import FOLDED, HOLE, MEASURED, OUTSIDE, ControlModel, DisplacementMap, Statue
from .normal_volume import from_normal_volume, interpolate, to_normal_volume
from .reconstruction import Reconstruction, coverage_at, displaced_surface, pixels_at
from .subdivision import Subdivision, chart_places, subdivide, subdivide_adaptive


@dataclass(frozen=True, eq=False)
class Level:
    """A reconstruction and how far it lies from the scan, where that has no hole."""

    name: str
    mesh: Mesh
    mean: float        # metres, [Statues] Eq. 22
    rms: float         # metres, [Statues] Eq. 23
    shown: np.ndarray  # (f,), triangles that are not in a hole of the scan


def measured_levels(statue: Statue, scan: Mesh, count: int = 4) -> tuple[list[Level], Subdivision]:
    """The reconstruction at every level with its distance to the scan, and the finest subdivision.

    [Statues] Eq. 22, 23
    """
    levels = []
    for number in range(count):
        fine = subdivide(statue.control.mesh, statue.control.chart, number)
        levels.append(_level(f"level {number}", statue, fine, scan))
    return levels, fine


def adaptive_level(statue: Statue, scan: Mesh, tolerance: float = 0.0005, level: int = 4) -> Level:
    """The reconstruction on triangles that are small only where the displacement asks for it by a tolerance, metres."""
    control = statue.control
    fine = subdivide_adaptive(control.mesh, control.chart, displaced_surface(control, statue.map), tolerance, level)
    return _level(f"adaptive, {1000 * tolerance:g} mm", statue, fine, scan)


def _level(name: str, statue: Statue, fine: Subdivision, scan: Mesh) -> Level:
    mesh = Reconstruction(statue.control, statue.map, fine).mesh()
    shown = (coverage_at(statue.control, statue.map, fine.parent, fine.bary)[fine.faces] != HOLE).all(axis=1)
    error = surface_error(mesh.submesh(shown)[0], scan) if shown.any() else SurfaceError(np.nan, np.nan)
    return Level(name, mesh, error.mean, error.rms, shown)


@dataclass(frozen=True)
class SurfaceError:
    """Distances from one surface to another, over the area of the first, metres."""

    mean: float
    rms: float


def surface_error(reconstructed: Mesh, scan: Mesh, count: int = 200_000) -> SurfaceError:
    """Distance from a reconstructed surface to the scan, one way, at so many places spread evenly. [Statues] Eq. 22, 23
    """
    points = reconstructed.sample(count, np.random.default_rng(14))[0]
    return _error(Surface(scan).closest(points).distances)


def remaining_error(control: ControlModel, map: DisplacementMap, scan: Mesh, count: int = 20_000,
                    reach: float = 0.03) -> SurfaceError:
    """Distance of places on the scan to what the map makes of them, where it is one-to-one: e of the paper's tables.

    NaN where no place of the scan is mapped one-to-one.
    """
    points = scan.sample(count, np.random.default_rng(14))[0]
    found = to_normal_volume(control.mesh, points, reach)
    faces = np.maximum(found.faces, 0)
    uv = chart_places(control.chart, faces, found.bary)
    good = found.inside & (found.solutions == 1) & (coverage_at(control, map, faces, found.bary) == MEASURED)
    if not good.any():
        return SurfaceError(np.nan, np.nan)
    stored = from_normal_volume(control.mesh, faces[good], found.bary[good], bilinear(map.heights, uv[good]))
    return _error(np.linalg.norm(stored - points[good], axis=1))


def inverted_triangles(control: ControlModel, vertices: np.ndarray, subdivision: Subdivision, detailed: np.ndarray
                       ) -> np.ndarray:
    """Fine triangles, ascending, whose normal opposes that of the control surface below them, which has vertices (N,
    3); `detailed` (n, 3) are those of the fine ones.

    That is its interpolated normal: on it the heights stand, and a steep flank is not inverted because the control mesh
    has an edge there.
    """
    _, n = interpolate(control.mesh.with_vertices(vertices), subdivision.parent, subdivision.bary)
    below = n[subdivision.faces].sum(axis=1)
    return np.flatnonzero(np.einsum("fd,fd->f", Mesh(detailed, subdivision.faces).face_normals, below) < 0)


def in_folds(control: ControlModel, map: DisplacementMap, subdivision: Subdivision) -> np.ndarray:
    """(f,) bool: fine triangles with a corner or their middle on, or beside, a pixel in a fold or hole.

    With vectors also where these take part, some way around folds.
    """
    from scipy.ndimage import maximum_filter

    bad = (map.coverage == FOLDED) | (map.coverage == HOLE)
    if map.vectors is not None:
        bad |= map.vectors.any(axis=2) & (map.coverage != OUTSIDE)
    bad = maximum_filter(bad, 3)
    corners = subdivision.chart.uv[subdivision.chart.faces]
    uv = np.concatenate([corners, corners.mean(axis=1, keepdims=True)], axis=1).reshape(-1, 2)
    return bad[pixels_at(map, uv)].reshape(-1, 4).any(axis=1)


def _error(distances: np.ndarray) -> SurfaceError:
    return SurfaceError(float(distances.mean()), float(np.sqrt(np.mean(distances**2))))
