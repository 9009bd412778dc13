"""Prepare template and scan for matching, find the initial transform, and match points in both directions.

A point is described by the lengths of its paths to the landmarks. They are the same in every pose, so matching by them
needs no initial alignment.
"""
from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import cKDTree

from ..alignment.icp import align_rigid, landmark_motion
from ..correspondence.correspondences import Correspondences, check_pairs
from ..geometry.farthest_points import farthest_points, thin
from ..geometry.mesh import Mesh, check_template
from ..geometry.sparse import gatherer, sum_groups
from ..geometry.target import Target, orient_by_mesh, target_of
from ..threads import search_threads
from .paths import descriptors, path_lengths
from .schedule import GraphStage

NORMALS = 0.04                # distance that a unit difference of normals equals in matching, in sizes; 6 cm on a man
Landmarks = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class RegistrationProblem:
    """A template, a scan and what is known of their correspondence.

    Landmarks are vertices (L,) and points of the scan (L, 3), metres. Hints are correspondences; some are wrong.
    Path descriptors (N, q) exist where there are enough landmarks or hints.
    """

    template: Mesh
    target: Target
    size: float
    landmarks: Landmarks | None = None
    hints: Correspondences | None = None
    descriptors: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Fit:
    """A deformed template: vertices x (N, 3), metres; `moved` is the mean movement in the last step, metres."""

    x: np.ndarray
    energies: dict[str, float] = field(default_factory=dict)
    iterations: int = 0
    moved: float = np.inf


def prepare_problem(template: Mesh, scan: Mesh | np.ndarray, landmarks: Landmarks | None = None,
                    hints: Correspondences | None = None) -> RegistrationProblem:
    """Check the inputs, and describe both surfaces by path lengths to landmarks, else to the most confident hints."""
    check_template(template)
    if landmarks is not None:
        landmarks = check_pairs(template, *landmarks, "landmarks")
    if hints is not None:
        vertices, points = check_pairs(template, hints.template_vertices, hints.scan_points, "correspondences", 0)
        confidence = np.asarray(hints.confidence, dtype=np.float64)
        if confidence.shape != (len(hints),) or not (np.isfinite(confidence) & (confidence >= 0)).all():
            raise ValueError(f"correspondences: expected {len(hints)} confidences of at least 0")
        hints = Correspondences(vertices, points, confidence)
    target, size = target_of(scan), float(np.sqrt(template.face_areas.sum()))
    cell = 0.012 * size                                     # spacing of points on paths, 17 mm on a man
    anchors = path_anchors(landmarks, hints, target, 3 * cell)
    if anchors is None:
        return RegistrationProblem(template, target, size, landmarks, hints)
    # both surfaces are thinned and linked alike, so paths are too long by the same factor on both
    template_lengths = path_lengths(template.vertices, template.vertex_normals, template.vertices[anchors[0]], cell)
    scan_lengths = path_lengths(target.points, target.normals, anchors[1], cell, target.oriented)
    return RegistrationProblem(template, replace(target, descriptors=descriptors(scan_lengths, size)), size, landmarks,
                               hints, descriptors(template_lengths, size))


def path_anchors(landmarks: Landmarks | None, hints: Correspondences | None, target: Target, near: float
                 ) -> Landmarks | None:
    """Choose vertices (L,) and points (L, 3) from which paths are measured: landmarks, or confident hints spread out.

    A landmark farther than `near` (metres) from the data lies where the scanner saw nothing, so it is left out. Returns
    None when fewer than three are left.
    """
    if landmarks is not None:
        seen = cKDTree(target.points).query(landmarks[1])[0] <= near
        if seen.sum() >= 3:
            return landmarks[0][seen], landmarks[1][seen]
    if hints is None or len(hints) < 3:
        return None
    # of the more confident half, eight far apart
    sure = np.flatnonzero(hints.confidence >= np.median(hints.confidence))
    chosen = sure[farthest_points(hints.scan_points[sure], 8)]
    return hints.template_vertices[chosen], hints.scan_points[chosen]


def initial_transform(inputs: RegistrationProblem) -> np.ndarray:
    """Find the rigid transform (4, 4) to start from: by path descriptors, else landmarks, else ICP of the surfaces."""
    template, target = inputs.template, inputs.target
    if inputs.descriptors is not None:
        # front and back of a trunk have nearly the same descriptors: their matches are off, but right, left, up and
        # down are clear, so the rotation of the best rigid motion is right
        sample, coarse = thin(template.vertices, 0.03 * inputs.size), target.thin(0.03 * inputs.size)
        template_points = FeaturePoints(template.vertices, template.vertex_normals, inputs.descriptors).of(sample)
        index, _ = template_points.match(FeaturePoints(coarse.points, coarse.normals, coarse.descriptors), np.inf,
                                         MatchWeights(positions=0.0, descriptors=1.0, limit=np.inf))
        return landmark_motion(template.vertices[sample[index >= 0]], coarse.points[index[index >= 0]])
    if inputs.landmarks is not None:
        return landmark_motion(template.vertices[inputs.landmarks[0]], inputs.landmarks[1])
    # without any hint, ICP from the current position; if that is far away, from equal centres
    T = np.eye(4)
    apart = (target.points.max(axis=0) + target.points.min(axis=0)
             - template.vertices.max(axis=0) - template.vertices.min(axis=0)) / 2
    if np.linalg.norm(apart) > inputs.size / 2:
        T[:3, 3] = apart
    return align_rigid(template, target.points, start=T).T_target_source


@dataclass(frozen=True, eq=False)
class QuadraticTargets:
    """A quadratic energy per vertex, `Σ xᵀ A x - 2 b·x + c`: the targets that matches and landmarks give.

    A (N, 3, 3), square metres; b (N, 3), cubic metres.
    """

    A: np.ndarray
    b: np.ndarray
    c: float

    def __add__(self, other: QuadraticTargets) -> QuadraticTargets:
        return QuadraticTargets(self.A + other.A, self.b + other.b, self.c + other.c)

    def energy(self, x: np.ndarray) -> float:
        """Return the energy of vertices (N, 3)."""
        return float(np.einsum("ni,nij,nj->", x, self.A, x, optimize=True) - 2 * np.sum(self.b * x) + self.c)


def pull(count: int, vertices: np.ndarray, targets: np.ndarray, weights: np.ndarray,
         normals: np.ndarray | None = None, slide: float = 1.0) -> QuadraticTargets:
    """Pull some vertices (n,) of `count` to targets (n, 3), metres, with weights (n,), square metres.

    A vertex may have several targets. With `normals`, the pull along the surface is only a share, `slide`, of that
    across it: 0 is point to plane, 1 point to point.
    """
    A = np.broadcast_to(np.eye(3), (len(vertices), 3, 3))
    if normals is not None:
        A = slide * A + (1 - slide) * normals[:, :, None] * normals[:, None, :]
    A = weights[:, None, None] * A
    b = np.einsum("nij,nj->ni", A, targets)
    gather = gatherer(vertices, count)
    return QuadraticTargets(sum_groups(gather, A), gather @ b, float(np.sum(b * targets)))


@dataclass(frozen=True)
class MatchWeights:
    """Weights of the matching distance: each is the distance in metres that a unit difference equals."""

    positions: float = 1.0       # below 1 while the template is far away; 0 matches by descriptors alone
    normals: float = 0.05
    descriptors: float = 0.0
    limit: float = 0.3           # descriptors that differ by more do not match


@dataclass(frozen=True, eq=False)
class FeaturePoints:
    """Points with the features they are matched by: normals, and path descriptors or None."""

    points: np.ndarray
    normals: np.ndarray
    descriptors: np.ndarray | None = None

    def of(self, sample: np.ndarray) -> FeaturePoints:
        """Return some of the points."""
        return FeaturePoints(self.points[sample], self.normals[sample],
                             None if self.descriptors is None else self.descriptors[sample])

    def columns(self, like: MatchWeights) -> np.ndarray:
        """Stack the weighted features, so that their Euclidean distance is the matching distance."""
        parts = [like.positions * self.points, like.normals * self.normals] if like.positions else []
        if like.descriptors and self.descriptors is not None:
            parts.append(like.descriptors * self.descriptors)
        return np.hstack(parts)

    def match(self, others: FeaturePoints, reach: float, like: MatchWeights) -> tuple[np.ndarray, np.ndarray]:
        """Find for each point the best match among others, -1 where too different; and their distances, metres."""
        columns, other_columns = self.columns(like), others.columns(like)
        _, index = cKDTree(other_columns).query(columns, workers=search_threads(len(columns)))
        apart = np.linalg.norm(others.points[index] - self.points, axis=1)
        good = apart <= reach
        if like.positions:
            good &= np.einsum("nd,nd->n", others.normals[index], self.normals) >= 0.5         # within 60 degrees
        if like.descriptors and self.descriptors is not None and others.descriptors is not None:
            good &= np.linalg.norm(others.descriptors[index] - self.descriptors, axis=1) <= like.limit
        return np.where(good, index, -1), apart


def match_both_ways(deformed: Mesh, sample: np.ndarray, area: float, target: Target, reach: float, slide: float,
                    like: MatchWeights, descriptors: np.ndarray | None = None) -> QuadraticTargets:
    """Match vertices `sample` (n,) of a deformed template to the scan, and the scan back to them.

    Each direction weighs as much as `area`, square metres, in total. The weight of a match falls to zero at a distance
    of `reach`, metres. Its pull along the surface is a share, `slide`, of that across it. `descriptors` (N, q) are
    those of the vertices.
    """
    target = orient_by_mesh(target, deformed, max(like.normals, 1e-6))
    x, N = deformed.vertices, len(deformed.vertices)
    template_points = FeaturePoints(x, deformed.vertex_normals, descriptors).of(sample)
    scan_points = FeaturePoints(target.points, target.normals, target.descriptors)
    # template to scan; matches on the border of a hole are dropped, as the surface continues beyond
    p, apart = template_points.match(scan_points, reach, like)
    good = (p >= 0) & ~target.border[p]
    v, p = sample[good], p[good]
    weights = area / len(sample) * tukey(apart[good], reach)
    wanted = pull(N, v, target.points[p], weights, target.normals[p], slide)

    # scan to template: pulls parts of the template that no vertex matches, such as a raised arm
    chosen, apart = scan_points.match(template_points, reach, like)
    p = np.flatnonzero(chosen >= 0)
    weights = area / len(target.points) * tukey(apart[p], reach)
    return wanted + pull(N, sample[chosen[p]], target.points[p], weights, target.normals[p], slide)


def tukey(distances: np.ndarray, reach: float) -> np.ndarray:
    """Compute Tukey's biweight: one at zero distance, zero from `reach` on."""
    return np.maximum(1 - (distances / reach) ** 2, 0) ** 2


def landmark_pull(count: int, landmarks: Landmarks | None, weight: float) -> QuadraticTargets:
    """Pull `count` vertices to their landmarks, each with a weight in square metres."""
    if landmarks is None:
        return QuadraticTargets(np.zeros((count, 3, 3)), np.zeros((count, 3)), 0.0)
    vertices, points = landmarks
    return pull(count, vertices, points, np.full(len(vertices), weight))


def hint_pull(hints: Correspondences, x: np.ndarray, reach: float, area: float) -> QuadraticTargets:
    """Pull vertices (N, 3) to hints, some of them wrong, with robust weights: a distant hint counts less.

    From a distance of `reach`, metres, on they count little. Together they weigh at most `area`, square metres.
    """
    apart = np.linalg.norm(x[hints.template_vertices] - hints.scan_points, axis=1)
    weights = hints.confidence / max(float(hints.confidence.sum()), 1e-12) / (1 + (apart / reach) ** 2) ** 2
    return pull(len(x), hints.template_vertices, hints.scan_points, area * weights)


def pull_of_stage(inputs: RegistrationProblem, stage: GraphStage, x: np.ndarray, target: Target,
                  sample: np.ndarray) -> QuadraticTargets:
    """Sum the pulls of landmarks, matches and hints on vertices (N, 3); vertices `sample` (n,) are matched."""
    size, template = inputs.size, inputs.template
    wanted = landmark_pull(len(x), inputs.landmarks, stage.landmarks * size**2)
    if stage.reach:
        like = MatchWeights(stage.positions, NORMALS * size, stage.paths * size)
        wanted += match_both_ways(template.with_vertices(x), sample, size**2, target, stage.reach * size, stage.slide,
                                  like, inputs.descriptors)
    if inputs.hints is not None and stage.hints:
        wanted += hint_pull(inputs.hints, x, stage.reach * size, stage.hints * size**2)
    return wanted
