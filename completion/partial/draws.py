"""Poses drawn at random: around what is known, or one limb at a time, and a quick look at how they fit."""
from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from scanprep.geometry.least_squares import normal_equations
from scanprep.geometry.surface import OrientedPoints
from scanprep.skeleton.tree import Skeleton

from .. import energy
from ..bodies import FixedBody, Follow
from ..priors import GaussianPrior, unbranched
from .scan import spread
from .self_intersection import Contact

if TYPE_CHECKING:
    from .fit import ScanFit

LOOSE = 0.1                          # radians around the limb of a training pose
VERTICES = 3000                      # that a quick look takes


def around(body: FixedBody, follow: Follow, x: np.ndarray, targets: np.ndarray, sd: float, prior: GaussianPrior,
           count: int, rng: np.random.Generator) -> np.ndarray:
    """Draws (count, P) of what the landmarks and the pose prior leave open around their optimum x (P,).

    The normal distribution whose precision is the Gauss-Newton matrix (Laplace's approximation).
    """
    weights = np.full(len(targets), sd**-2)
    terms = [energy.point_to_point(follow(x[None]), targets, weights), energy.pose_prior(x[None], prior)]
    free = body.n_angles + 3
    precision = normal_equations(terms).hessian[0, :free, :free] + 1e-6 * np.eye(free)
    drawn = np.repeat(x[None], count, axis=0)
    drawn[:, :free] += np.linalg.solve(np.linalg.cholesky(precision).T, rng.normal(size=(free, count))).T
    return drawn


def limbs(skeleton: Skeleton) -> list[int]:
    """Joints below which hangs a limb without a branch, the largest limbs first."""
    size = skeleton.descends.sum(axis=0)
    starts = [j for run in unbranched(skeleton.parents) for j in run if size[run[-1]] == 1]
    return sorted(starts, key=lambda j: (-size[j], j))


def examples_of(body: FixedBody, x: np.ndarray, root: int, count: int, rng: np.random.Generator) -> np.ndarray:
    """Draws (count or none, P) of the limb at a joint: as it is in the training poses, loosened a little."""
    drawn = np.repeat(x[None], count if len(body.pose_examples) else 0, axis=0)
    if len(drawn):
        parts = np.flatnonzero(body.skeleton.descends[:, root])
        angles = (3 * parts[:, None] + np.arange(3)).ravel()
        which = np.arange(count) % len(body.pose_examples)
        drawn[:, angles] = body.pose_examples.reshape(len(body.pose_examples), -1)[which][:, angles]
        drawn[:, angles] += rng.normal(0, LOOSE, (count, len(angles)))
    return drawn


def redrawn(body: FixedBody, x: np.ndarray, root: int, prior: GaussianPrior, count: int,
            rng: np.random.Generator) -> np.ndarray:
    """Draws (count, P) of the limb at a joint from the prior, given the other joints of x (P,)."""
    parts = np.flatnonzero(body.skeleton.descends[:, root])
    angles = (3 * parts[:, None] + np.arange(3)).ravel()
    precision = prior.whitening.T @ prior.whitening
    others = np.setdiff1d(np.arange(body.n_angles), angles)
    block = precision[np.ix_(angles, angles)]
    pull = precision[np.ix_(angles, others)] @ (x[others] - prior.mean[others])
    drawn = np.repeat(x[None], count, axis=0)
    spreads = np.linalg.solve(np.linalg.cholesky(block).T, rng.normal(size=(len(angles), count))).T
    drawn[:, angles] = prior.mean[angles] - np.linalg.solve(block, pull) + spreads
    return drawn


def near_points(fit: ScanFit, x: np.ndarray, moved: np.ndarray, points: np.ndarray, count: int) -> np.ndarray:
    """Those `count` of the bodies (n, P) whose moved parts come nearest to points (m, 3) that want explaining."""
    ids = fit.spread[np.isin(fit.part[fit.spread], moved)][::2]
    if len(points) < 5 or not len(ids):
        return x[:count]
    pose, trans, _ = fit.body.split(x)
    places = fit.body.subject.points(ids).evaluate(pose, trans)
    some = points[::max(1, len(points) // 40)]
    apart = np.linalg.norm(places[:, :, None] - some, axis=3).min(axis=1)
    return x[np.argsort((np.minimum(apart, 0.15)**2).mean(axis=1))[:count]]


def quick_misfits(fit: ScanFit, x: np.ndarray, moved: np.ndarray | None = None, cap: float = 0.1) -> np.ndarray:
    """How badly bodies (n, P) explain the scan, on few vertices whose normals turn with their parts."""
    body, config = fit.body, fit.config
    ids = spread(body.template.vertices, VERTICES)
    few = slice(None, None, 3)
    contact = Contact(body.skeleton, fit.part[ids[few]])
    pose, trans, _ = body.split(x)
    places = body.subject.points(ids).evaluate(pose, trans)
    R = body.skeleton.part_rotations(pose)[:, fit.part[ids]]
    normals = (R @ body.template.vertex_normals[ids][:, :, None])[..., 0]
    out = np.empty(len(x))
    for i, (y, n) in enumerate(zip(places, normals, strict=True)):
        found = OrientedPoints(y, n).match(fit.coarse.points, fit.coarse.normals, cap, config.min_cosine)
        apart = (np.minimum(found.distances, cap)**2).mean()
        depth = contact.intrusions(y[few], n[few], moved)[0]
        apart += config.contact_weight * (np.minimum(depth, cap)**2).mean()
        if fit.sight is not None:
            excess = fit.sight.trespass(y[few], config.silhouette_tolerance)[0]
            apart += config.silhouette_weight * (np.minimum(excess, cap)**2).mean()
        out[i] = config.evidence * apart / config.scan_sd**2 + fit.unlikely(x[i])
    return out
