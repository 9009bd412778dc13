"""The coarse registration: a deformation graph is drawn to the scan by matches in both directions, stage by stage.

Rotations of nodes are unknowns, so limbs keep their volume where there are no data.

[Hahnel]
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import reduce

import numpy as np
from scipy.sparse import csc_array
from scipy.spatial import cKDTree

from ..geometry.farthest_points import thin
from ..geometry.least_squares import Sparse, levenberg_marquardt
from ..geometry.mesh import Mesh
from ..geometry.target import orient_by_mesh
from .deformation_graph import DeformationGraph, NodeMotion, build_graph, deform, motion_of, refine_motion
from .graph_energy import UNKNOWNS, node_pattern, terms
from .limb_ends import End, RigidFit, bending, find_ends, rotate_ends
from .matches import NORMALS, Fit, QuadraticTargets, RegistrationProblem, landmark_pull, pull, pull_of_stage
from .schedule import GraphStage, RegistrationConfig


@dataclass(frozen=True, eq=False)
class GraphFit(Fit):
    """A template where the nodes of a graph carry it."""

    graph: DeformationGraph = field(kw_only=True)
    motion: NodeMotion = field(kw_only=True)

    def refine(self, template: Mesh, nodes: int) -> GraphFit:
        """The same motion on a graph of so many nodes."""
        if min(nodes, len(self.x)) == len(self.graph.node_vertices):
            return self
        finer = build_graph(template, nodes)
        return replace(self, graph=finer, motion=refine_motion(self.graph, self.motion, finer))

    def minimise(self, wanted: QuadraticTargets, stage: GraphStage, size: float, steps: int) -> GraphFit:
        """The fit nearer to what matches and landmarks want, against the resistance of the nodes of a stage."""
        if not wanted.A.any():
            return self
        pattern = node_pattern(self.graph)

        def equations(at: NodeMotion) -> Sparse:
            now = terms(self.graph, at, wanted, stage, size)

            def assemble() -> tuple[np.ndarray, csc_array]:
                normals = (term.normal(pattern) for term in now.values())
                blocks, half = (reduce(np.add, parts) for parts in zip(*normals, strict=True))
                if not stage.growth:
                    blocks[:, 3], blocks[:, :, 3], half[:, 3] = 0, 0, 0               # the log-scale
                return half.reshape(-1), pattern.matrix(blocks)

            values = {name: term.value for name, term in now.items()}
            return Sparse(sum(values.values()), assemble, values)

        found = levenberg_marquardt(equations, self.motion, steps, tolerance=1e-3, damping=1e-5,
                                    retract=lambda at, step: at.advance(step.reshape(-1, UNKNOWNS)))
        return replace(self, x=deform(self.graph, found.x), motion=found.x, energies=found.equations.terms,
                       iterations=self.iterations + found.iterations)


def register_graph(inputs: RegistrationProblem, start: np.ndarray, config: RegistrationConfig,
                   progress: Callable[[int, int], None]) -> GraphFit:
    """The template bent onto the scan by the stages of the schedule, from vertices by those near; see `Method`."""
    near = start.shape == inputs.template.vertices.shape
    stages = config.near_stages if near else [
        stage for stage in config.graph if stage.positions == 1 or inputs.descriptors is not None]
    nodes = stages[0].nodes if stages else 300
    fit = fit_at_vertices(inputs.template, start, nodes) if near else start_fit(inputs.template, start, nodes)
    return fit_stages(inputs, fit, stages, progress)


def fit_at_vertices(template: Mesh, vertices: np.ndarray, nodes: int) -> GraphFit:
    """The template where nodes carry it nearest to vertices (N, 3), on a graph of so many nodes."""
    graph = build_graph(template, nodes)
    motion = motion_of(graph, vertices)
    return GraphFit(deform(graph, motion), graph=graph, motion=motion)


def start_fit(template: Mesh, T: np.ndarray, nodes: int) -> GraphFit:
    """The template where a rigid transform (4, 4) places it, on a graph of so many nodes."""
    graph, R, t = build_graph(template, nodes), T[:3, :3], T[:3, 3]
    M = len(graph.nodes)
    motion = NodeMotion(np.broadcast_to(R, (M, 3, 3)).copy(), np.zeros(M), graph.nodes @ R.T + t)
    return GraphFit(template.vertices @ R.T + t, graph=graph, motion=motion)


def fit_stages(inputs: RegistrationProblem, fit: GraphFit, stages: list[GraphStage],
               progress: Callable[[int, int], None] = lambda done, total: None) -> GraphFit:
    """The fit after some stages, and after ends of the body were tried in other rotations where a stage says so."""
    done, total = 0, sum(stage.rounds for stage in stages)
    for stage in stages:
        before, fit = fit, fit_stage(inputs, fit, stage)
        fit = replace(fit, moved=float(np.linalg.norm(fit.x - before.x, axis=1).mean()))
        done += stage.rounds
        progress(done, total)
        for end in find_ends(inputs.template, stage.ends, 0.14 * inputs.size) if stage.ends else ():
            fit = rotate_end(inputs, fit, stage, end)
    return fit


def fit_stage(inputs: RegistrationProblem, fit: GraphFit, stage: GraphStage) -> GraphFit:
    """The fit after matches were sought and followed, as often as the stage says."""
    cell, template = stage.detail * inputs.size, inputs.template
    target, sample = inputs.target.thin(cell), thin(template.vertices, cell)
    fit = fit.refine(template, stage.nodes)
    for _ in range(stage.rounds):
        fit = fit.minimise(pull_of_stage(inputs, stage, fit.x, target, sample), stage, inputs.size, 1)
    return fit


def rotate_end(inputs: RegistrationProblem, fit: GraphFit, stage: GraphStage, end: End) -> GraphFit:
    """The fit with an end of the body rotated about itself, where that lies nearer to the scan and needs less bending.

    A head or a hand that is rolled wrongly lies on the scan as well, but must change its shape for it. The joint above
    may bend, so what counts is how far the end is from an enlarged copy of itself.
    """
    size, template = inputs.size, inputs.template
    target = inputs.target.thin(0.5 * stage.detail * size)
    scan = RigidFit(orient_by_mesh(target, template.with_vertices(fit.x), NORMALS * size), size)
    held = landmark_pull(len(fit.x), inputs.landmarks, stage.landmarks * size**2)
    areas = template.vertex_areas

    def misfit(of: GraphFit) -> float:
        """Error against the scan, both ways, strain, and twenty times what the end is bent in itself, as it is now."""
        body = template.with_vertices(of.x)
        # an end that is turned into the body lies near the scan everywhere, and leaves the scan of it uncovered
        left = np.minimum(cKDTree(of.x).query(target.points)[0], 0.05 * size)
        strain = sum(term.value for term in terms(of.graph, of.motion, held, stage, size).values())
        bent = 20.0 * areas[end.vertices].sum() * bending(template.vertices[end.vertices], of.x[end.vertices])[0] ** 2
        there = float(scan.error(body.vertices, body.vertex_normals) @ areas)
        return there + float((left**2).mean() * areas.sum()) + strain + bent

    trials = [fit]
    for places in rotate_ends(template, end, fit.x, scan):
        drawn = held + pull(len(fit.x), end.vertices, places, areas[end.vertices])
        trials.append(fit_stage(inputs, fit.minimise(drawn, stage, size, 8), replace(stage, hints=0.0, paths=0.0)))
    return min(trials, key=misfit) if len(trials) > 1 else fit
