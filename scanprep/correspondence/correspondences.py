"""Pairs of places on a template and a scan, however they were found."""
from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ..geometry.mesh import Mesh

SURE = 0.4                  # median confidence: 0.87 between poses of a person, 0.25 to 0.37 on a ball


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


def checked_pairs(template: Mesh, vertices: np.ndarray, points: np.ndarray, name: str, least: int = 3
                  ) -> tuple[np.ndarray, np.ndarray]:
    """Vertices of a template and their places as arrays, or ValueError with what is wrong with them.

    Parameters
    ----------
    template : Mesh
    vertices : (L,) int
    points : (L, 3) float, metres
    name : str
        What the argument is called where it was given.
    least : int
        So many are needed.
    """
    vertices, points = np.asarray(vertices), np.asarray(points, dtype=np.float64)
    if vertices.ndim != 1 or not np.issubdtype(vertices.dtype, np.integer):
        raise ValueError(f"{name}: expected vertex numbers of shape (L,), got {vertices.dtype} "
                         f"of shape {vertices.shape}")
    if points.shape != (len(vertices), 3):
        raise ValueError(f"{name}: expected points of shape ({len(vertices)}, 3), got {points.shape}")
    if len(vertices) < least:
        raise ValueError(f"{name}: expected at least {least}, got {len(vertices)}")
    outside = (vertices < 0) | (vertices >= len(template.vertices))
    if outside.any():
        raise ValueError(f"{name}: vertex {vertices[outside][0]} is outside 0..{len(template.vertices) - 1}")
    if not np.isfinite(points).all():
        raise ValueError(f"{name}: {(~np.isfinite(points).all(axis=1)).sum()} points are not finite")
    return vertices, points


def correspondences_problem(found: Correspondences) -> str | None:
    """Why correspondences mean nothing, with the likely cause; None where they mean something."""
    sure = float(np.median(found.confidence)) if len(found) else 0.0
    if sure >= SURE:
        return None
    return (f"{len(found)} pairs were found with a median confidence of {sure:.2f}; a scan of something else, too "
            "little of the body, or landmarks of other places?")
