"""A motion as few columns: the places of all points in all frames, to a tenth of what anybody can see."""
from __future__ import annotations

import numpy as np

from ..geometry.farthest_points import spread_indices

TOLERANCE = 5e-4                     # metres, at any point of any frame
FIRST, MORE = 60, 20                 # frames that the columns are made from; frames added where they do not do
MOST = 400


def low_rank(frames: np.ndarray, tolerance: float = TOLERANCE) -> tuple[np.ndarray, np.ndarray]:
    """Columns (n, r) and coefficients (T, r, 3) whose products are the frames (T, n, 3), metres, within a tolerance.

    A body whose parts turn has no more columns than its model, however long it moves: `Y = B C`, where the rotations
    are in C. So the columns are taken from some frames, and from those where they did not do.
    """
    count, points = frames.shape[:2]
    chosen = spread_indices(count, FIRST)
    while True:
        basis = _columns(frames[chosen], tolerance)
        coefficients = np.einsum("nr,tnc->trc", basis, frames, optimize=True)
        off = np.array([np.abs(basis @ c - frame).max(initial=0)
                        for c, frame in zip(coefficients, frames, strict=True)])
        bad = np.setdiff1d(np.flatnonzero(off > tolerance), chosen)
        if not len(bad) or len(chosen) >= MOST or basis.shape[1] == points:
            return basis, coefficients
        chosen = np.union1d(chosen, bad[np.argsort(-off[bad])][:MORE])


def _columns(frames: np.ndarray, tolerance: float) -> np.ndarray:
    """Orthonormal columns (n, r) that give some frames within half the tolerance."""
    stacked = frames.transpose(1, 0, 2).reshape(frames.shape[1], -1)
    values, vectors = np.linalg.eigh(stacked.T @ stacked)
    order = np.argsort(-values)
    sizes, vectors = np.sqrt(np.maximum(values[order], 0)), vectors[:, order]
    kept = int((sizes > 1e-9 * max(sizes[0], 1e-30)).sum())
    left = stacked @ vectors[:, :max(kept, 1)] / np.maximum(sizes[:max(kept, 1)], 1e-30)
    low, high = 1, max(kept, 1)                        # the fewest columns that do
    while low < high:
        rank = (low + high) // 2
        off = np.abs((left[:, :rank] * sizes[:rank]) @ vectors[:, :rank].T - stacked).max()
        low, high = (low, rank) if off <= tolerance / 2 else (rank + 1, high)
    return np.linalg.qr(left[:, :low])[0]
