"""The coarse registration: a deformation graph is pulled to the scan by matches in both directions, stage by stage.

Rotations of nodes are unknowns. So limbs keep their volume where there are no data.

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
    """A fit whose vertices are carried by the nodes of a graph."""

    graph: DeformationGraph = field(kw_only=True)
    motion: NodeMotion = field(kw_only=True)

    def refine(self, template: Mesh, nodes: int) -> GraphFit:
        """Return the same motion on a graph of `nodes` nodes."""
        if min(nodes, len(self.x)) == len(self.graph.node_vertices):
            return self
        finer = build_graph(template, nodes)
        return replace(self, graph=finer, motion=refine_motion(self.graph, self.motion, finer))

    def minimise(self, wanted: QuadraticTargets, stage: GraphStage, size: float, steps: int) -> GraphFit:
        """Move the nodes towards matches and landmarks, against the stiffness of a stage, by Levenberg-Marquardt."""
        if not wanted.A.any():
            return self
        pattern = node_pattern(self.graph)

        def equations(at: NodeMotion) -> Sparse:
            now = terms(self.graph, at, wanted, stage, size)

            def assemble() -> tuple[np.ndarray, csc_array]:
                normals = (term.normal(pattern) for term in now.values())
                blocks, half = (reduce(np.add, parts) for parts in zip(*normals, strict=True))
                # growth 0 fixes the size of nodes: without equations the damping keeps the log-scale where it is
                if not stage.growth:
                    blocks[:, 3], blocks[:, :, 3], half[:, 3] = 0, 0, 0  # the log-scale
                return half.reshape(-1), pattern.matrix(blocks)

            values = {name: term.value for name, term in now.items()}
            return Sparse(sum(values.values()), assemble, values)

        # a tolerance of 1e-3 is enough, as matches are sought anew after each minimisation
        solution = levenberg_marquardt(equations, self.motion, steps, tolerance=1e-3, damping=1e-5,
                                       retract=lambda at, step: at.advance(step.reshape(-1, UNKNOWNS)))
        return replace(self, x=deform(self.graph, solution.x), motion=solution.x, energies=solution.equations.terms,
                       iterations=self.iterations + solution.iterations)


def register_graph(inputs: RegistrationProblem, start: np.ndarray, config: RegistrationConfig,
                   progress: Callable[[int, int], None]) -> GraphFit:
    """Deform the template onto the scan by the stages of the schedule; from vertices, only by the near stages.
    """
    # a start by vertices needs no stage that matches by paths; without path descriptors these stages are skipped
    near = start.shape == inputs.template.vertices.shape
    stages = config.near_stages if near else [
        stage for stage in config.graph if stage.positions == 1 or inputs.descriptors is not None]
    nodes = stages[0].nodes if stages else 300
    fit = fit_at_vertices(inputs.template, start, nodes) if near else start_fit(inputs.template, start, nodes)
    return fit_stages(inputs, fit, stages, progress)


def fit_at_vertices(template: Mesh, vertices: np.ndarray, nodes: int) -> GraphFit:
    """Return the fit of a graph of `nodes` nodes that comes nearest to vertices (N, 3)."""
    graph = build_graph(template, nodes)
    motion = motion_of(graph, vertices)
    return GraphFit(deform(graph, motion), graph=graph, motion=motion)


def start_fit(template: Mesh, T: np.ndarray, nodes: int) -> GraphFit:
    """Return the fit of a graph of `nodes` nodes after a rigid transform (4, 4)."""
    graph, R, t = build_graph(template, nodes), T[:3, :3], T[:3, 3]
    M = len(graph.nodes)
    motion = NodeMotion(np.broadcast_to(R, (M, 3, 3)).copy(), np.zeros(M), graph.nodes @ R.T + t)
    return GraphFit(template.vertices @ R.T + t, graph=graph, motion=motion)


def fit_stages(inputs: RegistrationProblem, fit: GraphFit, stages: list[GraphStage],
               progress: Callable[[int, int], None] = lambda done, total: None) -> GraphFit:
    """Run some stages, and try other rotations of head, hands and feet where a stage asks for it."""
    done, total = 0, sum(stage.rounds for stage in stages)
    for stage in stages:
        before, fit = fit, fit_stage(inputs, fit, stage)
        fit = replace(fit, moved=float(np.linalg.norm(fit.x - before.x, axis=1).mean()))
        done += stage.rounds
        progress(done, total)
        # an end has a radius of 0.14 of the body's size, about that of a head or a hand with its wrist
        for end in find_ends(inputs.template, stage.ends, 0.14 * inputs.size) if stage.ends else ():
            fit = rotate_end(inputs, fit, stage, end)
    return fit


def fit_stage(inputs: RegistrationProblem, fit: GraphFit, stage: GraphStage) -> GraphFit:
    """Run one stage: find matches and minimise, as often as the stage says."""
    cell, template = stage.detail * inputs.size, inputs.template
    target, sample = inputs.target.thin(cell), thin(template.vertices, cell)
    fit = fit.refine(template, stage.nodes)
    for _ in range(stage.rounds):
        fit = fit.minimise(pull_of_stage(inputs, stage, fit.x, target, sample), stage, inputs.size, 1)
    return fit


def rotate_end(inputs: RegistrationProblem, fit: GraphFit, stage: GraphStage, end: End) -> GraphFit:
    """Try an end of the body in other rotations; keep the one that lies nearer to the scan and bends its skin less.

    A twisted head or hand lies on the scan as well, but must change its shape for it. The joint above may bend. So what
    counts is how far the end is from a scaled rigid copy of itself.
    """
    size, template = inputs.size, inputs.template
    target = inputs.target.thin(0.5 * stage.detail * size)
    scan = RigidFit(orient_by_mesh(target, template.with_vertices(fit.x), NORMALS * size), size)
    held = landmark_pull(len(fit.x), inputs.landmarks, stage.landmarks * size**2)
    areas = template.vertex_areas

    def misfit(of: GraphFit) -> float:
        """Sum the error against the scan, both ways, the strain, and twenty times the bending of the end in itself."""
        body = template.with_vertices(of.x)
        # an end hidden inside the body is near the scan everywhere, but leaves its own scan uncovered; capped at 0.05
        left = np.minimum(cKDTree(of.x).query(target.points)[0], 0.05 * size)
        strain = sum(term.value for term in terms(of.graph, of.motion, held, stage, size).values())
        bent = 20.0 * areas[end.vertices].sum() * bending(template.vertices[end.vertices], of.x[end.vertices])[0] ** 2
        there = float(scan.error(body.vertices, body.vertex_normals) @ areas)
        return there + float((left**2).mean() * areas.sum()) + strain + bent

    # from each candidate pose of the end: move the graph there, then follow the matches again
    trials = [fit]
    for places in rotate_ends(template, end, fit.x, scan):
        drawn = held + pull(len(fit.x), end.vertices, places, areas[end.vertices])
        trials.append(fit_stage(inputs, fit.minimise(drawn, stage, size, 8), replace(stage, hints=0.0, paths=0.0)))
    return min(trials, key=misfit) if len(trials) > 1 else fit
