"""Prepare a frame of one or several depth cameras for matching: fast, and robust to noisy normals."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from model.fitting.scan import NEIGHBOURS, ScanPoints, View, prepare_scan, spread_points
from scanprep.geometry.files import PointCloud
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.places import distinct_places
from scanprep.geometry.sanitise import sanitise

CLOSE, AGREE = 0.05, 0.95            # metres; least share of triangles this close that face like the body; a walk: 0.99
NORMAL_POINTS = 24                   # neighbours that make one normal, so that 5 mm of noise does not turn it

Frame = Mesh | PointCloud | np.ndarray | Sequence[View] | None


@dataclass(frozen=True, eq=False)
class _Points:
    """The points (n, 3) of one view, their given normals (n, 3) or None, and the camera (3,) or None, metres."""

    points: np.ndarray
    rough: np.ndarray | None
    viewpoint: np.ndarray | None


# the expected body: a search tree of its vertices, and their normals (N, 3)
_Skin = tuple[cKDTree, np.ndarray]


def prepare_frame(frame: Frame, count: int, viewpoints: Any = None, expected: Mesh | None = None) -> ScanPoints | None:
    """Return points with normals of a frame, or None when it shows nothing.

    Normals are those of planes through many neighbours, so that noise of some millimetres does not turn them. Their
    sign is taken, in this order, from given normals or triangles, from the viewpoint of the camera, from the expected
    body, or from the shape of the point cloud.
    """
    # read the views, each with its camera; views with too few points for a normal are left out
    views = [] if frame is None else [frame] if isinstance(frame, Mesh | PointCloud | np.ndarray) else list(frame)
    cameras = None if viewpoints is None else np.broadcast_to(np.asarray(viewpoints, float), (len(views), 3))
    skin = None if expected is None else (cKDTree(expected.vertices), expected.vertex_normals)
    read = [_read(view, None if cameras is None else cameras[i], i, skin) for i, view in enumerate(views)]
    read = [view for view in read if len(view.points) > max(NEIGHBOURS, NORMAL_POINTS)]
    if sum(len(view.points) for view in read) < 60:  # fewer points show nothing
        return None
    parts = [_orient(view, count // len(read), skin) for view in read]
    points, normals = (np.concatenate([part[i] for part in parts]) for i in (0, 1))
    dense = np.concatenate([part[2] for part in parts])
    # borders are those of all views together
    border, spacing = _borders(points, normals, dense)
    number = np.repeat(np.arange(len(parts)), [len(part[0]) for part in parts])
    # the points were spread evenly above
    even = np.full(len(points), spacing**2)
    return ScanPoints(points, normals, border, spacing, number, np.arange(len(points)), even)


def frame_views(cloud: ScanPoints) -> list[PointCloud]:
    """Return a prepared frame as the views that `complete` takes."""
    return [PointCloud(cloud.points[cloud.view == k], cloud.normals[cloud.view == k]) for k in np.unique(cloud.view)]


def _read(view: View, viewpoint: np.ndarray | None, number: int, skin: _Skin | None) -> _Points:
    """Return the points of a view, finite and each place once, with the normals that its triangles or file give."""
    if isinstance(view, Mesh):
        sound = view if skin is not None and _faces_as(skin, view) else sanitise(view, f"frame: view {number}")
        points, rough = view.vertices, sound.vertex_normals if len(sound.faces) else None
    elif isinstance(view, PointCloud):
        points, rough = view.points, view.normals
    else:
        array = np.asarray(view, dtype=np.float64)
        if array.size == 0:
            array = np.zeros((0, 3))
        if array.ndim != 2 or array.shape[1] not in (3, 6):
            raise ValueError(f"frame: view {number}: expected points of shape (n, 3), or (n, 6) with normals, "
                             f"got {array.shape}")
        points, rough = array[:, :3], array[:, 3:] if array.shape[1] == 6 else None
    good = np.flatnonzero(np.isfinite(points).all(axis=1))
    good = good[distinct_places(points[good])]
    return _Points(points[good], None if rough is None else np.nan_to_num(rough[good]), viewpoint)


def _faces_as(skin: _Skin, view: Mesh) -> bool:
    """Tell whether the triangles of a view face outward: nearly all near the expected body face as it does.

    Without a body `sanitise` casts rays, which takes more than ten times as long.
    """
    # some 500 of the triangles, without those at vertices that are not finite
    corners = view.vertices[view.faces[:: max(1, len(view.faces) // 500)]]
    middle = corners.mean(axis=1)
    seen = np.isfinite(middle).all(axis=1)
    if not seen.any():
        return False
    # normals of these triangles
    normals = np.cross(corners[seen, 1] - corners[seen, 0], corners[seen, 2] - corners[seen, 0])
    # compared with the normal at the nearest vertex of the body
    tree, skin_normals = skin
    far, nearest = tree.query(middle[seen], distance_upper_bound=CLOSE)
    near = np.isfinite(far)
    agree = np.einsum("fd,fd->f", normals[near], skin_normals[nearest[near]]) > 0
    return 2 * near.sum() > len(seen) and float(agree.mean()) >= AGREE


def _orient(view: _Points, count: int, skin: _Skin | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return some points of a view, their normals, and the denser points that gave the normals."""
    denser = 4  # normals come from four times as many points as are matched
    many = spread_points(view.points,
                         denser * count) if len(view.points) > denser * count else np.arange(len(view.points))
    dense = view.points[many]
    chosen = spread_points(dense, count) if len(dense) > count else np.arange(len(dense))
    # the normal is the direction of least spread of the neighbours
    _, near = cKDTree(dense).query(dense[chosen], NORMAL_POINTS)
    around = dense[near] - _middles(dense, near)[:, None]
    normals = np.linalg.eigh(np.swapaxes(around, 1, 2) @ around)[1][:, :, 0]
    # a direction outward, for the sign
    if view.rough is not None:
        outward = view.rough[many][near].sum(axis=1)
    elif view.viewpoint is not None:
        outward = view.viewpoint - dense[chosen]
    elif skin is not None:
        outward = skin[1][skin[0].query(dense[chosen], 4)[1]].sum(axis=1)
    else:
        outward = prepare_scan(dense).normals[chosen]
    normals *= np.where(np.einsum("nd,nd->n", normals, outward) < 0, -1, 1)[:, None]
    return dense[chosen], normals, dense


def _borders(points: np.ndarray, normals: np.ndarray, dense: np.ndarray) -> tuple[np.ndarray, float]:
    """Find border points (n,), whose neighbours are all on one side, and the median spacing, metres."""
    distance, near = cKDTree(dense).query(points, NORMAL_POINTS)
    mean = _middles(dense, near) - points
    mean -= np.einsum("nd,nd->n", mean, normals)[:, None] * normals
    # 0.35: at a border the mean of the neighbours is that far off, as a share of their reach
    border = np.linalg.norm(mean, axis=1) > 0.35 * distance[:, -1]
    # spacing: mean distance of the 4 nearest points, the median over all
    apart = cKDTree(points).query(points, 5)[0][:, 1:].mean(axis=1)
    return border, float(np.median(apart))


def _middles(points: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Compute means (m, 3) of points (n, 3) by number (m, k); one coordinate at a time is four times as fast."""
    return np.stack([along[near].mean(axis=1) for along in points.T], axis=1)
