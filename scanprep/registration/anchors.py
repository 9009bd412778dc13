"""What is known about single places before matching: landmarks, which are trusted, and hints, some of them wrong."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ..correspondence.correspondences import Correspondences, checked_pairs
from ..geometry import rotations
from ..geometry.mesh import Mesh
from .deformation_graph import farthest_points
from .energies import Pull, pull
from .matches import Described, Likeness, Target
from .paths import path_lengths, path_marks


@dataclass(frozen=True, eq=False)
class Hints:
    """Vertices and where they may be on the scan, each with a confidence.

    Attributes
    ----------
    vertices : (C,) int
    points : (C, 3) float, metres
    confidence : (C,) float
    """

    vertices: np.ndarray
    points: np.ndarray
    confidence: np.ndarray

    def wanted(self, x: np.ndarray, reach: float, area: float) -> Pull:
        """Their pull on vertices (N, 3); those farther than `reach` from where they should be count little.

        Parameters
        ----------
        area : float, square metres
            What all of them together weigh as much as.
        """
        apart = np.linalg.norm(x[self.vertices] - self.points, axis=1)
        weights = self.confidence / max(float(self.confidence.sum()), 1e-12) / (1 + (apart / reach) ** 2) ** 2
        return pull(len(x), self.vertices, self.points, area * weights)


def hints_of(template: Mesh, correspondences: Correspondences) -> Hints:
    """Correspondences as hints, or ValueError with what is wrong with them."""
    vertices, points = checked_pairs(template, correspondences.template_vertices, correspondences.scan_points,
                                     "correspondences", 0)
    confidence = np.asarray(correspondences.confidence, dtype=np.float64)
    if confidence.shape != (len(vertices),) or not (np.isfinite(confidence) & (confidence >= 0)).all():
        raise ValueError(f"correspondences: expected {len(vertices)} confidences of at least 0")
    return Hints(vertices, points, confidence)


def path_anchors(landmarks: tuple[np.ndarray, np.ndarray] | None, hints: Hints | None, target: Target, near: float,
                 most: int = 8) -> tuple[np.ndarray, np.ndarray] | None:
    """The places from which paths are measured: landmarks on the scan, or else the surest hints, spread out.

    Parameters
    ----------
    near : float, metres
        A landmark farther than this from the data is where the scanner saw nothing: no path begins there.

    Returns
    -------
    (L,) int and (L, 3) float, metres, or None
        None when there are fewer than three.
    """
    if landmarks is not None:
        seen = cKDTree(target.points).query(landmarks[1])[0] <= near
        if seen.sum() >= 3:
            return landmarks[0][seen], landmarks[1][seen]
    if hints is None or len(hints.vertices) < 3:
        return None
    sure = np.flatnonzero(hints.confidence >= np.median(hints.confidence))
    chosen = sure[farthest_points(hints.points[sure], min(most, len(sure)))]
    return hints.vertices[chosen], hints.points[chosen]


def mark_both(template: Mesh, target: Target, anchors: tuple[np.ndarray, np.ndarray], cell: float, size: float
              ) -> tuple[np.ndarray, np.ndarray]:
    """Marks (N, L) of the template's vertices and (n, L) of the scan's points by their paths to the anchors."""
    vertices, points = anchors
    mine = path_lengths(template.vertices, template.vertex_normals, template.vertices[vertices], cell)
    theirs = path_lengths(target.points, target.normals, points, cell, target.oriented)
    return path_marks(mine, size), path_marks(theirs, size)


def place_by_marks(template: Mesh, marks: np.ndarray, target: Target, sample: np.ndarray) -> np.ndarray:
    """The rigid transform (4, 4) that brings the template nearest to the points that are marked like it.

    Front and back of a trunk are marked nearly alike; that flattens the body, but since right, left, up and
    down are told apart, its turn is the right one.
    """
    mine = Described(template.vertices, template.vertex_normals, marks).of(sample)
    theirs = Described(target.points, target.normals, target.marks)
    index, _ = mine.matched(theirs, np.inf, Likeness(place=0.0, marks=1.0, mark_limit=np.inf))
    a, b = template.vertices[sample[index >= 0]], target.points[index[index >= 0]]
    R, _ = rotations.procrustes(a, b)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, b.mean(axis=0) - R @ a.mean(axis=0)
    return T
