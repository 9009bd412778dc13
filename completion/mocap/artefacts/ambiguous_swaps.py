"""Close markers whose exchange the body may have followed: both ways are tried, from a body that knows neither."""
from __future__ import annotations

from functools import partial

import numpy as np

from scanprep.geometry.least_squares import Minimum, levenberg_marquardt

from ..pose.robust import marker_weights
from ..settings import FaultConfig
from .simulated import Simulation
from .swaps import AWAY, WORTH, best_stretches, loose_ends
from .tracks import Tracks

CLOSE = 0.25                         # metres between markers whose exchange a body can follow
SAMPLES = 3                          # frames of a stretch in which both ways are tried


def doubtful_pairs(pairs: set[tuple[int, int]], places: np.ndarray) -> list[tuple[int, int]]:
    """Those pairs whose simulated markers (T, L, 3) mostly are close to each other; NaN for unknown ones."""
    return [(a, b) for a, b in sorted(pairs)
            if np.median(np.linalg.norm(places[:, a] - places[:, b], axis=1)) < CLOSE]


def exchanged_after_all(body: Simulation, x: np.ndarray, tracks: Tracks, a: int, b: int, config: FaultConfig
                        ) -> np.ndarray:
    """Frames (n,) in which the labels of a pair of close markers are better exchanged.

    Parameters
    ----------
    body : Simulation
    x : (T, P) float
        As it follows the markers under the labels that they have now.
    tracks : Tracks
        Of the markers under these labels.
    a, b : int
        Among the labels of `tracks`, known to the body.
    """
    begins = loose_ends(tracks, a, b)
    lengths = np.diff(np.r_[begins, len(x)])
    seen = np.isfinite(tracks.positions[:, [a, b], 0]).all(axis=1)
    frames, stretch = [], []
    for i, (begin, length) in enumerate(zip(begins, lengths, strict=True)):
        there = begin + np.flatnonzero(seen[begin:begin + length])
        some = np.unique(there[np.linspace(0, len(there) - 1, SAMPLES + 2).round().astype(int)[1:-1]]) if len(
            there) else there
        frames.append(some)
        stretch.append(np.full(len(some), i))
    at, of = np.concatenate(frames), np.concatenate(stretch)
    if not len(at):
        return at
    value = np.clip(_gains(body, x[at], tracks.positions[at], a, b), -2 * AWAY, 2 * AWAY)
    mean = np.bincount(of, value, len(begins)) / np.maximum(np.bincount(of, minlength=len(begins)), 1)
    known = np.add.reduceat(seen.astype(float), begins)
    gains = mean * known * min(1.0, 1 / (config.memory * body.rate))
    total, swapped = best_stretches(tracks, a, b, begins, gains, config)
    return swapped if total > WORTH else swapped[:0]


def _gains(body: Simulation, x: np.ndarray, positions: np.ndarray, a: int, b: int) -> np.ndarray:
    """What it gains (n,), in half squared deviations, to exchange a pair in frames with unknowns (n, P)."""
    targets = positions[:, body.rows]
    own = [int(np.flatnonzero(body.rows == label)[0]) for label in (a, b)]
    weights, _ = marker_weights(body.positions(x), targets, body.config.marker_sd, body.config.outlier)
    without, full = weights.copy(), weights
    without[:, own], full[:, own] = 0, body.config.marker_sd**-2
    start = _solved(body, x, targets, without).x
    other = targets.copy()
    other[:, own] = targets[:, own[::-1]]
    costs = [_solved(body, start, way, full).energy for way in (targets, other)]
    return 0.5 * (costs[0] - costs[1])


def _solved(body: Simulation, x: np.ndarray, targets: np.ndarray, weights: np.ndarray) -> Minimum[np.ndarray]:
    """Frames (n, P) after a few steps towards targets (n, L, 3)."""
    return levenberg_marquardt(partial(body.body.system, targets=targets, weights=weights), x, iterations=8,
                               tolerance=1e-3, retract=body.body.retract)
