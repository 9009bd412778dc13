"""How far two surfaces lie apart, for tests and benchmarks."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface


@dataclass(frozen=True)
class OneWayDistance:
    """Distances, metres, from one surface to the closest points of another.

    Mean, root mean square and 95th percentile are over points spread evenly by area; `hausdorff` is the largest, over
    those points and all vertices.
    """

    mean: float
    rms: float
    p95: float
    hausdorff: float


@dataclass(frozen=True)
class SurfaceDistance(OneWayDistance):
    """Distances between two surfaces both ways, each with the same weight; `hausdorff` is the larger one."""

    a_to_b: OneWayDistance
    b_to_a: OneWayDistance


def surface_distance(a: Mesh, b: Mesh, samples: int = 50_000) -> SurfaceDistance:
    """Distances between two surfaces: with n samples the mean is good to about 1/√n of the spread.

    The averages weigh by area and not by vertices, which crowd in the face and the hands.
    """
    rng = np.random.default_rng(0)
    ways, every = [], []
    for mesh, target in ((a, Surface(b)), (b, Surface(a))):
        spread = target.closest(mesh.sample(samples, rng)[0]).distances
        vertices = target.closest(mesh.vertices[np.unique(mesh.faces)]).distances
        ways.append(OneWayDistance(float(spread.mean()), float(np.sqrt(np.mean(spread**2))),
                                   float(np.percentile(spread, 95)), float(max(spread.max(), vertices.max()))))
        every.append(spread)
    there, here = ways
    return SurfaceDistance((there.mean + here.mean) / 2, float(np.hypot(there.rms, here.rms) / np.sqrt(2)),
                           float(np.percentile(np.concatenate(every), 95)), max(there.hausdorff, here.hausdorff),
                           there, here)
