"""A scan made ready for matching: points with outward normals, thinned, borders marked."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.spatial import cKDTree

from scanprep.geometry.mesh import Mesh

NEIGHBOURS = 16                      # points that make one normal
COARSE = 2000                        # points that show the form at large
WIDE = 0.12                          # metres: at this scale a body is convex enough to tell in from out


@dataclass(frozen=True, eq=False)
class ScanPoints:
    """Oriented points of a scan.

    Attributes
    ----------
    points : (n, 3) float, metres
    normals : (n, 3) float, unit, outward
    border : (n,) bool
        On the border of the scan's own triangulation; all false for bare points.
    spacing : float, metres
        Median distance of neighbouring points.
    """

    points: np.ndarray
    normals: np.ndarray
    border: np.ndarray
    spacing: float

    def thinned(self, count: int) -> ScanPoints:
        """At most about `count` of the points, spread evenly."""
        if len(self.points) <= count:
            return self
        keep = spread(self.points, count)
        return ScanPoints(self.points[keep], self.normals[keep], self.border[keep], self.spacing)


def prepare_scan(scan: Mesh | np.ndarray, viewpoint: np.ndarray | None = None) -> ScanPoints:
    """Points and normals of a scan.

    Parameters
    ----------
    scan : Mesh, or (n, 3) float, metres
        A mesh brings its normals. For bare points they are estimated from neighbours and turned outward.
    viewpoint : (3,) float, metres, optional
        Where bare points were seen from; their normals are turned towards it.

    Raises
    ------
    ValueError
        Too few points, or points that are not finite.
    """
    points = scan.vertices if isinstance(scan, Mesh) else np.asarray(scan, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"scan: expected points of shape (n, 3), got {points.shape}")
    if len(points) <= NEIGHBOURS:
        raise ValueError(f"scan: expected more than {NEIGHBOURS} points, got {len(points)}")
    if not np.isfinite(points).all():
        bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
        raise ValueError(f"scan: {len(bad)} points are not finite, the first is point {bad[0]}")
    distance, near = cKDTree(points).query(points, NEIGHBOURS, workers=-1)
    spacing = float(np.median(distance[:, 1:5].mean(axis=1)))
    if isinstance(scan, Mesh) and len(scan.faces):
        border = np.zeros(len(points), dtype=bool)
        border[scan.boundary_vertices] = True
        used = (scan.vertex_normals != 0).any(axis=1)
        if used.sum() <= NEIGHBOURS:
            raise ValueError(f"scan: expected more than {NEIGHBOURS} vertices with triangles, got {used.sum()}")
        return ScanPoints(points[used], scan.vertex_normals[used], border[used], spacing)
    normals = _plane_normals(points, near)
    if viewpoint is None:
        normals = _turn_outward(points, normals, near, distance, 4 * spacing)
    else:
        normals = normals * np.where(np.einsum("nd,nd->n", normals, viewpoint - points) < 0, -1, 1)[:, None]
    return ScanPoints(points, normals, np.zeros(len(points), dtype=bool), spacing)


def spread(points: np.ndarray, count: int) -> np.ndarray:
    """Indices of about `count` points, one to each cell of a grid, so that they cover the whole evenly."""
    extent = np.ptp(points, axis=0).max()
    low, high = extent / 2048, extent
    for _ in range(20):
        cell = np.sqrt(low * high)
        keys = np.floor((points - points.min(axis=0)) / cell).astype(np.int64)
        _, first = np.unique(keys @ np.array([1, 4096, 4096**2]), return_index=True)
        if len(first) > count:
            low = cell
        else:
            high = cell
        if abs(len(first) - count) <= 0.03 * count:
            break
    return np.sort(first)


def _plane_normals(points: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Unit normals (n, 3), of either sign, of the planes through the neighbours of each point."""
    around = points[near] - points[near].mean(axis=1, keepdims=True)
    _, axes = np.linalg.eigh(np.swapaxes(around, 1, 2) @ around)
    return axes[:, :, 0]


def _turn_outward(points: np.ndarray, normals: np.ndarray, near: np.ndarray, distance: np.ndarray, reach: float
                  ) -> np.ndarray:
    """Normals of one sign along each connected patch, then each patch turned to its convex side."""
    n = len(points)
    a, b = np.repeat(np.arange(n), near.shape[1] - 1), near[:, 1:].ravel()
    kept = distance[:, 1:].ravel() <= reach
    a, b = a[kept], b[kept]
    turn = 1.001 - np.abs(np.einsum("nd,nd->n", normals[a], normals[b]))
    graph = coo_array((turn, (a, b)), shape=(n, n)).tocsr()
    tree = minimum_spanning_tree(graph)
    tree = tree + tree.T
    patches, patch = connected_components(tree, directed=False)
    out = normals.copy()
    for root in np.unique(patch, return_index=True)[1]:
        order, before = breadth_first_order(tree, root, directed=False)
        for i in order[1:]:
            if out[i] @ out[before[i]] < 0:
                out[i] = -out[i]
    coarse = points[spread(points, COARSE)] if n > COARSE else points
    far, around = cKDTree(coarse).query(points, 48, distance_upper_bound=WIDE, workers=-1)
    found = np.isfinite(far)
    total = np.where(found[:, :, None], coarse[np.where(found, around, 0)] - points[:, None], 0).sum(axis=1)
    bulge = -np.einsum("nd,nd->n", out, total)
    sign = np.where(np.bincount(patch, bulge, patches) < 0, -1.0, 1.0)
    return out * sign[patch][:, None]
