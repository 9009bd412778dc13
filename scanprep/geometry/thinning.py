"""Fewer points of even density."""
from __future__ import annotations

import numpy as np


def thin(points: np.ndarray, cell: float) -> np.ndarray:
    """Indices of one point for each cubic cell (metres) that holds any: even density, and less work."""
    key = np.floor((points - points.min(axis=0)) / cell).astype(np.int64)
    key = (key[:, 0] * (key[:, 1].max() + 1) + key[:, 1]) * (key[:, 2].max() + 1) + key[:, 2]
    return np.sort(np.unique(key, return_index=True)[1])
