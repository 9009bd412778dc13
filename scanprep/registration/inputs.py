"""What a registration is given, made ready: the scan as a target, landmarks, hints, and the place to begin at."""
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from ..alignment.icp import align_landmarks, align_rigid, landmark_motion
from ..correspondence.correspondences import Correspondences, checked_pairs
from ..geometry.farthest_points import farthest_points, thin
from ..geometry.mesh import Mesh, check_template
from ..geometry.target import Target, target_of
from .energies import Pull, pull
from .matches import Described, Likeness
from .path_descriptors import describe_both

Landmarks = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class Hints:
    """Vertices (C,) and where they may be on the scan (C, 3), metres, each with a confidence; some are wrong."""

    vertices: np.ndarray
    points: np.ndarray
    confidence: np.ndarray

    def wanted(self, x: np.ndarray, reach: float, area: float) -> Pull:
        """Their pull on vertices (N, 3); those farther than `reach` from where they should be count little.

        All of them together weigh as much as an area (square metres) of the surface.
        """
        apart = np.linalg.norm(x[self.vertices] - self.points, axis=1)
        weights = self.confidence / max(float(self.confidence.sum()), 1e-12) / (1 + (apart / reach) ** 2) ** 2
        return pull(len(x), self.vertices, self.points, area * weights)


@dataclass(frozen=True, eq=False)
class Inputs:
    """A template, a scan, and what is known of how they belong together; descriptors (N, q) where there are anchors."""

    template: Mesh
    target: Target
    size: float
    landmarks: Landmarks | None = None
    hints: Hints | None = None
    descriptors: np.ndarray | None = None

    def landmark_pull(self, share: float) -> Pull:
        """Each landmark weighs as much as this share of the surface."""
        N = len(self.template.vertices)
        if self.landmarks is None:
            return Pull(np.zeros((N, 3, 3)), np.zeros((N, 3)), 0.0)
        vertices, points = self.landmarks
        return pull(N, vertices, points, np.full(len(vertices), share * self.size**2))


def prepare(template: Mesh, scan: Mesh | np.ndarray, landmarks: Landmarks | None = None,
            correspondences: Correspondences | None = None) -> Inputs:
    """Everything checked, and the surfaces described by their paths to landmarks, or else to the surest hints."""
    check_template(template)
    target, size = target_of(scan), float(np.sqrt(template.face_areas.sum()))
    if landmarks is not None:
        landmarks = checked_pairs(template, *landmarks, "landmarks")
    hints = None if correspondences is None else hints_of(template, correspondences)
    cell = 0.012 * size                                     # spacing of the points that paths run over
    anchors = path_anchors(landmarks, hints, target, 3 * cell)
    if anchors is None:
        return Inputs(template, target, size, landmarks, hints)
    mine, theirs = describe_both(template, target, anchors, cell, size)
    return Inputs(template, replace(target, descriptors=theirs), size, landmarks, hints, mine)


def hints_of(template: Mesh, correspondences: Correspondences) -> Hints:
    """Correspondences as hints, or ValueError with what is wrong with them."""
    vertices, points = checked_pairs(template, correspondences.template_vertices, correspondences.scan_points,
                                     "correspondences", 0)
    confidence = np.asarray(correspondences.confidence, dtype=np.float64)
    if confidence.shape != (len(vertices),) or not (np.isfinite(confidence) & (confidence >= 0)).all():
        raise ValueError(f"correspondences: expected {len(vertices)} confidences of at least 0")
    return Hints(vertices, points, confidence)


def path_anchors(landmarks: Landmarks | None, hints: Hints | None, target: Target, near: float, most: int = 8
                 ) -> Landmarks | None:
    """The places (L,) and (L, 3) from which paths are measured: landmarks on the scan, or the surest hints, spread out.

    A landmark farther than `near` (metres) from the data is where the scanner saw nothing: no path begins there. None
    when fewer than three are left.
    """
    if landmarks is not None:
        seen = cKDTree(target.points).query(landmarks[1])[0] <= near
        if seen.sum() >= 3:
            return landmarks[0][seen], landmarks[1][seen]
    if hints is None or len(hints.vertices) < 3:
        return None
    sure = np.flatnonzero(hints.confidence >= np.median(hints.confidence))
    chosen = sure[farthest_points(hints.points[sure], most)]
    return hints.vertices[chosen], hints.points[chosen]


def placed(given: Inputs) -> np.ndarray:
    """The rigid transform (4, 4) to begin with: by descriptors, else by landmarks, else by the surfaces as a whole."""
    template, target = given.template, given.target
    if given.descriptors is not None:
        coarse = 0.03 * given.size
        return place_by_descriptors(template, given.descriptors, target.thinned(coarse),
                                    thin(template.vertices, coarse))
    if given.landmarks is not None:
        return align_landmarks(template.vertices[given.landmarks[0]], given.landmarks[1]).T_target_source
    return align_rigid(template, target.points).T_target_source


def place_by_descriptors(template: Mesh, descriptors: np.ndarray, target: Target, sample: np.ndarray) -> np.ndarray:
    """The rigid transform (4, 4) that brings some vertices nearest to the points that are described like them.

    Front and back of a trunk are described nearly alike; that flattens the body, but since right, left, up and down are
    told apart, its rotation is the right one.
    """
    mine = Described(template.vertices, template.vertex_normals, descriptors).of(sample)
    theirs = Described(target.points, target.normals, target.descriptors)
    index, _ = mine.matched(theirs, np.inf, Likeness(positions=0.0, descriptors=1.0, limit=np.inf))
    return landmark_motion(template.vertices[sample[index >= 0]], target.points[index[index >= 0]])
