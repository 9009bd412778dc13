"""Changes of shape that are steady in time: all frames of a window at once, one banded system."""
from __future__ import annotations

import numpy as np

from ..pose.marked_body import BATCH
from ..pose.smooth import solve_banded
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
    T, K = len(x), body.n_betas
    z = np.empty((T, K))
    D = np.array([1.0, -2.0, 1.0])
    for start in range(0, T, WINDOW):
        near = slice(max(0, min(start - OVERLAP, T - 3)), min(T, start + WINDOW + OVERLAP))
        n = near.stop - near.start
        gradient, hessian = np.empty((n, K)), np.empty((n, K, K))
        for first in range(0, n, BATCH):
            some = slice(near.start + first, min(near.stop, near.start + first + BATCH))
            mine = slice(first, first + BATCH)
            gradient[mine], hessian[mine] = body.change_system(x[some], targets[some], weights[some])
        band = np.zeros((3, n, K))                   # of a frame with itself, the next and the one after
        band[0] = 1.0
        for i in range(3):
            for j in range(i, 3):
                band[j - i, i:n - 2 + i] += steadiness * D[i] * D[j]
        kept = slice(start - near.start, min(start + WINDOW, T) - near.start)
        z[start:start + WINDOW] = -solve_banded(hessian, band, gradient)[kept]
    return z
