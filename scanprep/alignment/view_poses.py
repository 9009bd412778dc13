"""Find rough camera poses from shared landmarks or from shape alone, and measure how well views agree."""
from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial import cKDTree

from ..geometry import rotations
from ..geometry.farthest_points import thin
from ..geometry.mesh import Mesh
from ..geometry.remeshing import smooth_taubin
from ..geometry.surface import OrientedPoints, SeenSpace
from .icp import landmark_motion, transform

REACH = 1 / 18                # radius of described neighbourhoods, in extents of a view: 10 cm on a person


def place_by_landmarks(landmarks: Sequence[Mapping[str, np.ndarray]], count: int) -> np.ndarray:
    """Find motions (V, 4, 4) that bring landmarks of the same name together; the first view stays.

    Views are added one by one. Each must share at least three landmarks, not on one line, with the views before it.
    Then all are moved in turn onto the mean positions of their landmarks.
    """
    if len(landmarks) != count:
        raise ValueError(f"landmarks: expected one mapping for each of {count} views, got {len(landmarks)}")
    # table of landmarks (V, L, 3), NaN where a view does not see one
    names = sorted(set().union(*landmarks)) if count else []
    points = np.full((count, len(names), 3), np.nan)
    for view, marks in enumerate(landmarks):
        for name, point in marks.items():
            points[view, names.index(name)] = point
    seen = np.isfinite(points).all(axis=2)
    T = np.tile(np.eye(4), (count, 1, 1))
    placed = [0]
    while len(placed) < count:
        # next: the view that shares most landmarks with those already placed
        rest = [view for view in range(count) if view not in placed]
        known = seen[placed].any(axis=0)
        view = max(rest, key=lambda v: int((seen[v] & known).sum()))
        shared = seen[view] & known
        there = points[view][shared]
        if len(there) < 3 or np.linalg.matrix_rank(there - there.mean(axis=0), tol=1e-3) < 2:
            raise ValueError(f"landmarks: view {view} shares {shared.sum()} with the views placed before it; "
                             "expected at least three that are not on one line")
        T[view] = landmark_motion(points[view][shared], _means(T[placed], points[placed])[shared])
        placed.append(view)
    # alternate mean landmarks and rigid fits; fifty rounds settle it
    for _ in range(50):
        means = _means(T, points)
        for view in range(1, count):
            good = seen[view] & (seen.sum(axis=0) > 1)
            T[view] = landmark_motion(points[view][good], means[good])
    return T


def fit_of_views(views: Sequence[tuple[Mesh, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Measure which share (V,) of each view another view also saw, and which share (V,) violates free space of another.

    Two views agree on a point if their surfaces face the same way and are at most 1 cm apart. They conflict if one sees
    through a point of the other, more than 2 cm in front of its own surface.
    """
    rng = np.random.default_rng(0)
    chosen = [rng.permutation(len(mesh.vertices))[:2000] for mesh, _ in views]
    targets = [OrientedPoints(mesh.vertices, mesh.vertex_normals) for mesh, _ in views]
    overlap, conflict = np.zeros(len(views)), np.zeros(len(views))
    for number, (mesh, _) in enumerate(views):
        rows = chosen[number]
        others = [k for k in range(len(views)) if k != number]
        if not others or not len(rows):
            continue
        p, n = mesh.vertices[rows], mesh.vertex_normals[rows]
        overlap[number] = np.mean(np.any([targets[k].match(p, n, 0.01, 0.5).valid for k in others], axis=0))
        conflict[number] = np.mean(SeenSpace([views[k] for k in others]).ahead(p) > 0.02)
    return overlap, conflict


def _means(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Average the moved landmarks (L, 3) over the views that see them; NaN where none does."""
    moved = np.einsum("vij,vlj->vli", T[:, :3, :3], points) + T[:, None, :3, 3]
    seen = np.isfinite(moved).all(axis=2, keepdims=True)
    total = np.where(seen, moved, 0).sum(axis=0)
    return np.asarray(np.where(seen.any(axis=0), total / np.maximum(seen.sum(axis=0), 1), np.nan))


def place_by_features(views: list[tuple[Mesh, np.ndarray]], rng: np.random.Generator) -> np.ndarray:
    """Find motions (V, 4, 4) of views from their shapes alone.

    Point features (histograms of angles between normals) are matched between all pairs of views. Triples of matches
    propose motions, as in RANSAC. Motions are scored by how much surface agrees and how much violates free space. The
    best pairs are chained from the first view. The result may be wrong where views overlap little: see `trusted` of
    `AlignedViews`.
    """
    extent = float(max(np.ptp(mesh.vertices, axis=0).max() for mesh, _ in views))
    described = [_describe(mesh, extent) for mesh, _ in views]
    count = len(views)
    pairs = {(i, j): _place(described[i], described[j], views[i], views[j], extent, rng)
             for i in range(count) for j in range(i)}
    # chain the pairs from the first view on, best score first
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


def _describe(mesh: Mesh, extent: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute points (n, 3) spread over a view, their normals, and a feature histogram (n, 33) each (FPFH)."""
    even = smooth_taubin(mesh, 10)
    rows = thin(even.vertices, extent / 120)
    p, n = even.vertices[rows], even.vertex_normals[rows]
    a, b = cKDTree(p).query_pairs(REACH * extent, output_type="ndarray").T
    a, b = np.r_[a, b], np.r_[b, a]
    # Darboux frame (n, v, w) of each pair, and the three angles that describe the other normal in it
    across = p[b] - p[a]
    far = np.linalg.norm(across, axis=1)
    across /= far[:, None]
    v = np.cross(n[a], across)
    v /= np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-9)
    w = np.cross(n[a], v)
    alpha = np.einsum("nd,nd->n", v, n[b])
    phi = np.einsum("nd,nd->n", n[a], across)
    theta = np.arctan2(np.einsum("nd,nd->n", w, n[b]), np.einsum("nd,nd->n", n[a], n[b])) / np.pi
    bins = 11
    # eleven bins per angle; then add the neighbours' histograms, near ones with more weight
    single = np.zeros((len(p), 3 * bins))
    for k, value in enumerate((alpha, phi, theta)):
        place = np.clip(((value + 1) / 2 * bins).astype(int), 0, bins - 1) + k * bins
        np.add.at(single, (a, place), 1)
    single /= np.maximum(single.sum(axis=1, keepdims=True), 1)
    total = single.copy()
    np.add.at(total, a, single[b] * (0.2 * REACH * extent / (0.2 * REACH * extent + far))[:, None] / 8)
    return p, n, total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-9)


def _place(source_view: tuple[np.ndarray, np.ndarray, np.ndarray],
           target_view: tuple[np.ndarray, np.ndarray, np.ndarray], view: tuple[Mesh, np.ndarray],
           target: tuple[Mesh, np.ndarray], extent: float, rng: np.random.Generator) -> tuple[float, np.ndarray]:
    """Find the best motion of one view onto another; return its score and the motion."""
    p, n, f = source_view
    q, m, g = target_view
    # three best matches per point; triples with equal side lengths that are not too short propose motions
    match = cKDTree(g).query(f, k=3)[1]
    source, goal = np.repeat(np.arange(len(p)), 3), match.ravel()
    draws = rng.integers(len(source), size=(30_000, 3))
    x, y = p[source[draws]], q[goal[draws]]
    side_x, side_y = (np.linalg.norm(z - np.roll(z, 1, axis=1), axis=2) for z in (x, y))
    rigid = (np.minimum(side_x, side_y) > 0.9 * np.maximum(side_x, side_y)).all(axis=1)
    rigid &= side_x.min(axis=1) > REACH * extent
    x, y = x[rigid], y[rigid]
    best: tuple[float, np.ndarray] = (-np.inf, np.eye(4))
    if not len(x):
        return best
    # rank motions by how many of 1500 matches they satisfy, within a sixtieth of the extent and 45 degrees
    R, t = rotations.procrustes(x[:4000], y[:4000])
    sample = rng.permutation(len(source))[:1500]
    a, b, na, nb = p[source[sample]], q[goal[sample]], n[source[sample]], m[goal[sample]]
    hits = np.array([((np.linalg.norm(a @ r.T + s - b, axis=1) < extent / 60)
                      & (np.einsum("nd,nd->n", na @ r.T, nb) > 0.7)).sum() for r, s in zip(R, t, strict=True)])
    # refine the twelve best; score: share that agrees, minus twice the free-space violation in either direction
    tree, back = OrientedPoints(q, m), SeenSpace([view])
    front = SeenSpace([target])
    for k in np.argsort(-hits)[:12]:
        r, s = _refine(p, n, tree, R[k], t[k], extent)
        agreeing = tree.match(p @ r.T + s, n @ r.T, extent / 120, 0.7).valid.mean()
        through = max(float((front.ahead(p @ r.T + s) > extent / 60).mean()),
                      float((back.ahead((q - s) @ r) > extent / 60).mean()))
        score = float(agreeing) - 2 * through
        if score > best[0]:
            best = score, transform(r, s)
    return best


def _refine(p: np.ndarray, n: np.ndarray, tree: OrientedPoints, R: np.ndarray, t: np.ndarray,
            extent: float) -> tuple[np.ndarray, np.ndarray]:
    """Refine a motion by twelve rounds of point-to-point ICP with falling reach."""
    for reach in extent * np.linspace(1 / 30, 1 / 90, 12):
        match = tree.match(p @ R.T + t, n @ R.T, reach, 0.6)
        good = match.valid
        if good.sum() < 20:
            break
        R, t = rotations.procrustes(p[good], tree.points[match.index[good]])
    return R, t
