"""Normals of points: estimated, completed, turned outward."""
from __future__ import annotations

import numpy as np
from scipy.optimize import minimize
from scipy.sparse.csgraph import breadth_first_order, connected_components
from scipy.spatial import cKDTree

from scanprep.geometry.sparse import spanning_tree
from scanprep.threads import search_threads

COARSE = 2000                        # points that show the form at large
GRAZING = 0.3                        # cosine below which a scanner sees little


def spread_points(points: np.ndarray, count: int) -> np.ndarray:
    """Indices of about `count` points, one to each cell of a grid, so that they cover the whole evenly."""
    extent = np.ptp(points, axis=0).max()
    low, high = extent / 2048, extent
    cell = np.sqrt(low * high)
    for _ in range(20):
        keys = np.floor((points - points.min(axis=0)) / cell).astype(np.int64)
        _, first = np.unique(keys @ np.array([1, 4096, 4096**2]), return_index=True)
        if abs(len(first) - count) <= 0.03 * count:
            break
        low, high = (cell, high) if len(first) > count else (low, cell)
        ahead = cell * np.sqrt(len(first) / count)                            # cells of a surface go by the square
        cell = ahead if low < ahead < high else np.sqrt(low * high)
    return np.sort(first)


def plane_normals(points: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Unit normals (n, 3), of either sign, of the planes through the neighbours of each point."""
    around = points[near] - points[near].mean(axis=1, keepdims=True)
    _, axes = np.linalg.eigh(np.swapaxes(around, 1, 2) @ around)
    return axes[:, :, 0]


def complete_normals(given: np.ndarray, points: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Unit normals (n, 3): those given, and where one is zero or not finite that of the neighbours' plane."""
    length = np.linalg.norm(given, axis=1)
    good = np.isfinite(length) & (length > 1e-9)
    normals = np.where(good[:, None], given / np.where(good, length, 1)[:, None], 0.0)
    if not good.all():
        plane = plane_normals(points, near[~good])
        around = normals[near[~good]].sum(axis=1)
        normals[~good] = plane * np.where(np.einsum("nd,nd->n", plane, around) < 0, -1, 1)[:, None]
    return normals


def one_sign(normals: np.ndarray, near: np.ndarray) -> bool:
    """Whether given normals were oriented: many programs estimate them and leave their sign to chance."""
    # share of neighbours that must agree for given normals to be of one sign
    return float((np.einsum("nd,nd->n", normals, normals[near[:, 1]]) > 0).mean()) > 0.95


def turn_outward(points: np.ndarray, normals: np.ndarray, near: np.ndarray, distance: np.ndarray, reach: float
                  ) -> np.ndarray:
    """Normals of one sign along each connected patch, then each patch turned to its convex side.

    Where nearly all then face one viewpoint, the scan is from there, and patches that turn away have the wrong sign.
    """
    n = len(points)
    a, b = np.repeat(np.arange(n), near.shape[1] - 1), near[:, 1:].ravel()
    kept = distance[:, 1:].ravel() <= reach
    a, b = a[kept], b[kept]
    turn = 1.001 - np.abs(np.einsum("nd,nd->n", normals[a], normals[b]))
    tree = spanning_tree(a, b, turn, n)
    tree = tree + tree.T
    patches, patch = connected_components(tree, directed=False)
    roots, flipped = np.unique(patch, return_index=True)[1], np.zeros(n, dtype=bool).tolist()
    for root in roots:
        order, before = breadth_first_order(tree, root, directed=False)
        mine, above = order[1:], before[order[1:]]
        turned = np.einsum("nd,nd->n", normals[mine], normals[above]) < 0
        for i, parent, turn_it in zip(mine.tolist(), above.tolist(), turned.tolist(), strict=True):
            flipped[i] = flipped[parent] != turn_it
    out = np.where(np.array(flipped)[:, None], -normals, normals)
    coarse = points[spread_points(points, COARSE)] if n > COARSE else points
    # one of so many points is asked which way its patch bulges
    some = np.r_[roots, 0:n:4]
    # metres: at this scale a body is convex enough to tell in from out
    far, around = cKDTree(coarse).query(points[some], 48, distance_upper_bound=0.12, workers=search_threads(len(some)))
    found = np.isfinite(far)
    total = np.where(found[:, :, None], coarse[np.where(found, around, 0)] - points[some, None], 0).sum(axis=1)
    bulge = -np.einsum("nd,nd->n", out[some], total)
    sign = np.where(np.bincount(patch[some], bulge, patches) < 0, -1.0, 1.0)
    out = out * sign[patch][:, None]
    facing = faces(facing_point(points, out), points, out)
    # share of the points that face one viewpoint, of a scan from there
    if facing.mean() < 0.9:
        return out
    sign = np.where(np.bincount(patch, facing - 0.5, patches) < 0, -1.0, 1.0)
    return out * sign[patch][:, None]


def faces(viewpoint: np.ndarray, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(n,) bool: whether normals (n, 3) of points (n, 3) face a viewpoint (3,)."""
    to = viewpoint - points
    return np.einsum("nd,nd->n", to, normals) > 0.05 * np.linalg.norm(to, axis=1)


def facing_point(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """The viewpoint (3,) from which the fewest normals (n, 3) of points (n, 3) turn away; its distance is not exact."""
    few = 2000  # points that are enough to find the viewpoint
    keep = spread_points(points, few) if len(points) > few else slice(None)
    normals, centre = normals[keep], points[keep].mean(axis=0)
    points = points[keep] - centre
    size = max(np.linalg.norm(points, axis=1).max(), 1e-12)
    points /= size
    outward, squared = np.einsum("nd,nd->n", normals, points), (points**2).sum(axis=1)

    def turned_away(q: np.ndarray) -> float:
        to, near = q[:3] / np.linalg.norm(q[:3]), q[3]           # the view is in direction `to`, 1 / near away
        cosine = (normals @ to - near * outward) / np.sqrt(1 - 2 * near * (points @ to) + near**2 * squared)
        return float(np.mean(np.clip(GRAZING - cosine, 0, 0.5)**2))   # some normals may have the wrong sign

    start = normals.mean(axis=0)
    found = minimize(turned_away, np.r_[start / max(np.linalg.norm(start), 1e-12), 0.3], method="Nelder-Mead",
                     options={"maxiter": 400, "xatol": 1e-3, "fatol": 1e-9}).x
    nearness = np.clip(found[3], 0.05, 0.7)
    return centre + size / nearness * found[:3] / np.linalg.norm(found[:3])
