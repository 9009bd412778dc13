"""Compress a motion into few columns, with an error that cannot be seen."""
from __future__ import annotations

import numpy as np

from ..geometry.farthest_points import spread_indices

TOLERANCE = 5e-4                     # metres, at any point of any frame: a tenth of what can be seen
FIRST, MORE = 60, 20                 # frames that the columns are made from at first; added per round where they fail
MOST = 400                           # frames at most: beyond, the eigenvalue problem takes too long


def low_rank(frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Factor frames (T, n, 3), metres, into columns (n, r) and coefficients (T, r, 3), within half a millimetre.

    A body made of turning parts has no more columns than its model, however long it moves: `Y = B C` with the rotations
    in C. So the columns come from some of the frames, and from those that they do not reproduce.

    Parameters
    ----------
    frames : (T, n, 3) float, metres
        Points of every frame.

    Returns
    -------
    columns : (n, r) float
        Orthonormal.
    coefficients : (T, r, 3) float

    Examples
    --------
    >>> shape, turns = np.array([[1.0, 0, 0], [0, 2.0, 0], [1.0, 1.0, 1.0]]), np.linspace(0, 6, 50)
    >>> frames = np.stack([shape * np.cos(t) + np.roll(shape, 1, axis=1) * np.sin(t) for t in turns])
    >>> columns, coefficients = low_rank(frames)
    >>> np.allclose(np.einsum("nr,trc->tnc", columns, coefficients), frames)
    True
    """
    count, points = frames.shape[:2]
    chosen = spread_indices(count, FIRST)
    while True:
        basis = _columns(frames[chosen])
        coefficients = np.einsum("nr,tnc->trc", basis, frames, optimize=True)
        # frames that the columns do not reproduce join the ones they are computed from, the worst first
        errors = np.array([np.abs(basis @ c - frame).max(initial=0)
                           for c, frame in zip(coefficients, frames, strict=True)])
        failing = np.setdiff1d(np.flatnonzero(errors > TOLERANCE), chosen)
        if not len(failing) or len(chosen) >= MOST or basis.shape[1] == points:
            return basis, coefficients
        chosen = np.union1d(chosen, failing[np.argsort(-errors[failing])][:MORE])


def _columns(frames: np.ndarray) -> np.ndarray:
    """Compute the fewest orthonormal columns (n, r) that reproduce some frames within half the tolerance."""
    stacked = frames.transpose(1, 0, 2).reshape(frames.shape[1], -1)
    # singular value decomposition by the small Gram matrix
    values, vectors = np.linalg.eigh(stacked.T @ stacked)
    order = np.argsort(-values)
    sizes, vectors = np.sqrt(np.maximum(values[order], 0)), vectors[:, order]
    kept = int((sizes > 1e-9 * max(sizes[0], 1e-30)).sum())
    left = stacked @ vectors[:, :max(kept, 1)] / np.maximum(sizes[:max(kept, 1)], 1e-30)
    low, high = 1, max(kept, 1)                        # bisection for the fewest columns that suffice
    while low < high:
        rank = (low + high) // 2
        off = np.abs((left[:, :rank] * sizes[:rank]) @ vectors[:, :rank].T - stacked).max()
        low, high = (low, rank) if off <= TOLERANCE / 2 else (rank + 1, high)
    return np.linalg.qr(left[:, :low])[0]
