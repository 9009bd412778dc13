"""A template and a scan made ready to be matched, where the template is placed to begin with, and the matches.

Where a point lies is told by its paths to the landmarks: the same in every pose, so it needs no start.
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

NORMALS = 0.04                # of the template's size: what a difference of normals of one is worth when matching
Landmarks = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class RegistrationProblem:
    """A template, a scan, and what is known of how they belong together; descriptors (N, q) where there are anchors.

    Landmarks are vertices (L,) and where they are on the scan (L, 3), metres; of the hints some are wrong.
    """

    template: Mesh
    target: Target
    size: float
    landmarks: Landmarks | None = None
    hints: Correspondences | None = None
    descriptors: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Fit:
    """Where a template came to lie: vertices x (N, 3), metres; `moved` is how far the mean one went last, metres."""

    x: np.ndarray
    energies: dict[str, float] = field(default_factory=dict)
    iterations: int = 0
    moved: float = np.inf


def prepare_problem(template: Mesh, scan: Mesh | np.ndarray, landmarks: Landmarks | None = None,
                    hints: Correspondences | None = None) -> RegistrationProblem:
    """Everything checked, and the surfaces described by their paths to landmarks, or else to the surest hints."""
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
    cell = 0.012 * size                                     # spacing of the points that paths run over
    anchors = path_anchors(landmarks, hints, target, 3 * cell)
    if anchors is None:
        return RegistrationProblem(template, target, size, landmarks, hints)
    # both thinned to the same spacing and linked by the same rule: a path is longer than the true one alike on both
    mine = path_lengths(template.vertices, template.vertex_normals, template.vertices[anchors[0]], cell)
    theirs = path_lengths(target.points, target.normals, anchors[1], cell, target.oriented)
    return RegistrationProblem(template, replace(target, descriptors=descriptors(theirs, size)), size, landmarks, hints,
                               descriptors(mine, size))


def path_anchors(landmarks: Landmarks | None, hints: Correspondences | None, target: Target, near: float, most: int = 8
                 ) -> Landmarks | None:
    """The places (L,) and (L, 3) from which paths are measured: landmarks on the scan, or the surest hints, spread out.

    A landmark farther than `near` (metres) from the data is where the scanner saw nothing: no path begins there. None
    when fewer than three are left.
    """
    if landmarks is not None:
        seen = cKDTree(target.points).query(landmarks[1])[0] <= near
        if seen.sum() >= 3:
            return landmarks[0][seen], landmarks[1][seen]
    if hints is None or len(hints) < 3:
        return None
    sure = np.flatnonzero(hints.confidence >= np.median(hints.confidence))
    chosen = sure[farthest_points(hints.scan_points[sure], most)]
    return hints.template_vertices[chosen], hints.scan_points[chosen]


def initial_transform(inputs: RegistrationProblem) -> np.ndarray:
    """The rigid transform (4, 4) to begin with: by descriptors, else by landmarks, else by the surfaces as a whole."""
    template, target = inputs.template, inputs.target
    if inputs.descriptors is not None:
        # Front and back of a trunk are described nearly alike. A motion to such points flattens the body, but its
        # rotation is right, since right, left, up and down are told apart.
        sample, few = thin(template.vertices, 0.03 * inputs.size), target.thin(0.03 * inputs.size)
        mine = FeaturePoints(template.vertices, template.vertex_normals, inputs.descriptors).of(sample)
        index, _ = mine.match(FeaturePoints(few.points, few.normals, few.descriptors), np.inf,
                              MatchWeights(positions=0.0, descriptors=1.0, limit=np.inf))
        return landmark_motion(template.vertices[sample[index >= 0]], few.points[index[index >= 0]])
    if inputs.landmarks is not None:
        return landmark_motion(template.vertices[inputs.landmarks[0]], inputs.landmarks[1])
    # From where it lies, or where both are far apart from the same middle: ICP finds what is near.
    T = np.eye(4)
    apart = (target.points.max(axis=0) + target.points.min(axis=0)
             - template.vertices.max(axis=0) - template.vertices.min(axis=0)) / 2
    if np.linalg.norm(apart) > inputs.size / 2:
        T[:3, 3] = apart
    return align_rigid(template, target.points, start=T).T_target_source


@dataclass(frozen=True, eq=False)
class QuadraticTargets:
    """A quadratic energy of each vertex, `Σ xᵀ A x - 2 b·x + c`: what matches and landmarks want.

    A (N, 3, 3), square metres; b (N, 3), cubic metres.
    """

    A: np.ndarray
    b: np.ndarray
    c: float

    def __add__(self, other: QuadraticTargets) -> QuadraticTargets:
        return QuadraticTargets(self.A + other.A, self.b + other.b, self.c + other.c)

    def energy(self, x: np.ndarray) -> float:
        """The energy of vertices (N, 3)."""
        return float(np.einsum("ni,nij,nj->", x, self.A, x, optimize=True) - 2 * np.sum(self.b * x) + self.c)


def pull(count: int, vertices: np.ndarray, targets: np.ndarray, weights: np.ndarray,
         normals: np.ndarray | None = None, slide: float = 1.0) -> QuadraticTargets:
    """Some of `count` vertices, (n,), drawn to targets (n, 3) with weights (n,), square metres.

    A vertex may have several targets. With their normals the force along the surface is only a share, `slide`, of that
    across it.
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
    """What a match is sought by, each as the distance in metres that a difference of one is worth."""

    positions: float = 1.0       # less where the template does not lie near yet; 0 seeks by descriptors alone
    normals: float = 0.05
    descriptors: float = 0.0
    limit: float = 0.3           # descriptors that differ by more do not match


@dataclass(frozen=True, eq=False)
class FeaturePoints:
    """Points with what they are matched by."""

    points: np.ndarray
    normals: np.ndarray
    descriptors: np.ndarray | None = None

    def of(self, sample: np.ndarray) -> FeaturePoints:
        """Some of the points."""
        return FeaturePoints(self.points[sample], self.normals[sample],
                             None if self.descriptors is None else self.descriptors[sample])

    def columns(self, like: MatchWeights) -> np.ndarray:
        """Points whose straight distances are how much they differ."""
        parts = [like.positions * self.points, like.normals * self.normals] if like.positions else []
        if like.descriptors and self.descriptors is not None:
            parts.append(like.descriptors * self.descriptors)
        return np.hstack(parts)

    def match(self, others: FeaturePoints, reach: float, like: MatchWeights) -> tuple[np.ndarray, np.ndarray]:
        """For each point the best of others, -1 where it is beyond the limits; and how far apart they are."""
        mine, theirs = self.columns(like), others.columns(like)
        _, index = cKDTree(theirs).query(mine, workers=search_threads(len(mine)))
        apart = np.linalg.norm(others.points[index] - self.points, axis=1)
        good = apart <= reach
        if like.positions:
            good &= np.einsum("nd,nd->n", others.normals[index], self.normals) >= 0.5
        if like.descriptors and self.descriptors is not None and others.descriptors is not None:
            good &= np.linalg.norm(others.descriptors[index] - self.descriptors, axis=1) <= like.limit
        return np.where(good, index, -1), apart


def match_both_ways(deformed: Mesh, sample: np.ndarray, area: float, target: Target, reach: float, slide: float,
                    like: MatchWeights, descriptors: np.ndarray | None = None) -> QuadraticTargets:
    """What matches want of some vertices, `sample` (n,), of a deformed template: of them to the scan, and back.

    Either direction weighs as much as an area, square metres.
    The weight of a match falls to zero at a distance of `reach`, metres; its force along the surface is a share,
    `slide`, of that across it. `descriptors` (N, q) are those of the vertices.
    """
    target = orient_by_mesh(target, deformed, max(like.normals, 1e-6))
    x, N = deformed.vertices, len(deformed.vertices)
    mine = FeaturePoints(x, deformed.vertex_normals, descriptors).of(sample)
    theirs = FeaturePoints(target.points, target.normals, target.descriptors)
    p, apart = mine.match(theirs, reach, like)
    good = (p >= 0) & ~target.border[p]
    v, p = sample[good], p[good]
    weights = area / len(sample) * tukey(apart[good], reach)
    wanted = pull(N, v, target.points[p], weights, target.normals[p], slide)

    chosen, apart = theirs.match(mine, reach, like)
    p = np.flatnonzero(chosen >= 0)
    weights = area / len(target.points) * tukey(apart[p], reach)
    return wanted + pull(N, sample[chosen[p]], target.points[p], weights, target.normals[p], slide)


def tukey(distances: np.ndarray, reach: float) -> np.ndarray:
    """Tukey's weight: one at zero distance, zero at `reach`."""
    return np.maximum(1 - (distances / reach) ** 2, 0) ** 2


def landmark_pull(count: int, landmarks: Landmarks | None, weight: float) -> QuadraticTargets:
    """What landmarks want of so many vertices, each with a weight in square metres."""
    if landmarks is None:
        return QuadraticTargets(np.zeros((count, 3, 3)), np.zeros((count, 3)), 0.0)
    vertices, points = landmarks
    return pull(count, vertices, points, np.full(len(vertices), weight))


def hint_pull(hints: Correspondences, x: np.ndarray, reach: float, area: float) -> QuadraticTargets:
    """What hints, some of them wrong, want of vertices (N, 3): the farther from where it should be, the less.

    From `reach`, metres, on they count little. All of them together weigh as much as an area (square metres) of the
    surface.
    """
    apart = np.linalg.norm(x[hints.template_vertices] - hints.scan_points, axis=1)
    weights = hints.confidence / max(float(hints.confidence.sum()), 1e-12) / (1 + (apart / reach) ** 2) ** 2
    return pull(len(x), hints.template_vertices, hints.scan_points, area * weights)


def pull_of_stage(inputs: RegistrationProblem, stage: GraphStage, x: np.ndarray, target: Target,
                  sample: np.ndarray) -> QuadraticTargets:
    """What landmarks, matches and hints want of vertices (N, 3); those in the sample (n,) look for a match."""
    size, template = inputs.size, inputs.template
    wanted = landmark_pull(len(x), inputs.landmarks, stage.landmarks * size**2)
    if stage.reach:
        like = MatchWeights(stage.positions, NORMALS * size, stage.paths * size)
        wanted += match_both_ways(template.with_vertices(x), sample, size**2, target, stage.reach * size, stage.slide,
                                  like, inputs.descriptors)
    if inputs.hints is not None and stage.hints:
        wanted += hint_pull(inputs.hints, x, stage.reach * size, stage.hints * size**2)
    return wanted
