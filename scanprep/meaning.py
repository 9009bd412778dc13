"""When a result means nothing: what the functions that tell have in common. Each stands in the room of its result."""
from __future__ import annotations

import numpy as np

from .geometry.mesh import Mesh

HAND = 0.06                 # of a body's size, the root of its area: a hand's width, 8 cm on a man


def size(body: Mesh) -> float:
    """The root of the surface area of a body, metres."""
    return float(np.sqrt(body.face_areas.sum()))


def extent(points: np.ndarray) -> float:
    """Diagonal of the box around points (n, 3), in their unit; NaN without any that are finite."""
    found = points[np.isfinite(points).all(axis=-1)]
    return float(np.linalg.norm(np.ptp(found, axis=0))) if len(found) else np.nan


def unit_problem(found: float, expected: float, what: str, least: float = 0.2) -> str | None:
    """Why data `found` metres large, for a body of `expected`, may be in another unit; None where they are not.

    `what` is the data as they stand in the sentence; `least` is how small data of a part of a body may be.
    """
    if not np.isfinite(found) or least <= found / expected <= 2.5:
        return None
    return f"{what} {found / expected:.3g} times as large as the body: the wrong unit? (--unit)"
