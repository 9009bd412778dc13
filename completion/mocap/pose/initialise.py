"""Initialisation of a body: from one frame of markers alone, and again where it has lost a limb."""
from __future__ import annotations

import numpy as np

from model.fitting import energy
from model.fitting.named_points import anneal, lay_on_points
from model.priors import typical_poses

from .marked_body import AnimateConfig, MarkedBody, marker_misfit, marker_weights


def search_pose(body: MarkedBody, targets: np.ndarray, config: AnimateConfig) -> np.ndarray:
    """Find the unknowns (P,) of a frame from its markers (L, 3) alone, metres, at least three of them seen."""
    # typical poses are laid rigidly on the markers, then relaxed with a pose prior that becomes weaker
    x = lay_on_points(body.body, body.positions, typical_poses(body.body.pose_mean, body.body.pose_covariance, axes=6),
                      targets)
    weights, prior = np.full(body.count, config.marker_sd**-2), config.prior_weight
    end = anneal(lambda x, stiff: body.solve(x, targets, weights, 8, 1e-3, stiff / prior if prior else 0.0), x)
    x = end.x[np.argsort(end.energy)[:2]]
    for _ in range(5):                                                  # equal weights at first, then robust ones
        end = body.solve(x, targets, weights, 30, 1e-5)
        x = end.x[np.argmin(end.energy)][None]
        weights, _ = marker_weights(body.positions(x[0]), targets, config.marker_sd, config.outlier)
    return x[0]


def reinitialise_frames(body: MarkedBody, x: np.ndarray, targets: np.ndarray, config: AnimateConfig) -> np.ndarray:
    """Initialise frames (T, P) again that have lost a limb; markers are (T, L, 3), metres.

    A body that is late for a fast limb treats all its markers as outliers. Frames with three markers far off are solved
    again, from their own pose and from the nearest good frames. The best is taken if it clearly fits better.
    """
    apart = _apart(body, x, targets)
    lost = (apart > 2.0 * config.outlier).sum(axis=1) >= 3
    frames, good = np.flatnonzero(lost), np.flatnonzero(~lost)
    if not len(frames) or not len(good):
        return x
    # three starts: the frame itself, and the good frames before and after it with the frame's own root
    after = np.searchsorted(good, frames)
    root = np.r_[0:3, body.body.n_angles:body.n_unknowns]
    starts = [x[frames], x[good[np.maximum(after - 1, 0)]], x[good[np.minimum(after, len(good) - 1)]]]
    for start in starts[1:]:
        start[:, root] = x[np.ix_(frames, root)]
    solutions = np.stack([_from_far(body, start, targets[frames], config) for start in starts])
    misfit = np.stack([marker_misfit(_apart(body, end, targets[frames]), config.outlier) for end in solutions])
    best = misfit.argmin(axis=0)
    better = misfit.min(axis=0) < 0.8 * marker_misfit(apart[frames], config.outlier)
    out = x.copy()
    out[frames[better]] = solutions[best, np.arange(len(frames))][better]
    return out


def _from_far(body: MarkedBody, x: np.ndarray, targets: np.ndarray, config: AnimateConfig) -> np.ndarray:
    """Solve frames from far starts x (n, P), each by itself, while the scale of outliers shrinks."""
    # metres at which a marker has lost three quarters of its weight, from far to near
    for scale in (1.0, 0.3, 0.1):
        weights = energy.geman_mcclure(np.nan_to_num(_apart(body, x, targets)), scale) / config.marker_sd**2
        x = body.solve(x, targets, weights, 8, 1e-3).x
    return x


def _apart(body: MarkedBody, x: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Compute distances (T, L), metres, from markers to their simulated places."""
    return np.linalg.norm(body.positions(x) - targets, axis=2)
