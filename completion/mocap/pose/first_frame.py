"""Where a body is that nothing is known of but one frame of markers."""
from __future__ import annotations

from functools import partial

import numpy as np

from model.priors import typical_poses
from scanprep.geometry import rotations
from scanprep.geometry.least_squares import Minimum, levenberg_marquardt

from ...starts import ANNEALING
from .marked_body import MarkedBody
from .robust import marker_weights
from .settings import AnimateConfig

STARTS = 2                           # of a search that are followed to their end
ROUNDS = 5                           # in which outliers of a search are found


def search(body: MarkedBody, targets: np.ndarray, config: AnimateConfig) -> np.ndarray:
    """Unknowns (P,) of a frame from nothing but its markers (L, 3), metres, at least three of them seen.

    As `starts.search`, on the fewer products of the markers; then outliers lose their weight.
    """
    x = _laid_on(body, typical_poses(body.body.pose_mean, body.body.pose_covariance, config.start_axes), targets)
    weights = np.full(body.count, config.marker_sd**-2)
    for stiff in ANNEALING:
        end = _solved(body, x, targets, weights, stiff / config.prior_weight if config.prior_weight else 0.0,
                      iterations=8, tolerance=1e-3)
        x = end.x
    x = x[np.argsort(end.energy)[:STARTS]]
    for _ in range(ROUNDS):                                             # with all markers, then with the likely ones
        end = _solved(body, x, targets, weights)
        x = end.x[np.argmin(end.energy)][None]
        weights, _ = marker_weights(body.positions(x[0]), targets, config.marker_sd, config.outlier)
    return x[0]


def _solved(body: MarkedBody, x: np.ndarray, targets: np.ndarray, weights: np.ndarray, stiff: float = 1.0,
            iterations: int = 30, tolerance: float = 1e-5) -> Minimum[np.ndarray]:
    """All starts (n, P) on the same markers; `stiff` is a factor on the pose prior."""
    system = partial(body.system, targets=np.broadcast_to(targets, (len(x), *targets.shape)),
                     weights=np.broadcast_to(weights, (len(x), len(weights))), stiff=stiff)
    return levenberg_marquardt(system, x, iterations, tolerance, retract=body.retract)


def _laid_on(body: MarkedBody, poses: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Unknowns (4 n, P) of poses (n, J, 3) laid on the markers, and turned by quarters about their long axis."""
    there = ~np.isnan(targets[:, 0])
    goal = targets[there]
    centre = goal.mean(axis=0)
    axis = np.linalg.svd(goal - centre)[2][0]
    rest = body.positions(body.body.join(poses, np.zeros((len(poses), 3))))[:, there]
    R, _ = rotations.procrustes(rest, np.broadcast_to(goal, rest.shape))
    quarters = rotations.exp(np.arange(4)[:, None] * np.pi / 2 * axis)
    placed = np.repeat(poses, 4, axis=0)
    placed[:, 0] = rotations.log(quarters @ (R @ rotations.exp(poses[:, 0]))[:, None]).reshape(-1, 3)
    x = body.body.join(placed, np.zeros((len(placed), 3)))
    x[:, -3:] = centre - body.positions(x)[:, there].mean(axis=1)
    return x
