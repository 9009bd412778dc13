"""Initialisation of the fit to a scan: bodies that meet the landmarks, or typical poses in all orientations."""
from __future__ import annotations

import numpy as np

from scanprep import find_correspondences
from scanprep.geometry import rotations
from scanprep.geometry.farthest_points import farthest_points
from scanprep.geometry.least_squares import normal_equations

from ..priors import GaussianPrior, typical_poses
from . import energy
from .bodies import FixedBody, Follow
from .named_points import distinct_bodies, search_bodies
from .scan import ScanPoints, spread_points
from .scan_fit import EVIDENCE, ScanFit
from .upright import SPREAD, SPREAD_OF_MANY

AXES = 4                             # principal directions of the training poses from which a landmark search starts
COARSE = (0.25, 0.2, 0.15, 0.12, 0.1)    # metres: largest match distance of the first rounds, on few points
FINALISTS, ELSEWHERE = 4, 0.2        # starts that go through all these rounds, and metres by which they differ
VERTICES, POINTS = 500, 120          # vertices and scan points by which all orientations or random poses are compared
PROMISING, STANDING = 0.4, 0.15      # share of placements, with the least free-space violation, that go on
AT_ONCE = 1000                       # points that are compared at a time, so that they stay in the cache
BLIND, APART = 24, 0.08              # starts without landmarks, and metres by which they differ on average


def first_starts(fit: ScanFit, few: ScanFit) -> np.ndarray:
    """Find bodies (n, P) to start from: from the landmarks, or from typical poses with fewer than three landmarks.

    `few` is the same fit with few vertices, which judges the starts.
    """
    if len(fit.vertices) < 3:
        return from_nothing(few)
    marked = from_landmarks(fit, few, fit.vertices, fit.points, fit.config.landmark_sd)
    if not fit.config.correspondences:
        return marked
    pairs = find_correspondences(fit.body.template, fit.cloud.points, (fit.vertices, fit.points))
    # 5 cm: correspondences are so inaccurate, and their errors depend on each other
    more = from_landmarks(fit, few, pairs.template_vertices, pairs.scan_points, 0.05)
    return np.concatenate([more, marked])


def going_on(fit: ScanFit, factor: float, pose: np.ndarray, trans: np.ndarray, betas: np.ndarray | None) -> np.ndarray:
    """Start from an earlier fit of the scan: unknowns (1, P) of pose (J, 3), trans (3,), and betas where known.

    The pose and place are those of the body at its own size; the fit has it larger by a factor.
    """
    origin = fit.body.subject.origin
    x = fit.body.join(pose[None], (factor * (origin + trans) - origin if factor != 1 else trans)[None])
    if fit.body.n_betas and betas is not None:
        x[:, fit.body.n_angles + 3:] = betas
    return x


def from_landmarks(fit: ScanFit, few: ScanFit, vertices: np.ndarray, points: np.ndarray, sd: float) -> np.ndarray:
    """Find the likeliest distinct bodies (n, P) of mean shape that meet landmarks (L,), (L, 3) within `sd` metres."""
    mean = np.zeros(fit.body.n_angles + 3 + fit.body.n_betas)
    body = fit.body.fix_shape(mean)
    follow = body.follow(vertices, mean)
    x, _ = search_bodies(body, follow, points, sd, fit.prior, AXES)
    # three candidates go on to the scan, each with random poses that the landmarks leave open
    candidates = 3
    x = x[distinct_bodies(body.subject.points(few.ids[few.sample.spread]).evaluate(*body.split(x)[:2]), candidates)]
    drawn = np.concatenate([x, *(sample_around(body, follow, start, points, sd, fit.prior, fit.config.random_starts,
                                               fit.rng)
                                 for start in x)])
    drawn = np.hstack([drawn, np.zeros((len(drawn), fit.body.n_betas))])
    drawn = drawn[np.argsort(coarse_cost(few, drawn))]
    return drawn[distinct_bodies(sample_vertices(few, drawn), candidates)]


def coarse_cost(fit: ScanFit, x: np.ndarray) -> np.ndarray:
    """Compute how badly bodies (n, P) explain the scan, on very few points and without self-contact."""
    scan, ids = fit.cloud.thin(POINTS), spread_points(fit.body.template.vertices[fit.ids], VERTICES)
    places, normals = fit.pose_points(ids, *fit.body.split(x)[:2])
    apart = np.array([_distances(y, n, np.eye(3)[None], np.zeros((1, 3)), scan)[0]
                      for y, n in zip(places, normals, strict=True)])
    if fit.data.outside is not None:
        apart += fit.config.free_space_weight * (fit.data.outside.at(places)**2).mean(axis=1)
    unlikely = sum(term.energy for term in fit.prior_terms(x).values())
    return EVIDENCE / fit.config.scan_sd**2 * apart + unlikely


def sample_around(body: FixedBody, follow: Follow, x: np.ndarray, targets: np.ndarray, sd: float, prior: GaussianPrior,
                  count: int, rng: np.random.Generator) -> np.ndarray:
    """Draw unknowns (count, P) around the optimum x (P,) of landmarks and pose prior, by Laplace's approximation.

    That is the normal distribution whose precision is the Gauss-Newton matrix.
    """
    weights = np.full(len(targets), sd**-2)
    terms = [energy.point_to_point(follow(x[None]), targets, weights), energy.pose_prior_term(x[None], prior)]
    free = body.n_angles + 3
    precision = normal_equations(terms).hessian[0, :free, :free] + 1e-6 * np.eye(free)
    drawn = np.repeat(x[None], count, axis=0)
    drawn[:, :free] += np.linalg.solve(np.linalg.cholesky(precision).T, rng.normal(size=(free, count))).T
    return drawn


def best_starts(fit: ScanFit, starts: np.ndarray) -> np.ndarray:
    """Refine starts (n, P) by a few rounds on few points; return the best, best first.

    The worst drop out early. While there are many, the shape is held.
    """
    ends, free = np.array(starts), fit.body.n_angles + 3
    if len(ends) > FINALISTS:
        held = fit.fix_shape(ends[0])
        # 12 starts go on after the first round: on 14 half views the result was that of all 24
        for reach, left in zip(COARSE[:2], (len(ends), 12), strict=True):
            ends = ends[:left]
            ends[:, :free] = [approach(held, x[:free], (reach,)) for x in ends]
            ends = ends[np.argsort([held.misfit(x[:free]) for x in ends], kind="stable")]
        ends = ends[distinct_bodies(sample_vertices(fit, ends), FINALISTS, ELSEWHERE)]
        ends = np.array([approach(fit, x, COARSE[2:]) for x in ends])
    else:
        ends = np.array([approach(fit, x) for x in ends])
    ends = ends[np.argsort([fit.misfit(x) for x in ends], kind="stable")]
    return ends[distinct_bodies(sample_vertices(fit, ends), FINALISTS, ELSEWHERE)]


def sample_vertices(fit: ScanFit, x: np.ndarray) -> np.ndarray:
    """Compute some vertices (n, L, 3) of bodies (n, P), all in one shape, to compare them."""
    return fit.body.subject.points(fit.sample.spread).evaluate(*fit.body.split(x)[:2])


def approach(fit: ScanFit, x: np.ndarray, reaches: tuple[float, ...] = COARSE) -> np.ndarray:
    """Refine unknowns (P,) by a few rounds on few points."""
    for reach in reaches:
        # two steps for each matching
        x, _ = fit.step(x, fit.coarse, reach, 2)
    return x


def from_nothing(fit: ScanFit) -> np.ndarray:
    """Find the likeliest distinct bodies (n, P) for a scan without landmarks, best first.

    Typical poses in all orientations, or upright ones where up is known, are placed on the scan. They are compared with
    its points and with the free space that its cameras saw.
    """
    x, _ = placements(fit)
    return x[distinct_bodies(sample_vertices(fit, x), BLIND, APART)]


def starting_poses(fit: ScanFit) -> np.ndarray:
    """Choose poses (M, J, 3) to try: known ones, or steps along the principal directions of the Gaussian."""
    body = fit.body
    if not len(body.known_poses):
        return typical_poses(body.pose_mean, body.pose_covariance, AXES)
    mean = body.pose_mean.copy()
    mean[0] = 0
    # at most 100, as different as possible
    return pick_varied(np.concatenate([mean[None], body.known_poses]), 100)


def pick_varied(poses: np.ndarray, count: int) -> np.ndarray:
    """Pick `count` poses (M, J, 3) that differ most from one another, the first among them."""
    return poses if len(poses) <= count else poses[farthest_points(poses.reshape(len(poses), -1), count, 0)]


def all_rotations(count: int) -> np.ndarray:
    """Spread rotations (count, 3, 3) evenly, with no axis preferred: quaternions on super-Fibonacci spirals."""
    i = np.arange(count) + 0.5
    r, R = np.sqrt(i / count), np.sqrt(1 - i / count)
    a, b = 2 * np.pi * i / np.sqrt(2), 2 * np.pi * i / 1.533751168755204288118041
    x, y, z, w = r * np.sin(a), r * np.cos(a), R * np.sin(b), R * np.cos(b)
    return np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
                     2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
                     2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], axis=1).reshape(-1, 3, 3)


def placements(fit: ScanFit) -> tuple[np.ndarray, np.ndarray]:
    """Place all poses in all orientations on the scan; return the best 200 unknowns (n, P) and costs, best first."""
    body = fit.body
    poses, (turns, lift, up) = starting_poses(fit), candidate_rotations(fit)
    scan, ids = fit.cloud.thin(POINTS), spread_points(body.template.vertices[fit.ids], VERTICES)
    places, normals = fit.pose_points(ids, poses)
    toward = np.array([camera.viewpoint - scan.points.mean(axis=0) for camera in fit.data.cameras]).reshape(-1, 3)
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    shift = np.array([_laid(y, n, turns, toward, scan.points) if up is None else
                      _stood(y, n, turns, lift, toward, scan.points, up)
                      for y, n in zip(places, normals, strict=True)])

    # first on a third of the vertices and points: least free-space violation, then nearest to the scan
    third = (places[:, ::3], normals[:, ::3])
    cost = free_space_cost(fit, third[0], turns, shift, np.ones(shift.shape[:2], dtype=bool))
    share = PROMISING if fit.upright is None else STANDING
    likely = cost <= (np.quantile(cost, share) if fit.data.outside is not None else np.inf)
    cost[~likely] = np.inf
    cost[likely] += distance_cost(*third, turns, shift, scan.some(np.arange(0, len(scan.points), 3)), likely)[likely]

    # then the best 3,000 of these on all points: fifteen times as many as are kept
    fine = 3000
    best = cost <= np.partition(cost, min(fine, cost.size - 1), axis=None)[min(fine, cost.size - 1)]
    best &= np.isfinite(cost)
    whole = free_space_cost(fit, places, turns, shift, best) + distance_cost(places, normals, turns, shift, scan, best)
    cost = np.where(best, whole, np.inf)
    # the best 200 become unknowns
    order = np.argsort(cost, axis=None, kind="stable")[:200]
    which, turn = np.unravel_index(order, cost.shape)
    x = np.array([body.join(_rotate_root(poses[a], turns[b]), np.zeros(3)) for a, b in zip(which, turn, strict=True)])
    stand = body.subject.origin
    x[:, body.n_angles:body.n_angles + 3] = (turns[turn] @ stand) + shift[which, turn] - stand
    return x, cost.ravel()[order]


def free_space_cost(fit: ScanFit, places: np.ndarray, turns: np.ndarray, shift: np.ndarray, asked: np.ndarray
                    ) -> np.ndarray:
    """Compute free-space violations (A, T) of poses (A, L, 3) in orientations (T, 3, 3) at shifts (A, T, 3).

    Only for pairs that are `asked` (A, T).
    """
    table, rough, cost = fit.data.outside, np.swapaxes(turns, 1, 2).astype(np.float32), np.zeros(asked.shape)
    if table is not None:
        for a, y in enumerate(places):
            chosen = asked[a]
            # one product for all turns: (L, 3) with (3, T 3)
            turned = y.astype(np.float32) @ rough[chosen].swapaxes(0, 1).reshape(3, -1)
            out = table.at(turned.reshape(len(y), -1, 3) + shift[a, chosen].astype(np.float32))
            cost[a, chosen] = fit.config.free_space_weight * (out**2).mean(axis=0)
    return cost


def distance_cost(places: np.ndarray, normals: np.ndarray, turns: np.ndarray, shift: np.ndarray, scan: ScanPoints,
                  asked: np.ndarray) -> np.ndarray:
    """Compute mean squared distances (A, T) of the scan to poses in orientations at shifts, for `asked` pairs."""
    cost = np.zeros(asked.shape)
    for a, (y, n) in enumerate(zip(places, normals, strict=True)):
        if asked[a].any():
            cost[a, asked[a]] = _distances(y, n, turns[asked[a]], shift[a, asked[a]], scan)
    return cost


def candidate_rotations(fit: ScanFit) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Choose rotations (T, 3, 3) to try, the height of the body in each (T,), and the direction of height (T, 3).

    Height 0 puts the upper end of the body on that of the scan, 1 the lower end. A body that stands may extend beyond
    the picture. A scan much shorter than the body, without cameras, may be of either half. Otherwise there is no
    direction: centroids are aligned.
    """
    # 600 rotations: about 25 degrees between neighbours
    upright, every = fit.upright, all_rotations(600)
    if upright is not None:
        turns = upright.rotations(all_rotations(SPREAD if len(upright.ups) == 1 else SPREAD_OF_MANY))
        up = upright.ups[np.argmax(turns @ upright.of_body @ upright.ups.T, axis=1)]
        # five heights for a body that stands
        lift = np.linspace(0, 1, 5)
    else:
        extent = np.ptp(fit.body.template.vertices, axis=0)
        off = fit.cloud.points - fit.cloud.points.mean(axis=0)
        length = np.ptp(off @ np.linalg.svd(off[::1 + len(off) // 5000], full_matrices=False)[2][0])
        # a scan shorter than 0.65 of the body's length shows only part of it: half a man had 0.49
        if fit.data.cameras or length > 0.65 * extent.max():
            return every, np.zeros(len(every)), None
        turns, up, lift = every, every[:, :, extent.argmax()], np.array([0, 0.5, 1])
    return np.repeat(turns, len(lift), axis=0), np.tile(lift, len(turns)), np.repeat(up, len(lift), axis=0)


def _facing(n: np.ndarray, turns: np.ndarray, toward: np.ndarray) -> np.ndarray:
    """Find vertices with normals (L, 3) that, when rotated, face a camera in directions (C, 3): 1 or 0, (T, L).

    Without cameras all do.
    """
    if not len(toward):
        return np.ones((len(turns), len(n)))
    # a vertex counts as seen from a cosine of 0.15 on, as scanners lose grazing surfaces
    return np.any([(to @ turns) @ n.T > 0.15 for to in toward], axis=0).astype(float)


def _laid(y: np.ndarray, n: np.ndarray, turns: np.ndarray, toward: np.ndarray, scan: np.ndarray) -> np.ndarray:
    """Compute shifts (T, 3) that put the centroid of the vertices that face a camera on that of a scan (m, 3)."""
    facing = _facing(n, turns, toward)
    shown = facing @ y / np.maximum(facing.sum(axis=1, keepdims=True), 1)
    return scan.mean(axis=0) - (turns @ shown[:, :, None])[..., 0]


def _stood(y: np.ndarray, n: np.ndarray, turns: np.ndarray, lift: np.ndarray, toward: np.ndarray, scan: np.ndarray,
           up: np.ndarray) -> np.ndarray:
    """Compute shifts (T, 3) that raise a body along `up` (T, 3) to height `lift` (T,), then centre it on the scan.

    Only vertices at heights of the scan count for the centre.
    """
    high, own = (scan @ up.T).T, np.einsum("ld,tde,te->tl", y, np.swapaxes(turns, 1, 2), up)
    raised = ((1 - lift) * (high.max(axis=1) - own.max(axis=1)) + lift * (high.min(axis=1) - own.min(axis=1)))
    level = own + raised[:, None]
    shown = _facing(n, turns, toward) * (level < high.max(axis=1, keepdims=True)) * (
        level > high.min(axis=1, keepdims=True))
    centre = (turns @ (shown @ y / np.maximum(shown.sum(axis=1, keepdims=True), 1))[:, :, None])[..., 0]
    apart = scan.mean(axis=0) - centre
    return apart + (raised - np.einsum("td,td->t", apart, up))[:, None] * up


def _distances(y: np.ndarray, n: np.ndarray, turns: np.ndarray, shift: np.ndarray, scan: ScanPoints) -> np.ndarray:
    """Compute mean squared distances (T,) of the scan to one pose in all orientations, by positions and normals."""
    points, directions = (scan.points - shift[:, None]) @ turns, scan.normals @ turns
    normals = 0.1  # metres: weight of a unit difference of normals
    ask = np.concatenate([points, normals * directions], axis=2).reshape(-1, 6).astype(np.float32)
    have = np.hstack([y, normals * n]).astype(np.float32)
    # |a - b|² = |a|² + (|b|², b)·(1, -2 a); a piece at a time, so that it stays in the cache
    have = np.hstack([(have**2).sum(axis=1, keepdims=True), have])
    other = np.hstack([np.ones_like(ask[:, :1]), -2 * ask])
    nearest = np.concatenate([(have @ piece.T).min(axis=0)
                              for piece in np.array_split(other, 1 + len(other) // AT_ONCE)]) + (ask**2).sum(axis=1)
    # distances beyond 15 cm are all equally bad
    return np.minimum(nearest, 0.15**2).reshape(len(turns), len(scan.points)).mean(axis=1)


def _rotate_root(pose: np.ndarray, R: np.ndarray) -> np.ndarray:
    out = pose.copy()
    out[0] = rotations.log(R @ rotations.exp(pose[0]))
    return out
