"""How far two surfaces lie apart, for tests and benchmarks."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface


@dataclass(frozen=True)
class OneWayDistance:
    """Distances from one surface to the closest points of another.

    Attributes
    ----------
    mean, rms, p95 : float, metres
        Over points spread evenly by area; p95 is the 95th percentile.
    hausdorff : float, metres
        The largest, over those points and all vertices.
    """

    mean: float
    rms: float
    p95: float
    hausdorff: float


@dataclass(frozen=True)
class SurfaceDistance:
    """Distances between two surfaces, both ways.

    Attributes
    ----------
    mean, rms, p95, hausdorff : float, metres
        Of both directions together, each with the same weight; hausdorff is the larger one.
    a_to_b, b_to_a : OneWayDistance
    """

    mean: float
    rms: float
    p95: float
    hausdorff: float
    a_to_b: OneWayDistance
    b_to_a: OneWayDistance


def surface_distance(a: Mesh, b: Mesh, samples: int = 50_000, rng: np.random.Generator | None = None
                     ) -> SurfaceDistance:
    """Mean, RMS, 95th percentile and Hausdorff distance between two surfaces, both ways.

    The averages weigh by area: they are taken over points spread evenly over the surface, not over vertices,
    which crowd in the face and the hands. With n samples the mean is good to about 1/√n of the spread.

    Parameters
    ----------
    a, b : Mesh
    samples : int
        Points on each surface.
    rng : np.random.Generator, optional
        Where the points fall; without it they fall in the same places every time.

    Returns
    -------
    SurfaceDistance

    Raises
    ------
    ValueError
        A surface without area, or no samples.
    """
    if samples < 1:
        raise ValueError(f"samples: expected at least 1, got {samples}")
    for name, mesh in (("a", a), ("b", b)):
        if not len(mesh.faces) or mesh.face_areas.sum() == 0:
            raise ValueError(f"{name}: expected a surface with triangles, got {mesh} without area")
    rng = np.random.default_rng(0) if rng is None else rng
    forth, forth_vertices = _distances(a, Surface(b), samples, rng)
    back, back_vertices = _distances(b, Surface(a), samples, rng)
    there, here = _summary(forth, forth_vertices), _summary(back, back_vertices)
    return SurfaceDistance(
        mean=(there.mean + here.mean) / 2, rms=float(np.hypot(there.rms, here.rms) / np.sqrt(2)),
        p95=float(np.percentile(np.concatenate([forth, back]), 95)),
        hausdorff=max(there.hausdorff, here.hausdorff), a_to_b=there, b_to_a=here)


def _distances(mesh: Mesh, target: Surface, samples: int, rng: np.random.Generator
               ) -> tuple[np.ndarray, np.ndarray]:
    """Distances of points spread over a mesh, and of the vertices its triangles use, to another surface."""
    points = mesh.sample(samples, rng)[0]
    return (target.closest(points).distances,
            target.closest(mesh.vertices[np.unique(mesh.faces)]).distances)


def _summary(spread: np.ndarray, vertices: np.ndarray) -> OneWayDistance:
    return OneWayDistance(mean=float(spread.mean()), rms=float(np.sqrt(np.mean(spread**2))),
                          p95=float(np.percentile(spread, 95)), hausdorff=float(max(spread.max(), vertices.max())))
