"""Rough camera poses from the shapes of the views alone."""
from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ..geometry import rotations
from ..geometry.mesh import Mesh
from ..geometry.remeshing import smooth
from ..geometry.seen_space import SeenSpace
from ..geometry.surface import OrientedPoints

SPACING, REACH, BINS = 1 / 120, 1 / 18, 11      # shares of a view's extent: between described points; described
INLIER, NEAR, THROUGH = 1 / 60, 1 / 120, 1 / 60
DRAWS, PROPOSALS, JUDGES, TRIED, ICP_ROUNDS = 30_000, 4000, 1500, 12, 12


def place_by_features(views: list[tuple[Mesh, np.ndarray]], rng: np.random.Generator) -> np.ndarray:
    """Motions of views that bring alike shapes together where no view then looks through another.

    Histograms of the angles between normals around points are compared between all pairs of views, three matches
    at a time propose a motion, and motions are judged by how much surface agrees and how much one view looks
    through the other. The best pairs are chained.

    Parameters
    ----------
    views : list of (Mesh, camera position (3,)) pairs
    rng : numpy.random.Generator

    Returns
    -------
    (V, 4, 4) float
        The first view stays. The proposal may be wrong where views overlap little: see `AlignedViews.trusted`.
    """
    extent = float(max(np.ptp(mesh.vertices, axis=0).max() for mesh, _ in views))
    described = [_described(mesh, extent) for mesh, _ in views]
    count = len(views)
    pairs = {(i, j): _place(described[i], described[j], views[i], views[j], extent, rng)
             for i in range(count) for j in range(i)}
    T, placed = np.tile(np.eye(4), (count, 1, 1)), {0}
    while len(placed) < count:
        _, i, j = max((score, i, j) for (i, j), (score, _) in pairs.items() if (i in placed) != (j in placed))
        motion = pairs[i, j][1]                                # of view i, into the frame of view j
        if j in placed:
            T[i] = T[j] @ motion
        else:
            T[j] = T[i] @ np.linalg.inv(motion)
        placed |= {i, j}
    return T


def _described(mesh: Mesh, extent: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (n, 3) spread over a view, their normals, and a histogram (n, 33) for each."""
    even = smooth(mesh, 10)
    rows = np.unique(np.floor(even.vertices / (SPACING * extent)).astype(np.int64), axis=0, return_index=True)[1]
    p, n = even.vertices[rows], even.vertex_normals[rows]
    a, b = cKDTree(p).query_pairs(REACH * extent, output_type="ndarray").T
    a, b = np.r_[a, b], np.r_[b, a]
    across = p[b] - p[a]
    far = np.linalg.norm(across, axis=1)
    across /= far[:, None]
    v = np.cross(n[a], across)
    v /= np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-9)
    w = np.cross(n[a], v)
    alpha = np.einsum("nd,nd->n", v, n[b])
    phi = np.einsum("nd,nd->n", n[a], across)
    theta = np.arctan2(np.einsum("nd,nd->n", w, n[b]), np.einsum("nd,nd->n", n[a], n[b])) / np.pi
    single = np.zeros((len(p), 3 * BINS))
    for k, value in enumerate((alpha, phi, theta)):
        place = np.clip(((value + 1) / 2 * BINS).astype(int), 0, BINS - 1) + k * BINS
        np.add.at(single, (a, place), 1)
    single /= np.maximum(single.sum(axis=1, keepdims=True), 1)
    total = single.copy()
    np.add.at(total, a, single[b] * (0.2 * REACH * extent / (0.2 * REACH * extent + far))[:, None] / 8)
    return p, n, total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-9)


def _place(mine: tuple[np.ndarray, np.ndarray, np.ndarray], other: tuple[np.ndarray, np.ndarray, np.ndarray],
           view: tuple[Mesh, np.ndarray], target: tuple[Mesh, np.ndarray], extent: float, rng: np.random.Generator
           ) -> tuple[float, np.ndarray]:
    """The best motion of one view onto another, and its score."""
    p, n, f = mine
    q, m, g = other
    match = cKDTree(g).query(f, k=3)[1]
    source, goal = np.repeat(np.arange(len(p)), 3), match.ravel()
    draws = rng.integers(len(source), size=(DRAWS, 3))
    x, y = p[source[draws]], q[goal[draws]]
    side_x, side_y = (np.linalg.norm(z - np.roll(z, 1, axis=1), axis=2) for z in (x, y))
    rigid = (np.minimum(side_x, side_y) > 0.9 * np.maximum(side_x, side_y)).all(axis=1)
    rigid &= side_x.min(axis=1) > REACH * extent
    x, y = x[rigid], y[rigid]
    best: tuple[float, np.ndarray] = (-np.inf, np.eye(4))
    if not len(x):
        return best
    R, t = rotations.procrustes(x[:PROPOSALS], y[:PROPOSALS])
    some = rng.permutation(len(source))[:JUDGES]
    a, b, na, nb = p[source[some]], q[goal[some]], n[source[some]], m[goal[some]]
    hits = np.array([((np.linalg.norm(a @ r.T + s - b, axis=1) < INLIER * extent)
                      & (np.einsum("nd,nd->n", na @ r.T, nb) > 0.7)).sum() for r, s in zip(R, t, strict=True)])
    tree, back = OrientedPoints(q, m), SeenSpace([view])
    front = SeenSpace([target])
    for k in np.argsort(-hits)[:TRIED]:
        r, s = _refined(p, n, tree, R[k], t[k], extent)
        found = tree.match(p @ r.T + s, n @ r.T, NEAR * extent, 0.7).valid.mean()
        through = max(float((front.ahead(p @ r.T + s) > THROUGH * extent).mean()),
                      float((back.ahead((q - s) @ r) > THROUGH * extent).mean()))
        score = float(found) - 2 * through
        if score > best[0]:
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = r, s
            best = score, T
    return best


def _refined(p: np.ndarray, n: np.ndarray, tree: OrientedPoints, R: np.ndarray, t: np.ndarray,
             extent: float) -> tuple[np.ndarray, np.ndarray]:
    """A motion after a few rounds of point-to-point matching."""
    for reach in extent * np.linspace(1 / 30, 1 / 90, ICP_ROUNDS):
        match = tree.match(p @ R.T + t, n @ R.T, reach, 0.6)
        good = match.valid
        if good.sum() < 20:
            break
        R, t = rotations.procrustes(p[good], tree.points[match.index[good]])
    return R, t
