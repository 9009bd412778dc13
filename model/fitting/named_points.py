"""Initialisation of a body from a few named points (landmarks or markers)."""
from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from scanprep.geometry import rotations
from scanprep.geometry.least_squares import Dense, Minimum, levenberg_marquardt, normal_equations

from ..priors import GaussianPrior, typical_poses
from . import energy
from .bodies import FixedBody, Follow


def search_bodies(body: FixedBody, follow: Follow, targets: np.ndarray, sd: float, prior: GaussianPrior, axes: int
                  ) -> tuple[np.ndarray, np.ndarray]:
    """Find likely bodies that bring points to their targets, from many starts at once.

    `follow` maps unknowns (B, P) to L moving points. `targets` (L, 3), metres, are NaN where there is none; at least 3
    are needed. `sd`, metres, is how far a point may be from its target. Returns the unknowns (n, P) of all starts, best
    first, with betas of zero, and their energies (n,).
    """
    poses = typical_poses(body.pose_mean, body.pose_covariance, axes)
    x = lay_on_points(body, lambda x: follow(x).positions, poses, targets)
    weights = np.full(len(targets), sd**-2)
    # betas are held at zero by a weight that nothing can overcome
    still = np.zeros(x.shape[1])
    still[body.n_angles + 3:] = 1e6

    def equations(x: np.ndarray, stiff: float) -> Dense:
        return normal_equations([energy.point_to_point(follow(x), targets, weights),
                                 energy.pose_prior_term(x, prior, stiff),
                                 energy.stay_near(x, 0 * x, still)])

    end = anneal(lambda x, stiff: levenberg_marquardt(partial(equations, stiff=stiff), x, 8, 1e-3), x)
    order = np.argsort(end.energy)
    return end.x[order], end.energy[order]


def anneal(solve: Callable[[np.ndarray, float], Minimum[np.ndarray]], x: np.ndarray) -> Minimum[np.ndarray]:
    """Solve repeatedly with a falling weight of the pose prior, each time from the last result.

    `solve` takes unknowns (n, P) and the weight of the pose prior.
    """
    # ten times, then three times, then exactly the prior: first near usual poses, then free
    for stiff in (10.0, 3.0, 1.0):
        end = solve(x, stiff)
        x = end.x
    return end


def lay_on_points(body: FixedBody, positions: Callable[[np.ndarray], np.ndarray], poses: np.ndarray, targets: np.ndarray
                  ) -> np.ndarray:
    """Align poses (n, J, 3) with the targets, and turn each by quarters about the targets' long axis: (4 n, P).

    `positions` maps unknowns (B, P) to points (B, L, 3), whose targets (L, 3), metres, are NaN where there is none.
    """
    there = ~np.isnan(targets).any(axis=1)
    goal = targets[there]
    centre = goal.mean(axis=0)
    rest = positions(body.join(poses, np.zeros((len(poses), 3))))[:, there]
    R, _ = rotations.procrustes(rest, np.broadcast_to(goal, rest.shape))
    quarters = rotations.exp(np.arange(4)[:, None] * np.pi / 2 * np.linalg.svd(goal - centre)[2][0])
    turned = np.repeat(poses, 4, axis=0)
    turned[:, 0] = rotations.log(quarters @ (R @ rotations.exp(poses[:, 0]))[:, None]).reshape(-1, 3)
    x = body.join(turned, np.zeros((len(turned), 3)))
    x[:, body.n_angles:body.n_angles + 3] = centre - positions(x)[:, there].mean(axis=1)
    return x


def distinct_bodies(places: np.ndarray, count: int, apart: float = 0.02) -> list[int]:
    """Find the first `count` of the bodies (n, L, 3) that differ from all kept ones by a mean distance, metres."""
    kept: list[int] = []
    for i, place in enumerate(places):
        if len(kept) == count:
            break
        if (np.linalg.norm(place - places[kept], axis=2).mean(axis=1) > apart).all():
            kept.append(i)
    return kept
