"""A template and a scan made ready to be matched, where the template is placed to begin with, and the matches.

Where a point lies is told by its paths to the landmarks: the same in every pose, so it needs no start.
"""
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from ..alignment.icp import align_rigid, landmark_motion
from ..correspondence.correspondences import Correspondences, checked_pairs
from ..geometry.farthest_points import farthest_points, thin
from ..geometry.mesh import Mesh, check_template
from ..geometry.target import Target, orient, target_of
from ..threads import search_threads
from .schedule import GraphStage

NORMALS = 0.04                # of the template's size: what a difference of normals of one is worth when matching
Landmarks = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class Inputs:
    """A template, a scan, and what is known of how they belong together; descriptors (N, q) where there are anchors.

    Landmarks are vertices (L,) and where they are on the scan (L, 3), metres; of the hints some are wrong.
    """

    template: Mesh
    target: Target
    size: float
    landmarks: Landmarks | None = None
    hints: Correspondences | None = None
    descriptors: np.ndarray | None = None


def prepare(template: Mesh, scan: Mesh | np.ndarray, landmarks: Landmarks | None = None,
            hints: Correspondences | None = None) -> Inputs:
    """Everything checked, and the surfaces described by their paths to landmarks, or else to the surest hints."""
    check_template(template)
    if landmarks is not None:
        landmarks = checked_pairs(template, *landmarks, "landmarks")
    if hints is not None:
        vertices, points = checked_pairs(template, hints.template_vertices, hints.scan_points, "correspondences", 0)
        hints = Correspondences(vertices, points, _checked_confidence(hints))
    target, size = target_of(scan), float(np.sqrt(template.face_areas.sum()))
    cell = 0.012 * size                                     # spacing of the points that paths run over
    anchors = path_anchors(landmarks, hints, target, 3 * cell)
    if anchors is None:
        return Inputs(template, target, size, landmarks, hints)
    mine, theirs = describe_both(template, target, anchors, cell, size)
    return Inputs(template, replace(target, descriptors=theirs), size, landmarks, hints, mine)


def _checked_confidence(hints: Correspondences) -> np.ndarray:
    confidence = np.asarray(hints.confidence, dtype=np.float64)
    if confidence.shape != (len(hints),) or not (np.isfinite(confidence) & (confidence >= 0)).all():
        raise ValueError(f"correspondences: expected {len(hints)} confidences of at least 0")
    return confidence


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


def placed(given: Inputs) -> np.ndarray:
    """The rigid transform (4, 4) to begin with: by descriptors, else by landmarks, else by the surfaces as a whole."""
    template, target = given.template, given.target
    if given.descriptors is not None:
        coarse = 0.03 * given.size
        vertices, points = described_alike(template, given.descriptors, target.thinned(coarse),
                                           thin(template.vertices, coarse))
    elif given.landmarks is not None:
        vertices, points = given.landmarks
    else:
        # From where it lies, or where both are far apart from the same middle: ICP finds what is near.
        T = np.eye(4)
        apart = (target.points.max(axis=0) + target.points.min(axis=0)
                 - template.vertices.max(axis=0) - template.vertices.min(axis=0)) / 2
        if np.linalg.norm(apart) > given.size / 2:
            T[:3, 3] = apart
        return align_rigid(template, target.points, start=T).T_target_source
    return landmark_motion(template.vertices[vertices], points)


def described_alike(template: Mesh, descriptors: np.ndarray, target: Target, sample: np.ndarray) -> Landmarks:
    """Some vertices (n,) of a template and the points (n, 3) that are described like them.

    Front and back of a trunk are described nearly alike; a motion to such points flattens the body, but since right,
    left, up and down are told apart, its rotation is the right one.
    """
    mine = Described(template.vertices, template.vertex_normals, descriptors).of(sample)
    theirs = Described(target.points, target.normals, target.descriptors)
    index, _ = mine.matched(theirs, np.inf, Likeness(positions=0.0, descriptors=1.0, limit=np.inf))
    return sample[index >= 0], target.points[index[index >= 0]]


def describe_both(template: Mesh, target: Target, anchors: tuple[np.ndarray, np.ndarray], cell: float, size: float
                  ) -> tuple[np.ndarray, np.ndarray]:
    """Descriptors (N, L) of the template's vertices and (n, L) of the scan's points by their paths to the anchors.

    Both surfaces are thinned to the same spacing, `cell` metres, and linked by the same rule, so that what a path along
    links is longer than the true one is the same on both.
    """
    vertices, points = anchors
    mine = path_lengths(template.vertices, template.vertex_normals, template.vertices[vertices], cell)
    theirs = path_lengths(target.points, target.normals, points, cell, target.oriented)
    return descriptors(mine, size), descriptors(theirs, size)


def descriptors(lengths: np.ndarray, size: float) -> np.ndarray:
    """Lengths (n, L) to compare: near landmarks tell more precisely than far ones, so logarithms.

    Divided by the root of their number: the distance of two descriptors is the root mean square over landmarks.
    """
    return np.log(lengths / size + 0.1) / np.sqrt(lengths.shape[1])


def path_lengths(points: np.ndarray, normals: np.ndarray, sources: np.ndarray, cell: float, oriented: bool = True
                 ) -> np.ndarray:
    """Lengths (n, L), metres, of the shortest paths from sources (L, 3) to all points of a surface, holes bridged.

    Where the normals point outward, `oriented`, paths do not jump between skins that touch. Small pieces far from
    everything take the way to the nearest point of the rest as the crow flies.
    """
    keep = thin(points, cell)
    p, n = points[keep], normals[keep]
    graph, joined = _bridged(p, _links(p, n, cell, oriented))
    tree = cKDTree(p[joined])
    near, at = tree.query(sources)
    lengths = dijkstra(graph, directed=False, indices=joined[at]).T[joined] + near
    apart, nearest = tree.query(points)
    return lengths[nearest] + apart[:, None]


def _links(p: np.ndarray, n: np.ndarray, cell: float, oriented: bool, neighbours: int = 10) -> csr_array:
    """Links between near points whose normals agree."""
    length, j = cKDTree(p).query(p, min(neighbours + 1, len(p)))
    coarse = 3 * max(cell, float(np.median(length[:, 1])))         # the points may lie wider than the cells
    i = np.repeat(np.arange(len(p)), j.shape[1])
    j, length = j.ravel(), length.ravel()
    good = (length <= coarse) & (j != i)
    i, j, length = i[good], j[good], length[good]
    agree = np.einsum("nd,nd->n", n[i], n[j])
    good = (agree if oriented else np.abs(agree)) > 0
    return csr_array(coo_array((length[good], (i[good], j[good])), shape=(len(p), len(p))))


def _bridged(p: np.ndarray, graph: csr_array, smallest: float = 0.003) -> tuple[csr_array, np.ndarray]:
    """The graph with its larger pieces joined to the largest where they are nearest; the points that belong to it."""
    count, label = connected_components(graph, directed=False)
    size = np.bincount(label, minlength=count)
    joined = label == size.argmax()
    extra: list[tuple[int, int, float]] = []
    waiting = [k for k in np.argsort(-size) if size[k] >= smallest * len(p) and k != size.argmax()]
    for k in waiting:
        piece = np.flatnonzero(label == k)
        inside = np.flatnonzero(joined)
        length, to = cKDTree(p[inside]).query(p[piece])
        for q in np.argsort(length)[:max(len(piece) // 50, 3)]:
            extra.append((int(piece[q]), int(inside[to[q]]), float(length[q])))
        joined[piece] = True
    if not extra:
        return graph, np.flatnonzero(joined)
    i, j, length = (np.array(column) for column in zip(*extra, strict=True))
    bridges = coo_array((length, (i.astype(int), j.astype(int))), shape=graph.shape)
    return csr_array(graph + bridges), np.flatnonzero(joined)


@dataclass(frozen=True, eq=False)
class Pull:
    """A quadratic energy of each vertex, `Σ xᵀ A x - 2 b·x + c`: what matches and landmarks want.

    A (N, 3, 3), square metres; b (N, 3), cubic metres.
    """

    A: np.ndarray
    b: np.ndarray
    c: float

    def __add__(self, other: Pull) -> Pull:
        return Pull(self.A + other.A, self.b + other.b, self.c + other.c)

    def energy(self, x: np.ndarray) -> float:
        """The energy of vertices (N, 3)."""
        return float(np.einsum("ni,nij,nj->", x, self.A, x, optimize=True) - 2 * np.sum(self.b * x) + self.c)


def pull(count: int, vertices: np.ndarray, targets: np.ndarray, weights: np.ndarray,
         normals: np.ndarray | None = None, slide: float = 1.0) -> Pull:
    """Some of `count` vertices, (n,), drawn to targets (n, 3) with weights (n,), square metres.

    A vertex may have several targets. With their normals the force along the surface is only a share, `slide`, of that
    across it.
    """
    A = np.broadcast_to(np.eye(3), (len(vertices), 3, 3))
    if normals is not None:
        A = slide * A + (1 - slide) * normals[:, :, None] * normals[:, None, :]
    A = weights[:, None, None] * A
    b = np.einsum("nij,nj->ni", A, targets)
    gather = csr_array(coo_array((np.ones(len(vertices)), (vertices, np.arange(len(vertices)))),
                                 shape=(count, len(vertices))))
    return Pull((gather @ A.reshape(-1, 9)).reshape(-1, 3, 3), gather @ b, float(np.sum(b * targets)))


@dataclass(frozen=True)
class Likeness:
    """What a match is sought by, each as the distance in metres that a difference of one is worth."""

    positions: float = 1.0       # less where the template does not lie near yet; 0 seeks by descriptors alone
    normals: float = 0.05
    descriptors: float = 0.0
    limit: float = 0.3           # descriptors that differ by more do not match


@dataclass(frozen=True, eq=False)
class Described:
    """Points with what they are matched by."""

    points: np.ndarray
    normals: np.ndarray
    descriptors: np.ndarray | None = None

    def of(self, sample: np.ndarray) -> Described:
        """Some of the points."""
        return Described(self.points[sample], self.normals[sample],
                         None if self.descriptors is None else self.descriptors[sample])

    def columns(self, like: Likeness) -> np.ndarray:
        """Points whose straight distances are how much they differ."""
        parts = [like.positions * self.points, like.normals * self.normals] if like.positions else []
        if like.descriptors and self.descriptors is not None:
            parts.append(like.descriptors * self.descriptors)
        return np.hstack(parts)

    def matched(self, others: Described, reach: float, like: Likeness) -> tuple[np.ndarray, np.ndarray]:
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
                    like: Likeness, descriptors: np.ndarray | None = None) -> Pull:
    """What matches want of some vertices, `sample` (n,), of a deformed template: of them to the scan, and back.

    Either direction weighs as much as an area, square metres.
    The weight of a match falls to zero at a distance of `reach`, metres; its force along the surface is a share,
    `slide`, of that across it. `descriptors` (N, q) are those of the vertices.
    """
    target = orient(target, deformed, max(like.normals, 1e-6))
    x, N = deformed.vertices, len(deformed.vertices)
    mine = Described(x, deformed.vertex_normals, descriptors).of(sample)
    theirs = Described(target.points, target.normals, target.descriptors)
    p, apart = mine.matched(theirs, reach, like)
    good = (p >= 0) & ~target.border[p]
    v, p = sample[good], p[good]
    weights = area / len(sample) * tukey(apart[good], reach)
    wanted = pull(N, v, target.points[p], weights, target.normals[p], slide)

    chosen, apart = theirs.matched(mine, reach, like)
    p = np.flatnonzero(chosen >= 0)
    weights = area / len(target.points) * tukey(apart[p], reach)
    return wanted + pull(N, sample[chosen[p]], target.points[p], weights, target.normals[p], slide)


def tukey(distances: np.ndarray, reach: float) -> np.ndarray:
    """Tukey's weight: one at zero distance, zero at `reach`."""
    return np.maximum(1 - (distances / reach) ** 2, 0) ** 2


def landmark_pull(count: int, landmarks: Landmarks | None, weight: float) -> Pull:
    """What landmarks want of so many vertices, each with a weight in square metres."""
    if landmarks is None:
        return Pull(np.zeros((count, 3, 3)), np.zeros((count, 3)), 0.0)
    vertices, points = landmarks
    return pull(count, vertices, points, np.full(len(vertices), weight))


def hint_pull(hints: Correspondences, x: np.ndarray, reach: float, area: float) -> Pull:
    """What hints, some of them wrong, want of vertices (N, 3): the farther from where it should be, the less.

    From `reach`, metres, on they count little. All of them together weigh as much as an area (square metres) of the
    surface.
    """
    apart = np.linalg.norm(x[hints.template_vertices] - hints.scan_points, axis=1)
    weights = hints.confidence / max(float(hints.confidence.sum()), 1e-12) / (1 + (apart / reach) ** 2) ** 2
    return pull(len(x), hints.template_vertices, hints.scan_points, area * weights)


def wanted_by(given: Inputs, stage: GraphStage, x: np.ndarray, target: Target, sample: np.ndarray) -> Pull:
    """What landmarks, matches and hints want of vertices (N, 3); those in the sample (n,) look for a match."""
    size, template = given.size, given.template
    wanted = landmark_pull(len(x), given.landmarks, stage.landmarks * size**2)
    if stage.reach:
        like = Likeness(stage.positions, NORMALS * size, stage.paths * size)
        wanted += match_both_ways(template.with_vertices(x), sample, size**2, target, stage.reach * size, stage.slide,
                                  like, given.descriptors)
    if given.hints is not None and stage.hints:
        wanted += hint_pull(given.hints, x, stage.reach * size, stage.hints * size**2)
    return wanted
