"""Limbs that a body has lost: several of its markers at once are far from where the body puts them."""
from __future__ import annotations

import numpy as np

from scanprep.geometry.least_squares import Dense, levenberg_marquardt

from ... import energy
from .marked_body import MarkedBody
from .robust import misfit
from .settings import AnimateConfig

SEVERAL, FAR = 3, 2.0                # markers of a frame that are so many times an outlier's residual away
SCALES = (1.0, 0.3, 0.1)             # metres, at which a marker has lost three quarters of its weight, in turns
STEPS = 8                            # most for each
BETTER = 0.8                         # share of the misfit that must remain at most


def rescue_limbs(body: MarkedBody, x: np.ndarray, targets: np.ndarray, config: AnimateConfig) -> np.ndarray:
    """Unknowns (T, P) in which frames that had lost a limb have it again.

    A body that follows a fast limb too late takes all its markers for outliers, and never sees them again. So frames
    with several markers far away are solved anew, from what they are and from the joints of the nearest frames without,
    with outliers that keep their weight at first; they are taken where that explains the markers better.

    Parameters
    ----------
    body : MarkedBody
    x : (T, P) float
    targets : (T, L, 3) float, metres
        NaN where a marker was not seen.
    config : AnimateConfig
    """
    apart = _apart(body, x, targets)
    lost = (apart > FAR * config.outlier).sum(axis=1) >= SEVERAL
    frames, good = np.flatnonzero(lost), np.flatnonzero(~lost)
    if not len(frames) or not len(good):
        return x
    after = np.searchsorted(good, frames)
    root = np.r_[0:3, body.body.n_angles:body.n_unknowns]
    starts = [x[frames], x[good[np.maximum(after - 1, 0)]], x[good[np.minimum(after, len(good) - 1)]]]
    for start in starts[1:]:
        start[:, root] = x[np.ix_(frames, root)]
    found = np.stack([_from_far(body, start, targets[frames], config) for start in starts])
    left = np.stack([misfit(_apart(body, end, targets[frames]), config.outlier) for end in found])
    best = left.argmin(axis=0)
    better = left.min(axis=0) < BETTER * misfit(apart[frames], config.outlier)
    out = x.copy()
    out[frames[better]] = found[best, np.arange(len(frames))][better]
    return out


def _from_far(body: MarkedBody, x: np.ndarray, targets: np.ndarray, config: AnimateConfig) -> np.ndarray:
    """The unknowns (n, P) to which frames come from x, each by itself, while outliers lose their weight."""
    for scale in SCALES:
        weights = energy.geman_mcclure(np.nan_to_num(_apart(body, x, targets)), scale) / config.marker_sd**2

        def system(x: np.ndarray, weights: np.ndarray = weights) -> Dense:
            return body.system(x, targets, weights)

        x = levenberg_marquardt(system, x, STEPS, 1e-3, 1e-3, retract=body.retract).x
    return x


def _apart(body: MarkedBody, x: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """(T, L) metres from the markers to where the body puts them."""
    return np.linalg.norm(body.positions(x) - targets, axis=2)
