"""Limbs in the wrong place begin again from random starts, where that explains the scan better."""
from __future__ import annotations

import numpy as np

from model.priors import GaussianPrior
from scanprep.skeleton.tree import Skeleton

from ..bodies import FixedBody
from .fit import ScanFit
from .starts import approach

LOOSE = 0.1                          # radians around the limb of a training pose
REACHES = (0.2, 0.15, 0.1)           # metres, of the rounds after a limb was moved
AMISS = 0.012                        # share of scan or body that may be in the wrong place for no reason
MANY = 6                             # times as many starts of a limb are compared with what is unexplained
PROMISING = 30.0                     # a limb at random may be this much worse before it is fitted
BETTER = 5.0                         # by how much the misfit must fall for a limb to be moved


def reinitialise_limbs(fit: ScanFit, x: np.ndarray) -> np.ndarray:
    """Unknowns (P,) with limbs moved elsewhere where that explains the scan better; the shape is held."""
    if not misplaced(fit, x):
        return x
    free, held = fit.body.n_angles + 3, fit.held(x)
    moved = approach(held, x[:free], REACHES)
    for root in limbs(fit.body.skeleton):
        moved = _reinitialised(held, moved, root)
    return np.concatenate([moved, x[free:]])


def misplaced(fit: ScanFit, x: np.ndarray) -> bool:
    """Whether more than a little of the scan is unexplained, or of the body where nothing can be."""
    return bool(fit.unexplained(x, fit.thin).mean() > AMISS
                or len(fit.violations(fit.mesh(x))[0]) > AMISS * len(fit.spread))


def _reinitialised(fit: ScanFit, x: np.ndarray, root: int) -> np.ndarray:
    """Unknowns (P,) with the limb at a joint as it is, or drawn from the prior and from the training poses."""
    best, count = fit.misfit(x), fit.config.random_starts
    moved = np.flatnonzero(fit.body.skeleton.descends[:, root])
    drawn = np.concatenate([examples_of(fit.body, x, root, MANY * count // 2, fit.rng),
                            redrawn(fit.body, x, root, fit.prior, MANY * count, fit.rng)])
    drawn = drawn[fit.rng.permutation(len(drawn))]
    wanted = fit.coarse.points[fit.unexplained(x, fit.coarse)]
    drawn = np.vstack([near_points(fit, drawn, moved, wanted, count // 3), drawn[:count]])
    quick = fit.quick_misfits(np.vstack([x, drawn]), moved)
    for i in np.argsort(quick[1:])[:2]:
        if quick[i + 1] > quick[0] + PROMISING:
            continue
        tried = approach(fit, drawn[i], REACHES)
        if (misfit := fit.misfit(tried)) < best - BETTER:
            x, best = tried, misfit
    return x


def limbs(skeleton: Skeleton) -> list[int]:
    """Joints below which hangs a limb without a branch, the largest limbs first."""
    size = skeleton.descends.sum(axis=0)
    starts = [j for run in unbranched(skeleton.parents) for j in run if size[run[-1]] == 1]
    return sorted(starts, key=lambda j: (-size[j], j))


def unbranched(parents: np.ndarray) -> list[list[int]]:
    """The limbs of a tree of parts: longest runs without a branch, the root in none."""
    children = [np.flatnonzero(np.asarray(parents) == j) for j in range(len(parents))]
    runs = []
    for j in range(1, len(parents)):
        if parents[j] != 0 and len(children[parents[j]]) == 1:
            continue
        run = [j]
        while len(children[run[-1]]) == 1:
            run.append(int(children[run[-1]][0]))
        runs.append(run)
    return runs


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
