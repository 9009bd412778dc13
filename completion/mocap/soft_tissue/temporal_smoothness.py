"""Changes of shape that are steady in time: all frames of a window at once, one banded system."""
from __future__ import annotations

import numpy as np

from scanprep.geometry.sparse import overlapping_windows, solve_smooth

from ..pose.marked_body import BATCH
from .equations import SwayingBody

WINDOW, OVERLAP = 400, 40            # frames solved at once, and those that each side lends to its neighbour


def steady_changes(body: SwayingBody, x: np.ndarray, targets: np.ndarray, weights: np.ndarray, steadiness: float
                   ) -> np.ndarray:
    """The changes z (T, K) of frames that follow each other, poses held, with constant velocity of z as prior.

    Minimised is what the markers say, |z|² and `steadiness` times the squared second difference of z over time. Where
    markers say little it is a low-pass filter; the poses were found with changes free of each other, and filtering
    these hardly moves a marker.

    Parameters
    ----------
    body : SwayingBody
    x : (T, P) float
        T at least 3.
    targets : (T, L, 3) float, metres
        NaN where a marker was not seen.
    weights : (T, L) float
        Factor on the squared distance.
    steadiness : float
    """
    z, eye = np.empty((len(x), body.n_betas)), np.eye(body.n_betas)
    for near, kept, where in overlapping_windows(len(x), WINDOW, OVERLAP):
        gradient = np.empty((near.stop - near.start, body.n_betas))
        hessian = np.empty((*gradient.shape, body.n_betas))
        for first in range(0, len(gradient), BATCH):
            some = slice(near.start + first, min(near.stop, near.start + first + BATCH))
            mine = slice(first, first + BATCH)
            gradient[mine], hessian[mine] = body.change_system(x[some], targets[some], weights[some])
        z[where] = -solve_smooth(hessian + eye, steadiness, gradient)[kept]
    return z
