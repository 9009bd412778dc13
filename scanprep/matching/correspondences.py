"""Pairs of places on a template and a scan, however they were found."""
from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Which vertex of the template lies where on the scan.

    Attributes
    ----------
    template_vertices : (C,) int
    scan_points : (C, 3) float, metres
    confidence : (C,) float
        From 0, a guess, to 1, certain.
    method : str
        How they were found.
    energies : dict
        Terms of what was minimised, and other figures of the search.
    converged : bool
    """

    template_vertices: np.ndarray
    scan_points: np.ndarray
    confidence: np.ndarray
    method: str = ""
    energies: dict[str, float] = field(default_factory=dict)
    converged: bool = True

    def __len__(self) -> int:
        return len(self.template_vertices)
