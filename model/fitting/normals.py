"""Normals of scan points: estimation, completion, outward orientation."""
from __future__ import annotations

import numpy as np
from scipy.optimize import minimize
from scipy.sparse.csgraph import breadth_first_order, connected_components
from scipy.spatial import cKDTree

from scanprep.geometry.sparse import spanning_tree
from scanprep.threads import search_threads

GRAZING = 0.3                        # cosine: a scanner sees little of surfaces more oblique than this


def spread_points(points: np.ndarray, count: int) -> np.ndarray:
    """Choose about `count` points, one in each cell of a grid, so that they cover the whole evenly; return indices."""
    # find the cell size by bisection, with a guess from the last count
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
    """Estimate unit normals (n, 3), of either sign, by the plane through the neighbours of each point."""
    around = points[near] - points[near].mean(axis=1, keepdims=True)
    _, axes = np.linalg.eigh(np.swapaxes(around, 1, 2) @ around)
    return axes[:, :, 0]


def complete_normals(given: np.ndarray, points: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Complete normals (n, 3): where one is zero or not finite, take that of the neighbours' plane."""
    length = np.linalg.norm(given, axis=1)
    good = np.isfinite(length) & (length > 1e-9)
    normals = np.where(good[:, None], given / np.where(good, length, 1)[:, None], 0.0)
    if not good.all():
        plane = plane_normals(points, near[~good])
        around = normals[near[~good]].sum(axis=1)
        normals[~good] = plane * np.where(np.einsum("nd,nd->n", plane, around) < 0, -1, 1)[:, None]
    return normals


def one_sign(normals: np.ndarray, near: np.ndarray) -> bool:
    """Return whether normals are oriented consistently: many programs estimate them with random signs."""
    # 95% of neighbours must agree; sharp edges and noise make a few disagree
    return float((np.einsum("nd,nd->n", normals, normals[near[:, 1]]) > 0).mean()) > 0.95


def turn_outward(points: np.ndarray, normals: np.ndarray, near: np.ndarray, distance: np.ndarray, reach: float
                  ) -> np.ndarray:
    """Orient normals: consistently along each connected patch, then each patch to its convex side.

    Where nearly all then face one viewpoint, the scan was taken from there, and patches that turn away are flipped.
    """
    n = len(points)
    a, b = np.repeat(np.arange(n), near.shape[1] - 1), near[:, 1:].ravel()
    kept = distance[:, 1:].ravel() <= reach
    a, b = a[kept], b[kept]
    # 1. signs spread along a spanning tree that avoids sharp edges
    turn = 1.001 - np.abs(np.einsum("nd,nd->n", normals[a], normals[b]))
    tree = spanning_tree(a, b, turn, n)
    tree = tree + tree.T
    patches, patch = connected_components(tree, directed=False)
    roots, flipped = np.unique(patch, return_index=True)[1], np.zeros(n, dtype=bool).tolist()
    for root in roots:
        order, before = breadth_first_order(tree, root, directed=False)
        child, above = order[1:], before[order[1:]]
        turned = np.einsum("nd,nd->n", normals[child], normals[above]) < 0
        for i, parent, turn_it in zip(child.tolist(), above.tolist(), turned.tolist(), strict=True):
            flipped[i] = flipped[parent] != turn_it
    out = np.where(np.array(flipped)[:, None], -normals, normals)
    # 2. the side on which a patch bulges, by neighbours within 12 cm of every fourth point: at that scale bodies are
    # convex enough to tell inside from outside
    coarse_count = 2000  # points that show the overall form
    coarse = points[spread_points(points, coarse_count)] if n > coarse_count else points
    at = np.r_[roots, 0:n:4]
    far, around = cKDTree(coarse).query(points[at], 48, distance_upper_bound=0.12, workers=search_threads(len(at)))
    found = np.isfinite(far)
    total = np.where(found[:, :, None], coarse[np.where(found, around, 0)] - points[at, None], 0).sum(axis=1)
    bulge = -np.einsum("nd,nd->n", out[at], total)
    sign = np.where(np.bincount(patch[at], bulge, patches) < 0, -1.0, 1.0)
    out = out * sign[patch][:, None]
    # 3. a scan from one viewpoint, which 90% of the points face: all patches face it
    facing = faces(facing_point(points, out), points, out)
    if facing.mean() < 0.9:
        return out
    sign = np.where(np.bincount(patch, facing - 0.5, patches) < 0, -1.0, 1.0)
    return out * sign[patch][:, None]


def faces(viewpoint: np.ndarray, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Find which normals (n, 3) of points (n, 3) face a viewpoint (3,): (n,) bool."""
    to = viewpoint - points
    return np.einsum("nd,nd->n", to, normals) > 0.05 * np.linalg.norm(to, axis=1)


def facing_point(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Estimate the viewpoint (3,) from which the fewest normals (n, 3) turn away; its distance is not exact."""
    enough = 2000  # points determine the viewpoint as well as all do
    keep = spread_points(points, enough) if len(points) > enough else slice(None)
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
