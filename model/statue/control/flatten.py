"""A cut surface laid flat in one piece: no triangle inverted, no overlap, areas and angles nearly kept."""
from __future__ import annotations

from fractions import Fraction

import numpy as np
from scipy.sparse import coo_array, csc_array, diags_array

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.sparse import factor


def flatten(mesh: Mesh) -> np.ndarray:
    """Places in the plane (N, 2) of a surface with one border, scaled to its area, one-to-one.

    Begins with an embedding of Tutte, the border on a circle, and lowers the symmetric Dirichlet energy
    |J|² + |J⁻¹|², J the derivative of the map, by Newton's method with definite Hessians of the triangles. No step
    inverts a triangle or lets the border cross itself, so every stage is one-to-one.
    """
    rest = _rest(mesh)
    areas = mesh.face_areas / mesh.face_areas.sum()
    border = mesh.boundary_loops[0]
    uv = tutte(mesh, border)
    uv *= np.sqrt(mesh.face_areas.sum() / abs(_signed_areas(uv, mesh.faces).sum()))
    gap = 0.012 * np.sqrt(mesh.face_areas.sum())    # nearer than this, pieces of the border push each other off
    energy = _energy(uv, mesh.faces, rest, areas, border, gap)
    for _ in range(300):
        gradient, hessian = _derivatives(uv, mesh.faces, rest, areas, border, gap)
        ridge = diags_array(np.full(2 * len(uv), 1e-9 * hessian.diagonal().mean()))
        step = -factor((hessian + ridge).tocsc())(gradient).reshape(-1, 2)
        slope, length, before = float(gradient @ step.ravel()), 1.0, energy
        while length > 1e-12:
            trial = uv + length * step
            energy = _energy(trial, mesh.faces, rest, areas, border, gap)
            if energy <= before + 1e-4 * length * slope and not crossings(trial[border]):
                uv = trial
                break
            length /= 2
        else:
            return uv
        if before - energy < 1e-5 * energy:
            break
    return uv


def tutte(mesh: Mesh, border: np.ndarray) -> np.ndarray:
    """The embedding (N, 2) with the border on a circle and every other vertex in the mean of its neighbours."""
    sides = np.linalg.norm(mesh.vertices[border] - np.roll(mesh.vertices[border], -1, axis=0), axis=1)
    angle = 2 * np.pi * np.r_[0, np.cumsum(sides)[:-1]] / sides.sum()
    uv = np.zeros((len(mesh.vertices), 2))
    uv[border] = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    A = mesh.vertex_adjacency
    inner = np.setdiff1d(np.arange(len(uv)), border)
    L = (diags_array(A.sum(axis=1)) - A).tocsr()
    solve = factor(L[inner][:, inner].tocsc())
    uv[inner] = solve(-(L[inner][:, border] @ uv[border]))
    return uv


def crossings(loop: np.ndarray) -> bool:
    """Whether a closed polygon (n, 2) meets itself other than where its sides follow each other, exactly."""
    a, b = loop, np.roll(loop, -1, axis=0)
    n = len(loop)
    low, high = np.minimum(a, b), np.maximum(a, b)
    near = (low[:, None] <= high[None]).all(axis=2) & (low[None] <= high[:, None]).all(axis=2)
    i, j = np.nonzero(np.triu(near, 2))
    apart = (j - i) % n != n - 1
    i, j = i[apart], j[apart]

    met = _across(a[i], b[i], a[j], b[j]) <= 0
    i, j = i[met], j[met]
    return bool((_across(a[j], b[j], a[i], b[i]) <= 0).any())


def _across(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
    """(n,) -1 where c and d lie on different sides of the line ab, 0 where one of them lies on it, else 1."""
    return orientation(a, b, c) * orientation(a, b, d)


def orientation(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """(n,) the exact sign of the area of triangles in the plane: 1 counter-clockwise, 0 without area, -1 clockwise."""
    first = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1])
    second = (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    sign = np.sign(first - second).astype(int)
    # else the sign is worked out in fractions
    for k in np.flatnonzero(np.abs(first - second) <= 1e-15 * (np.abs(first) + np.abs(second))):
        (ax, ay), (bx, by), (cx, cy) = (map(Fraction, map(float, p[k])) for p in (a, b, c))
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        sign[k] = (area > 0) - (area < 0)
    return sign


def _rest(mesh: Mesh) -> np.ndarray:
    """(F, 2, 2) inverse of the two sides of every triangle in its own plane, the sides as columns."""
    c = mesh.corners
    u, v = c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]
    x = np.linalg.norm(u, axis=1)
    along = np.einsum("fd,fd->f", u, v) / x
    flat = np.zeros((len(c), 2, 2))
    flat[:, 0, 0], flat[:, 0, 1], flat[:, 1, 1] = x, along, 2 * mesh.face_areas / x
    return np.linalg.inv(flat)


def _signed_areas(uv: np.ndarray, faces: np.ndarray) -> np.ndarray:
    u, v = uv[faces[:, 1]] - uv[faces[:, 0]], uv[faces[:, 2]] - uv[faces[:, 0]]
    return (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / 2


def _jacobians(uv: np.ndarray, faces: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """(F, 4) derivative of the map, row by row."""
    sides = np.stack([uv[faces[:, 1]] - uv[faces[:, 0]], uv[faces[:, 2]] - uv[faces[:, 0]]], axis=2)
    return (sides @ rest).reshape(-1, 4)


def _energy(uv: np.ndarray, faces: np.ndarray, rest: np.ndarray, areas: np.ndarray, border: np.ndarray, gap: float
            ) -> float:
    x = _jacobians(uv, faces, rest)
    d = x[:, 0] * x[:, 3] - x[:, 1] * x[:, 2]
    if not (d > 0).all():
        return np.inf
    squared = (x * x).sum(axis=1)
    return float(areas @ (squared + squared / d**2)) + _pushing(uv, border, gap)[0]


def _derivatives(uv: np.ndarray, faces: np.ndarray, rest: np.ndarray, areas: np.ndarray, border: np.ndarray, gap: float
                 ) -> tuple[np.ndarray, csc_array]:
    """Gradient (2N,) and a definite Hessian (2N, 2N) of the energy."""
    x = _jacobians(uv, faces, rest)
    d = x[:, 0] * x[:, 3] - x[:, 1] * x[:, 2]
    squared = (x * x).sum(axis=1)
    cofactor = x[:, [3, 2, 1, 0]] * [1, -1, -1, 1]
    swap = np.zeros((4, 4))
    swap[[0, 1, 2, 3], [3, 2, 1, 0]] = [1, -1, -1, 1]
    first = 2 * (1 + 1 / d**2)[:, None] * x - (2 * squared / d**3)[:, None] * cofactor
    outer = x[:, :, None] * cofactor[:, None]
    second = (2 * (1 + 1 / d**2)[:, None, None] * np.eye(4) - 4 / d[:, None, None]**3 * (outer + outer.swapaxes(1, 2))
              + (6 * squared / d**4)[:, None, None] * cofactor[:, :, None] * cofactor[:, None]
              - (2 * squared / d**3)[:, None, None] * swap)
    values, vectors = np.linalg.eigh(second)
    second = (vectors * np.maximum(values, 1e-9)[:, None]) @ vectors.swapaxes(1, 2)
    # x = B q with q the six coordinates of a triangle's corners
    B = np.zeros((len(faces), 4, 6))
    for k in range(2):
        for axis in range(2):
            B[:, 2 * axis + k, 2 + axis], B[:, 2 * axis + k, 4 + axis] = rest[:, 0, k], rest[:, 1, k]
            B[:, 2 * axis + k, axis] = -rest[:, 0, k] - rest[:, 1, k]
    _, corners, pushed, stiffness = _pushing(uv, border, gap)
    places = (2 * np.concatenate([faces, corners])[:, :, None] + np.arange(2)).reshape(-1, 6)
    slopes = np.concatenate([areas[:, None] * np.einsum("fab,fa->fb", B, first), pushed])
    blocks = np.concatenate([areas[:, None, None] * (B.swapaxes(1, 2) @ second @ B), stiffness])
    size, rows, columns = 2 * len(uv), np.repeat(places, 6, axis=1).ravel(), np.tile(places, (1, 6)).ravel()
    return (np.bincount(places.ravel(), slopes.ravel(), size),
            csc_array(coo_array((blocks.ravel(), (rows, columns)), shape=(size, size))))


def _pushing(uv: np.ndarray, border: np.ndarray, gap: float) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
    """(gap/distance - 1)² of border points and sides nearer than the gap: the sum, their corners (m, 3), slopes (m, 6)
    and definite second derivatives (m, 6, 6) by the corners' places.
    """
    p, n = uv[border], len(border)
    following = np.roll(np.arange(n), -1)
    a, side = p, p[following] - p
    w = p[:, None] - a[None]
    t = np.clip(np.einsum("ijd,jd->ij", w, side) / np.maximum((side**2).sum(axis=1), 1e-300), 0, 1)
    away = w - t[:, :, None] * side
    squared = (away**2).sum(axis=2)
    index = np.arange(n)
    squared[index, index] = squared[following, index] = np.inf
    i, j = np.nonzero(squared < gap**2)
    far, t = np.sqrt(squared[i, j]), t[i, j]
    unit = away[i, j] / far[:, None]
    share = np.stack([np.ones_like(t), t - 1, -t], axis=1)            # of the point and the side's two ends
    first = -2 * (gap / far - 1) * gap / far**2
    second = np.maximum(6 * gap**2 / far**4 - 4 * gap / far**3, 0)
    q = (share[:, :, None] * unit[:, None]).reshape(-1, 6)
    corners = np.stack([border[i], border[j], border[following[j]]], axis=1)
    scale = 0.02 / n
    return (scale * float(((gap / far - 1)**2).sum()), corners, scale * first[:, None] * q,
            scale * second[:, None, None] * q[:, :, None] * q[:, None])
