"""The error of a measurement that expected errors of the vertices imply."""
from __future__ import annotations

import numpy as np

from .reading import Reading

# Chosen on half views of the ten even people of `tests/benchmarks/measures.py`, which tells how far the odd ones agree.
REACH = 0.10                         # metres, over which errors of the surface go together
MOST, SHARE = 0.010, 0.02            # metres, and of the value: more is an error of the pose, which repose takes away
SLIDE = 0.003                        # metres that a section may lie beside its place along the part, or a landmark


def measured_error(reading: Reading, vertices: np.ndarray, expected: np.ndarray) -> float:
    """Expected error, metres, root mean square, of a measurement.

    The derivative by the vertices is applied to errors that are alike in all directions and go together over some
    way, so that a girth sums them up and a distance feels its ends; sliding along the skin comes on top.

    Parameters
    ----------
    reading : Reading
    vertices : (N, 3) float, metres
    expected : (N,) float, metres
        Root mean square error of each vertex, as of a completion.
    """
    ids, place = np.unique(reading.vertices, return_inverse=True)
    force = np.zeros((len(ids), 3))
    np.add.at(force, place, reading.force)
    apart = np.linalg.norm(vertices[ids][:, None] - vertices[ids], axis=2)
    together = np.exp(-0.5 * (apart / REACH)**2)
    pull = np.minimum(expected[ids], min(MOST, SHARE * reading.value))[:, None] * force / np.sqrt(3)
    variance = np.einsum("id,ij,jd->", pull, together, pull)
    return float(np.sqrt(max(variance, 0) + (SLIDE * reading.slope)**2))
