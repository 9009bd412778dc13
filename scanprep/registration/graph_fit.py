"""The coarse registration: a deformation graph is drawn to the scan by matches in both directions, stage by stage."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from ..geometry.farthest_points import thin
from ..geometry.target import Target, orient
from .deformation_graph import DeformationGraph, NodeMotion, build_graph, deform, start_motion, transferred
from .energies import Pull, Stiffness, follow_pull, pull, terms
from .inputs import Inputs
from .limb_ends import End, RigidFit, find_ends, rotated_end
from .matches import NORMALS, Likeness, match_both_ways
from .schedule import GraphStage


@dataclass(frozen=True, eq=False)
class GraphFit:
    """Where the template lies: its vertices x (N, 3), metres, and the motion of the nodes that carry them.

    `moved` is how far the last stage moved the mean vertex, metres.
    """

    x: np.ndarray
    graph: DeformationGraph
    motion: NodeMotion
    energies: dict[str, float] = field(default_factory=dict)
    iterations: int = 0
    moved: float = np.inf

    def minimised(self, wanted: Pull, stiffness: Stiffness, steps: int) -> GraphFit:
        """The fit nearer to what matches and landmarks want, against the resistance of the nodes."""
        if not wanted.A.any():
            return self
        found = follow_pull(self.graph, self.motion, wanted, stiffness, steps)
        now = {name: term.value for name, term in terms(self.graph, found.x, wanted, stiffness).items()}
        return replace(self, x=deform(self.graph, found.x), motion=found.x, energies=now,
                       iterations=self.iterations + found.iterations)

    def refined(self, given: Inputs, nodes: int) -> GraphFit:
        """The same motion on a graph of so many nodes."""
        if min(nodes, len(self.x)) == len(self.graph.node_vertices):
            return self
        finer = build_graph(given.template, nodes)
        return replace(self, graph=finer, motion=transferred(self.graph, self.motion, finer))


def start_fit(given: Inputs, T: np.ndarray, nodes: int) -> GraphFit:
    """The template where a rigid transform (4, 4) places it, on a graph of so many nodes."""
    graph = build_graph(given.template, nodes)
    return GraphFit(given.template.vertices @ T[:3, :3].T + T[:3, 3], graph, start_motion(graph, T))


def graph_fit(given: Inputs, T: np.ndarray, stages: tuple[GraphStage, ...], ends: int,
              tell: Callable[[int], None]) -> GraphFit:
    """The template bent onto the scan by all stages, from where a rigid transform (4, 4) places it."""
    fit = start_fit(given, T, stages[0].nodes if stages else 300)
    for stage in stages:
        before, fit = fit, bent(given, fit, stage)
        fit = replace(fit, moved=mean_move(before.x, fit.x))
        tell(stage.rounds)
        if stage.ends:
            for end in find_ends(given.template, ends, 0.14 * given.size) if ends else ():
                fit = with_end_rotated(given, fit, stage, end)
    return fit


def mean_move(before: np.ndarray, after: np.ndarray) -> float:
    """Metres."""
    return float(np.linalg.norm(after - before, axis=1).mean())


def bent(given: Inputs, fit: GraphFit, stage: GraphStage) -> GraphFit:
    """The fit after matches were sought and followed, as often as the stage says."""
    size, template = given.size, given.template
    fit, held = fit.refined(given, stage.nodes), given.landmark_pull(stage.landmarks)
    target, sample = given.target.thinned(stage.detail * size), thin(template.vertices, stage.detail * size)
    like = Likeness(stage.positions, NORMALS * size, stage.paths * size)
    for _ in range(stage.rounds):
        wanted = held
        if stage.reach:
            wanted = held + match_both_ways(template.with_vertices(fit.x), sample, size**2, target, stage.reach * size,
                                            stage.slide, like, given.descriptors)
        if given.hints is not None and stage.hints:
            wanted += given.hints.wanted(fit.x, stage.reach * size, stage.hints * size**2)
        fit = fit.minimised(wanted, _stiffness(stage, size), 1)
    return fit


def with_end_rotated(given: Inputs, fit: GraphFit, stage: GraphStage, end: End) -> GraphFit:
    """The fit with an end of the body rotated about itself, where that lies nearer to the scan, stretch counted in."""
    size, template = given.size, given.template
    target = orient(given.target.thinned(0.5 * stage.detail * size), template.with_vertices(fit.x), NORMALS * size)
    places = rotated_end(template, end, fit.x, RigidFit(target, size))
    if places is None:
        return fit
    drawn = pull(len(fit.x), end.vertices, places, template.vertex_areas[end.vertices])
    trial = fit.minimised(drawn + given.landmark_pull(stage.landmarks), _stiffness(stage, size), 8)
    trial = bent(given, trial, replace(stage, hints=0.0, paths=0.0))
    return trial if _misfit(given, trial, target, stage) < _misfit(given, fit, target, stage) else fit


def _misfit(given: Inputs, fit: GraphFit, target: Target, stage: GraphStage) -> float:
    """Error against the scan and strain, as they are now."""
    size, body = given.size, given.template.with_vertices(fit.x)
    error = RigidFit(target, size).error(body.vertices, body.vertex_normals)
    now = terms(fit.graph, fit.motion, given.landmark_pull(stage.landmarks), _stiffness(stage, size))
    return float(error @ given.template.vertex_areas) + sum(term.value for term in now.values())


def _stiffness(stage: GraphStage, size: float) -> Stiffness:
    return Stiffness(stage.stretch * size, stage.bend * size, stage.growth * size)
