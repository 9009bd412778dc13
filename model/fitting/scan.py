"""Preparation of a scan for matching: outward normals, thinning, borders, clothing set apart."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from scanprep.depth_camera.person import PicturedPerson, segment_person
from scanprep.depth_camera.picture import DepthPicture
from scanprep.geometry.files import PointCloud
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.places import areas_by_neighbours, distinct_places
from scanprep.geometry.sanitise import sanitise
from scanprep.threads import search_threads

from .normals import GRAZING, complete_normals, one_sign, plane_normals, spread_points, turn_outward

NEIGHBOURS = 16                      # points that determine one normal: enough to average out noise

View = Mesh | PointCloud | np.ndarray
Scan = View | Sequence[View] | DepthPicture


@dataclass(frozen=True, eq=False)
class ScanPoints:
    """Oriented points of a scan, of one view or of several."""

    points: np.ndarray      # (n, 3), metres
    normals: np.ndarray     # (n, 3), unit, outward
    border: np.ndarray      # (n,) bool, on the border of all views together; all false for bare points
    spacing: float          # metres, median distance of neighbouring points
    view: np.ndarray        # (n,) int, which view each point belongs to
    index: np.ndarray       # (n,) int, number of the point among all input points, one view after the other
    areas: np.ndarray       # (n,) square metres, the surface that each point stands for
    masked: ScanPoints | None = None  # points of clothing or hair, which are not among `points`
    viewpoints: np.ndarray | None = None  # (views, 3), metres, where given
    person: PicturedPerson | None = None      # the person in the depth picture that the points are from

    @property
    def views(self) -> int:
        """The number of views."""
        return 1 + max(part.view.max(initial=0) for part in (self, self.masked) if part is not None)

    @property
    def everything(self) -> ScanPoints:
        """All points, masked or not."""
        return self if self.masked is None else _concatenate([replace(self, masked=None), self.masked])

    def some(self, keep: np.ndarray) -> ScanPoints:
        """Select some of the points, by number or mask (n,); the clothing stays."""
        return replace(self, points=self.points[keep], normals=self.normals[keep], border=self.border[keep],
                       view=self.view[keep], index=self.index[keep], areas=self.areas[keep])

    def share_of_area(self, chosen: np.ndarray) -> float:
        """Compute the share of the scanned surface at chosen points (n,) bool."""
        return float(self.areas @ chosen / self.areas.sum())

    def thin(self, count: int) -> ScanPoints:
        """Reduce the points to about `count`, spread evenly."""
        return self if len(self.points) <= count else self.some(spread_points(self.points, count))

    def scale_by(self, factor: float) -> ScanPoints:
        """Scale all lengths by a factor."""
        masked = None if self.masked is None else self.masked.scale_by(factor)
        seen_from = None if self.viewpoints is None else factor * self.viewpoints
        assert self.person is None or factor == 1, "a picture is in metres"
        return replace(self, points=factor * self.points, spacing=factor * self.spacing, areas=factor**2 * self.areas,
                       masked=masked, viewpoints=seen_from)


def prepare_scan(scan: View | Sequence[View], viewpoint: Any = None, masked: np.ndarray | None = None,
                 metres: float = 1.0) -> ScanPoints:
    """Prepare the points and normals of a scan.

    `scan` is a Mesh, PointCloud, (n, 3) or (n, 6), metres, or a sequence of these. `viewpoint` is (3,), metres, or one
    for each view. `masked` (n,) bool marks points of clothing or hair, one view after the other.
    """
    views = [scale_view(view, metres) for view in as_views(scan)]
    from_where = check_viewpoints(viewpoint, len(views), metres)
    parts, start = [], 0
    for number, view in enumerate(views):
        name = "scan" if len(views) == 1 else f"scan: view {number}"
        part = _prepare_view(view, None if from_where is None else from_where[number], name)
        parts.append(replace(part, view=np.full(len(part.points), number), index=part.index + start))
        start += point_count(view)
    whole = parts[0] if len(parts) == 1 else _without_inner_borders(_concatenate(parts))
    whole = replace(whole, viewpoints=from_where)
    return whole if masked is None else set_apart(whole, check_mask(masked, start))


def prepare_picture(picture: DepthPicture, size: float, marks: np.ndarray) -> ScanPoints:
    """Prepare the points and normals of the one person in a depth picture; ValueError where there is not one.

    `size`, metres, is the root of the body's surface area; `marks` (L, 3), metres, are points on the person.
    """
    person = segment_person(picture, size, marks)
    points, normals, edge = person.points_and_normals()
    pixels, every = points[:, 2] / person.picture.intrinsics[0, 0], np.arange(len(points))
    # a pixel sees more of surfaces that are farther away, and of oblique ones
    cosines = np.abs(np.einsum("nd,nd->n", normals, points)) / np.linalg.norm(points, axis=1)
    areas = pixels**2 / np.maximum(cosines, GRAZING)
    return ScanPoints(points, normals, edge, float(np.median(pixels)), 0 * every, every, areas,
                      viewpoints=np.zeros((1, 3)), person=person)


def as_views(scan: View | Sequence[View]) -> list[View]:
    """List the views of a scan: one for a single mesh or cloud."""
    if isinstance(scan, Mesh | PointCloud | np.ndarray):
        return [scan]
    views = list(scan)
    if not views:
        raise ValueError("scan: expected at least one view, got none")
    if all(isinstance(view, Mesh | PointCloud) or np.ndim(view) == 2 for view in views):
        return [view if isinstance(view, Mesh | PointCloud) else np.asarray(view, dtype=np.float64) for view in views]
    return [np.asarray(views, dtype=np.float64)]


def point_count(view: View) -> int:
    """Count the points of a view, including those in no triangle."""
    return len(view.vertices) if isinstance(view, Mesh) else len(view.points) if isinstance(view, PointCloud) \
        else len(view)


def scale_view(view: View, metres: float) -> View:
    """Scale a view by a factor; normals stay."""
    if metres == 1:
        return view
    if isinstance(view, Mesh):
        return view.with_vertices(metres * view.vertices)
    if isinstance(view, PointCloud):
        return replace(view, points=metres * view.points)
    return np.hstack([metres * view[:, :3], view[:, 3:]])


def all_points(scan: View | Sequence[View]) -> np.ndarray:
    """Concatenate the points of all views, (n, 3) metres."""
    return np.concatenate([_split(view, f"scan: view {i}")[0] for i, view in enumerate(as_views(scan))])


def check_viewpoints(viewpoint: Any, views: int, metres: float = 1.0) -> np.ndarray | None:
    """Check viewpoints and return them as (views, 3), metres, or None."""
    if viewpoint is None:
        return None
    given = np.asarray(viewpoint, dtype=np.float64)
    if given.shape not in ((3,), (views, 3)) or not np.isfinite(given).all():
        raise ValueError(f"viewpoint: expected 3 finite numbers, or 3 for each of the {views} views, "
                         f"got shape {given.shape}")
    return metres * np.broadcast_to(given, (views, 3))


def check_mask(masked: np.ndarray, count: int) -> np.ndarray:
    """Check a mask (count,) bool; enough points must remain."""
    masked = np.asarray(masked)
    if masked.dtype != bool or masked.shape != (count,):
        raise ValueError(f"masked: expected {count} booleans, one for each point of the scan, "
                         f"got {masked.dtype} of shape {masked.shape}")
    if count - masked.sum() <= NEIGHBOURS:
        raise ValueError(f"masked: expected more than {NEIGHBOURS} points that are not masked, "
                         f"got {count - masked.sum()}")
    return masked


def _prepare_view(scan: View, viewpoint: np.ndarray | None, name: str) -> ScanPoints:
    points, own_normals = _split(scan, name)
    if len(points) <= NEIGHBOURS:
        raise ValueError(f"{name}: expected more than {NEIGHBOURS} points, got {len(points)}")
    if not np.isfinite(points).all():
        bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
        raise ValueError(f"{name}: {len(bad)} points are not finite, the first is point {bad[0]}")
    # of a mesh, vertices with triangles count, and their normals and areas are known
    index, border, areas = distinct_places(points), np.zeros(len(points), dtype=bool), np.zeros(len(points))
    meshed = isinstance(scan, Mesh) and len(scan.faces) > 0
    if isinstance(scan, Mesh) and meshed:
        scan = sanitise(scan, name)
        own_normals, areas = scan.vertex_normals, scan.vertex_areas
        border[scan.boundary_vertices] = True
        index = np.flatnonzero((own_normals != 0).any(axis=1))
        index = index[distinct_places(points[index])]
    if len(index) <= NEIGHBOURS:
        raise ValueError(f"{name}: expected more than {NEIGHBOURS} "
                         f"{'vertices with triangles' if meshed else 'distinct points'}, got {len(index)}")
    # repeated points were dropped: they would distort distances to neighbours and the planes through them
    points, border, own_normals = points[index], border[index], None if own_normals is None else own_normals[index]
    distance, near = cKDTree(points).query(points, NEIGHBOURS, workers=search_threads(len(points)))
    spacing = float(np.median(distance[:, 1:5].mean(axis=1)))
    if meshed and own_normals is not None:
        return ScanPoints(points, own_normals, border, spacing, 0 * index, index, areas[index])
    # bare points: normals by planes, oriented to the viewpoint where one is known, else by their neighbourhood
    normals = plane_normals(points, near) if own_normals is None else complete_normals(own_normals, points, near)
    if viewpoint is not None:
        normals = normals * np.where(np.einsum("nd,nd->n", normals, viewpoint - points) < 0, -1, 1)[:, None]
    elif own_normals is None or not one_sign(normals, near):
        normals = turn_outward(points, normals, near, distance, 4 * spacing)
    return ScanPoints(points, normals, border, spacing, 0 * index, index, areas_by_neighbours(distance))


def _split(scan: View, name: str) -> tuple[np.ndarray, np.ndarray | None]:
    """Split a view into points (n, 3) and normals (n, 3), where it has normals."""
    if isinstance(scan, Mesh):
        return scan.vertices, None
    normals = None if not isinstance(scan, PointCloud) else scan.normals
    points = np.asarray(scan.points if isinstance(scan, PointCloud) else scan, dtype=np.float64)
    if points.ndim == 2 and points.shape[1] == 6 and not isinstance(scan, PointCloud):
        points, normals = points[:, :3], points[:, 3:]
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"{name}: expected points of shape (n, 3), or (n, 6) with normals, got {points.shape}")
    if normals is not None and np.shape(normals) != points.shape:
        raise ValueError(f"{name}: expected one normal for each of {len(points)} points, got {np.shape(normals)}")
    return points, None if normals is None else np.asarray(normals, dtype=np.float64)


def _concatenate(parts: Sequence[ScanPoints]) -> ScanPoints:
    points, normals, border, view, index, areas = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in ("points", "normals", "border", "view", "index", "areas"))
    spacing = float(np.median([part.spacing for part in parts]))
    return ScanPoints(points, normals, border, spacing, view, index, areas)


def _without_inner_borders(scan: ScanPoints) -> ScanPoints:
    """Remove border marks where another view continues the surface."""
    border = scan.border.copy()
    for number in np.unique(scan.view[border]):
        own = np.flatnonzero(border & (scan.view == number))
        others = scan.points[(scan.view != number) & ~scan.border]
        if len(others):
            border[own] = cKDTree(others).query(scan.points[own])[0] > 2 * scan.spacing
    return replace(scan, border=border)


def set_apart(scan: ScanPoints, masked: np.ndarray) -> ScanPoints:
    """Set the masked points (n,) bool of a whole scan apart, as clothing and hair."""
    out = masked[scan.index]
    return replace(scan.some(~out), masked=scan.some(out)) if out.any() else scan
