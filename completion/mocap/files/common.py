"""What the readers of marker files share."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanprep.geometry.storage import StorageError


class MarkerFileError(StorageError):
    """A file of markers or of a marker layout that cannot be read: which one, what was expected, what came."""


@dataclass(frozen=True, eq=False)
class RawMarkers:
    """What a marker file holds, in its own unit."""

    positions: np.ndarray            # (T, L, 3) float, NaN where missing
    labels: tuple[str, ...]          # L strings, as they stand in the file
    rate: float | None               # frames per second, or None where the file does not say
    unit: str                        # as it stands in the file
