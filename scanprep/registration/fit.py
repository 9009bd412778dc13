"""A registration under way: where the template lies, what draws it, how stiff it is by now."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ..alignment.icp import align_landmarks, align_rigid
from ..geometry.mesh import Mesh
from ..geometry.thinning import thin
from .affine import Links, LinkStage, build_links
from .anchors import Hints, mark_both, path_anchors, place_by_marks
from .deformation_graph import build_graph, carry_over, deform
from .deformation_graph import start as start_motion
from .energies import NodePattern, Pull, Stiffness, follow_pull, pull, terms
from .final_fit import SettleConfig, settle
from .limb_twists import find_ends, mismatch, turned_end
from .matches import Likeness, Matching, Target, match_both_ways, orient
from .schedule import GraphStage, RegistrationConfig, ShellStage
from .shell import Shell

FEW = 300                             # nodes of a graph that no stage asks for


class Fit:
    """A registration under way: where the template lies, its graph, what has been counted."""

    def __init__(self, template: Mesh, target: Target, landmarks: tuple[np.ndarray, np.ndarray] | None,
                 hints: Hints | None, config: RegistrationConfig, progress: Callable[[int, int], None],
                 start: np.ndarray | None = None) -> None:
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
        self.T = self.placed() if start is None else start
        self.stages = [s for s in config.graph if s.place == 1 or self.marks is not None]
        self.total = sum(stage.rounds for stage in self.stages) + len(config.shell) \
            + sum(stage.rounds for stage in config.links) + (config.settle is not None)
        self.x = template.vertices @ self.T[:3, :3].T + self.T[:3, 3]
        self.nodes = self.stages[0].nodes if self.stages else FEW
        self.graph = build_graph(template, self.nodes)
        self.pattern = NodePattern(self.graph)
        self.motion = start_motion(self.graph, self.T)
        self.shell: Shell | None = None
        self.links: Links | None = None
        self.kind = ""

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
                found = follow_pull(self.graph, self.pattern, self.motion, wanted, self.stiffness(stage), steps)
                now = terms(self.graph, found.x, wanted, self.stiffness(stage))
                self.motion, self.energies = found.x, {name: term.value for name, term in now.items()}
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
            found = follow_pull(self.graph, self.pattern, self.motion, drawn + self.landmark_pull(stage.landmarks),
                                self.stiffness(stage), steps=8)
            self.motion, self.x = found.x, deform(self.graph, found.x)
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

    def bend_links(self, stage: LinkStage) -> None:
        """One stage of a published regulariser."""
        if self.links is None or self.kind != stage.kind:
            self.links, self.kind = build_links(stage.kind, self.template, self.x, self.T), stage.kind
        for _ in range(stage.rounds):
            wanted = self.landmark_pull(stage.landmarks)
            if stage.reach:
                wanted += self.matches(self.target, self.all, stage.reach, stage.slide).wanted
            before = self.x
            if wanted.A.any():
                self.x = self.links.round(wanted, stage)
            self.energies["data"] = wanted.energy(self.x)
            self.iterations += 1
            self.advance(before, 1)

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

    def advance(self, before: np.ndarray, steps: int) -> None:
        """Note how far the vertices have moved, and tell of the progress."""
        self.converged = bool(np.linalg.norm(self.x - before, axis=1).mean() <= self.config.settled * self.size)
        self.done += steps
        self.progress(self.done, self.total)
