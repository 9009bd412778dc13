"""Non-rigid registration of a template to a scan, from stiff to soft.

1. The template is placed by its landmarks and bent towards them, with no data yet.
2. A graph of nodes that turn and grow is drawn to the scan by matches in both directions, in stages of
   falling stiffness and rising detail; turns are unknowns, so limbs keep their volume where there are no data.
3. The surface follows the scan as a thin shell.

[Hahnel], [Allen], [Amberg]
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ..geometry.mesh import Mesh, check_template
from .anchors import Hints, checked_landmarks, hints_of, mark_both, path_anchors, place_by_marks
from .confidence import evidence
from .correspondences import Correspondences
from .descent import Stiffness, minimise, terms
from .energies import NodePattern, Pull, pull
from .graph import build_graph, carry_over, deform, start, vertex_linear
from .matches import Likeness, Matching, Target, match_both_ways, orient, target_of
from .rigid import align_landmarks, align_rigid
from .schedule import GraphStage, RegistrationConfig, ShellStage
from .settle import SettleConfig, settle
from .shell import Shell, flipped, unfold
from .thinning import thin
from .twists import find_ends, mismatch, turned_end


@dataclass(frozen=True, eq=False)
class Registration:
    """The template on the scan.

    Attributes
    ----------
    mesh : Mesh
        The template's triangles on their new vertices.
    distances : (N,) float, metres
        From each vertex that was seen to the surface of the scan; NaN for the others.
    seen : (N,) bool
        Whether there were data here: the confidence is at least one half.
    rms : float, metres
        Of the distances of the vertices seen.
    landmark_rms : float, metres
        NaN without landmarks.
    converged : bool
    iterations : int
        Steps over all stages.
    energies : dict
        Value of each term at the end of the coarse registration, and of the data at the very end.
    flipped : int
        Triangles that face against their surroundings.
    confidence : (N,) float
        From 0, made up from the surroundings, to 1: there were data here, from both directions.
    """

    mesh: Mesh
    distances: np.ndarray
    seen: np.ndarray
    rms: float
    landmark_rms: float
    converged: bool
    iterations: int
    energies: dict[str, float]
    flipped: int
    confidence: np.ndarray


def register(template: Mesh, scan: Mesh | np.ndarray, landmarks: tuple[np.ndarray, np.ndarray] | None = None,
             config: RegistrationConfig | None = None, progress: Callable[[int, int], None] | None = None,
             correspondences: Correspondences | None = None) -> Registration:
    """Bring a template onto a scan.

    Parameters
    ----------
    template : Mesh
        One connected manifold component.
    scan : Mesh or (n, 3) float, metres
        May have holes, borders, several overlapping sheets, noise.
    landmarks : (L,) int and (L, 3) float, metres, optional
        Vertices of the template and where they are on the scan. Needed wherever the pose differs much.
    progress : callable, optional
        Called as progress(done, total).
    correspondences : Correspondences, optional
        Hints, some of which may be wrong: they draw softly, and less the farther they are from all others.

    Returns
    -------
    Registration

    Raises
    ------
    ValueError
        A template that is not one manifold component, an empty scan, values that are not finite, fewer than
        three landmarks or landmarks that do not exist.
    """
    config = config or RegistrationConfig()
    check_template(template)
    target = target_of(scan, config.neighbours)
    if landmarks is not None:
        landmarks = checked_landmarks(template, landmarks)
    hints = None if correspondences is None else hints_of(template, correspondences)
    fit = _Fit(template, target, landmarks, hints, config, progress or (lambda done, total: None))
    for stage in fit.stages:
        fit.bend_graph(stage)
        if stage.twists:
            fit.try_twists(stage)
    for round_ in config.shell:
        fit.follow(round_)
    if config.settle is not None:
        fit.settle(config.settle)
    fit.x = unfold(template, fit.x, vertex_linear(fit.graph, fit.motion))
    return fit.result()


class _Fit:
    """A registration under way: where the template lies, its graph, what has been counted."""

    def __init__(self, template: Mesh, target: Target, landmarks: tuple[np.ndarray, np.ndarray] | None,
                 hints: Hints | None, config: RegistrationConfig, progress: Callable[[int, int], None]) -> None:
        self.template, self.landmarks, self.hints, self.config = template, landmarks, hints, config
        self.size = float(np.sqrt(template.face_areas.sum()))
        self.all = np.arange(len(template.vertices))
        self.progress, self.done, self.iterations = progress, 0, 0
        self.energies: dict[str, float] = {}
        self.converged = False
        self.marks: np.ndarray | None = None
        anchors = path_anchors(landmarks, hints, target, 3 * config.path_cell * self.size)
        if anchors is not None:
            self.marks, theirs = mark_both(template, target, anchors, config.path_cell * self.size, self.size)
            target = replace(target, marks=theirs)
        self.target = target
        self.T = self.placed()
        self.stages = [s for s in config.graph if s.place == 1 or self.marks is not None]
        self.total = sum(stage.rounds for stage in self.stages) + len(config.shell) \
            + (config.settle is not None)
        self.x = template.vertices @ self.T[:3, :3].T + self.T[:3, 3]
        self.nodes = self.stages[0].nodes
        self.graph = build_graph(template, self.nodes)
        self.pattern = NodePattern(self.graph)
        self.motion = start(self.graph, self.T)
        self.shell: Shell | None = None

    def placed(self) -> np.ndarray:
        """The rigid transform (4, 4) to begin with."""
        if self.marks is not None:
            coarse = 0.03 * self.size
            return place_by_marks(self.template, self.marks, self.target.thinned(coarse),
                                  thin(self.template.vertices, coarse))
        if self.landmarks is not None:
            return align_landmarks(self.template.vertices[self.landmarks[0]], self.landmarks[1]).T_target_source
        return align_rigid(self.template, self.target.points).T_target_source

    def landmark_pull(self, share: float) -> Pull:
        """Each landmark weighs as much as this share of the surface."""
        N = len(self.x)
        if self.landmarks is None:
            return Pull(np.zeros((N, 3, 3)), np.zeros((N, 3)), 0.0)
        vertices, points = self.landmarks
        return pull(N, vertices, points, np.full(len(vertices), share * self.size**2))

    def bend_graph(self, stage: GraphStage) -> None:
        """One stage of the coarse registration."""
        self.refine(stage.nodes)
        before = self.x
        self.rounds(stage)
        self.advance(before, stage.rounds)

    def rounds(self, stage: GraphStage) -> None:
        """Seek matches and follow them, as often as the stage says."""
        held = self.landmark_pull(stage.landmarks)
        target = self.target.thinned(stage.detail * self.size)
        sample = thin(self.template.vertices, stage.detail * self.size)
        for _ in range(stage.rounds if stage.reach else 1):
            wanted, steps = held, stage.rounds
            if stage.reach:
                wanted, steps = held + self.matches(target, sample, stage.reach, stage.slide, stage).wanted, 1
                if self.hints is not None and stage.hints:
                    wanted += self.hints.wanted(self.x, stage.reach * self.size, stage.hints * self.size**2)
            if wanted.A.any():
                found = minimise(self.graph, self.pattern, self.motion, wanted, self.stiffness(stage), steps, 1e-3)
                self.motion, self.energies = found.motion, found.energies
                self.iterations += found.iterations
            self.x = deform(self.graph, self.motion)

    def try_twists(self, stage: GraphStage) -> None:
        """Turn ends of the body about themselves; keep what lies nearer to the scan, stretch counted in."""
        twists, size = self.config.twists, self.size
        scale = self.config.normal_weight * size
        target = orient(self.target.thinned(0.5 * stage.detail * size), self.template.with_vertices(self.x), scale)
        for end in find_ends(self.template, twists.ends, twists.radius * size):
            turned = turned_end(self.template, end, self.x, target, scale, twists, size)
            if turned is None:
                continue
            before = self.x, self.motion, self.energies
            value = self.misfit(target, twists.cap * size, stage)
            drawn = pull(len(self.x), end.vertices, turned, self.template.vertex_areas[end.vertices])
            found = minimise(self.graph, self.pattern, self.motion, drawn + self.landmark_pull(stage.landmarks),
                             self.stiffness(stage), 8, 1e-3)
            self.motion, self.x = found.motion, deform(self.graph, found.motion)
            self.rounds(replace(stage, hints=0.0, paths=0.0))
            if self.misfit(target, twists.cap * size, stage) >= value:
                self.x, self.motion, self.energies = before

    def misfit(self, target: Target, cap: float, stage: GraphStage) -> float:
        """Error against the scan and strain, as they are now."""
        error = mismatch(self.template.with_vertices(self.x), self.all, target, self.config.normal_weight * self.size,
                         cap)
        now = terms(self.graph, self.motion, self.landmark_pull(stage.landmarks), self.stiffness(stage))
        return float(error @ self.template.vertex_areas) + sum(term.value for term in now.values())

    def stiffness(self, stage: GraphStage) -> Stiffness:
        return Stiffness(stage.stretch * self.size, stage.bend * self.size, stage.growth * self.size)

    def refine(self, nodes: int) -> None:
        """Go on with a graph of so many nodes."""
        if nodes == self.nodes:
            return
        old, motion = self.graph, self.motion
        self.graph, self.nodes = build_graph(self.template, nodes), nodes
        self.pattern = NodePattern(self.graph)
        self.motion = carry_over(old, motion, self.graph)

    def follow(self, stage: ShellStage) -> None:
        """One round of the last pass."""
        self.shell = self.shell or Shell(self.template)
        matching = self.matches(self.target, self.all, stage.reach, stage.slide)
        wanted = matching.wanted + self.landmark_pull(stage.landmarks)
        x = self.shell.displaced(self.x, wanted, stage.smoothing * self.size, stage.tension * self.size)
        self.energies["shell"] = wanted.energy(x)
        self.iterations += 1
        before, self.x = self.x, x
        self.advance(before, 1)

    def settle(self, config: SettleConfig) -> None:
        """The last pass."""
        settled = settle(self.template, self.x, self.target, self.landmarks, config)
        self.iterations += settled.iterations
        self.energies["strain"] = settled.strain
        before, self.x = self.x, settled.vertices
        self.advance(before, 1)
        self.converged = settled.converged

    def matches(self, target: Target, sample: np.ndarray, reach: float, slide: float,
                stage: GraphStage | None = None) -> Matching:
        """Matches with the template as it lies now; `reach` as a multiple of its size."""
        like = Likeness(normals=self.config.normal_weight * self.size)
        if stage is not None:
            like = replace(like, place=stage.place, marks=stage.paths * self.size)
        return match_both_ways(self.template.with_vertices(self.x), sample, self.size**2, target,
                               reach * self.size, slide, like, self.marks)

    def result(self) -> Registration:
        """What was found, measured against the whole scan."""
        folded = flipped(self.template, self.x, vertex_linear(self.graph, self.motion))
        found = evidence(self.template.with_vertices(self.x), self.target, self.config.near * self.size,
                         self.config.normal_weight * self.size)
        seen = found.confidence >= 0.5
        distances = np.where(seen, found.distances, np.nan)
        landmark_rms = np.nan
        if self.landmarks is not None:
            apart = np.linalg.norm(self.x[self.landmarks[0]] - self.landmarks[1], axis=1)
            landmark_rms = float(np.sqrt(np.mean(apart**2)))
        return Registration(self.template.with_vertices(self.x), distances, seen,
                            float(np.sqrt(np.mean(distances[seen] ** 2))) if seen.any() else np.nan, landmark_rms,
                            self.converged, self.iterations, self.energies, int(folded.sum()), found.confidence)

    def advance(self, before: np.ndarray, steps: int) -> None:
        """Note how far the vertices have moved, and tell of the progress."""
        self.converged = bool(np.linalg.norm(self.x - before, axis=1).mean() <= self.config.settled * self.size)
        self.done += steps
        self.progress(self.done, self.total)
