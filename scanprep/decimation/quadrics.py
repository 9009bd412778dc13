"""Quadrics: squared distances to many planes at once, as one polynomial of a point [QEM].

A quadric is ten numbers, of `x A x + 2 b x + c`: A as xx, xy, xz, yy, yz, zz, then b, then c. Arrays of them
have any shape in front; vertices of M bodies that share triangles are (N, M, 3), their quadrics (N, M, 10).
"""
from __future__ import annotations

import numpy as np

_ROW, _COLUMN = np.array([0, 0, 0, 1, 1, 2]), np.array([0, 1, 2, 1, 2, 2])


def plane_quadrics(normals: np.ndarray, through: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Compute quadrics (..., 10): weighted squared distance to planes with unit normals (..., 3) through points (...,
    3).

    [QEM] fundamental error quadric
    """
    d = -np.einsum("...d,...d->...", normals, through)[..., None]
    return weights[..., None] * np.concatenate([normals[..., _ROW] * normals[..., _COLUMN], d * normals, d * d],
                                               axis=-1)


def point_quadrics(points: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Compute quadrics (..., 10): weighted squared distance to points (..., 3); they always have a unique minimum."""
    out = np.zeros((*points.shape[:-1], 10))
    out[..., [0, 3, 5]] = 1
    out[..., 6:9] = -points
    out[..., 9] = np.einsum("...d,...d->...", points, points)
    return weights[..., None] * out


def surface_quadrics(points: np.ndarray, faces: np.ndarray, hold: float) -> tuple[np.ndarray, np.ndarray]:
    """Sum quadrics (N, M, 10) of the planes of the triangles around every vertex, by area; and area vectors (N, M, 3).

    `hold` is the weight of the distance to the vertex itself against that to the planes.
    """
    corners = points[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    area = np.linalg.norm(cross, axis=-1)
    normal = cross / np.maximum(area, 1e-300)[..., None]
    # 14 columns per triangle: quadric, area vector, area
    planes = np.concatenate([plane_quadrics(normal, corners[:, 0], area), cross, area[..., None]], axis=-1)
    total = sum_at(faces, planes, len(points))
    return total[..., :10] + point_quadrics(points, hold * total[..., 13]), total[..., 10:13]


def curve_quadrics(points: np.ndarray, ends: np.ndarray, normals: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Sum quadrics (N, M, 10) of walls along curves, edges (E, 2), which keep the curves in place.

    Walls are perpendicular to the surface with normals (E, M, 3), and as high as their edges are long.

    [QEM] boundary constraints
    """
    along = points[ends[:, 1]] - points[ends[:, 0]]
    across = np.cross(along, normals)
    across /= np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-300)
    walls = plane_quadrics(across, points[ends[:, 0]], weights[:, None] * np.einsum("...d,...d->...", along, along))
    return sum_at(ends, walls, len(points))


def sum_at(index: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """Add every row of values (n, ...) to each of its targets `index` (n, k); return the sums (count, ...)."""
    flat = values.reshape(len(values), -1)
    out = np.empty((flat.shape[1], count))
    target = index.T.ravel()
    for column, place in zip(flat.T, out, strict=True):
        place[:] = np.bincount(target, np.tile(column, index.shape[1]), count)
    return np.ascontiguousarray(out.T).reshape(count, *values.shape[1:])


def value(Q: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Evaluate quadrics (..., 10) at points (..., 3)."""
    x0, x1, x2 = x[..., 0], x[..., 1], x[..., 2]
    return (x0 * (Q[..., 0] * x0 + 2 * (Q[..., 1] * x1 + Q[..., 2] * x2 + Q[..., 6]))
            + x1 * (Q[..., 3] * x1 + 2 * (Q[..., 4] * x2 + Q[..., 7]))
            + x2 * (Q[..., 5] * x2 + 2 * Q[..., 8]) + Q[..., 9])


def minimise_quadrics(Q: np.ndarray) -> np.ndarray:
    """Find the minima (..., 3) of quadrics (..., 10), which must be unique.

    [QEM] optimal placement
    """
    # solve A x = -b by cofactors, which is faster than a general solver for 3 × 3
    xx, xy, xz, yy, yz, zz, bx, by, bz = (Q[..., i] for i in range(9))
    c0, c1, c2 = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    det = xx * c0 + xy * c1 + xz * c2
    c3, c4, c5 = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    return -np.stack([c0 * bx + c1 * by + c2 * bz, c1 * bx + c3 * by + c4 * bz, c2 * bx + c4 * by + c5 * bz],
                     axis=-1) / det[..., None]
