"""Where a search begins that has nothing but a few named points."""
from __future__ import annotations

from functools import partial

import numpy as np

from scanprep.geometry import rotations
from scanprep.geometry.least_squares import Dense, levenberg_marquardt, normal_equations

from ..priors import GaussianPrior, typical_poses
from . import energy
from .bodies import FixedBody, Follow

ANNEALING = (10.0, 3.0, 1.0)         # weight of the pose prior: first near the usual poses, then free


def search(body: FixedBody, follow: Follow, targets: np.ndarray, sd: float, prior: GaussianPrior, axes: int
           ) -> tuple[np.ndarray, np.ndarray]:
    """Likely bodies that bring points to their targets, from many starts at once.

    `follow` x (B, P) -> L moving points; `targets` (L, 3), metres, naN where there is none; at least 3 are needed;
    `sd`, metres, how far a point may be from its target.
    Returns (n, P), unknowns of every start, best first; betas stay zero; (n,), their energies.
    """
    poses = typical_poses(body.pose_mean, body.pose_covariance, axes)
    x = np.concatenate([_placed(body, follow, targets, pose) for pose in poses])
    weights = np.full(len(targets), sd**-2)
    still = np.zeros(x.shape[1])
    still[body.n_angles + 3:] = 1e6

    def equations(x: np.ndarray, stiff: float) -> Dense:
        return normal_equations([energy.point_to_point(follow(x), targets, weights), energy.pose_prior(x, prior, stiff),
                                 energy.stay_near(x, 0 * x, still)])

    for stiff in ANNEALING:
        end = levenberg_marquardt(partial(equations, stiff=stiff), x, 8, 1e-3)
        x = end.x
    order = np.argsort(end.energy)
    return x[order], end.energy[order]


def distinct(places: np.ndarray, count: int, apart: float = 0.02) -> list[int]:
    """The first `count` of the bodies (n, L, 3) that differ from those before, by mean distance in metres."""
    kept: list[int] = []
    for i, place in enumerate(places):
        if len(kept) == count:
            break
        if (np.linalg.norm(place - places[kept], axis=2).mean(axis=1) > apart).all():
            kept.append(i)
    return kept


def _placed(body: FixedBody, follow: Follow, targets: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Unknowns (4, P) of a pose laid on the targets, and turned by quarters about their long axis."""
    there = ~np.isnan(targets).any(axis=1)
    goal = targets[there]
    centre = goal.mean(axis=0)

    def here(placed: np.ndarray) -> np.ndarray:
        return follow(body.join(placed, np.zeros(3))[None]).positions[0, there]

    axis = np.linalg.svd(goal - centre)[2][0]
    R, _ = rotations.procrustes(here(pose), goal)
    out = []
    for quarter in range(4):
        placed = pose.copy()
        placed[0] = rotations.log(rotations.exp(quarter * np.pi / 2 * axis) @ R @ rotations.exp(pose[0]))
        out.append(body.join(placed, centre - here(placed).mean(axis=0)))
    return np.array(out)
