"""Registration by rigid links: neighbouring nodes hold each other in their relative pose [Hahnel].

Matches are point to point; nodes rotate and move but keep their size.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.sparse import csc_array, diags_array

from ..geometry.sparse import factor
from .deformation_graph import NodeMotion, deform
from .energies import UNKNOWNS, Pull, Term, bend_term, data_term, node_pattern, stretch_term
from .graph_fit import NORMALS, GraphFit, mean_move, start_fit
from .inputs import Inputs
from .matches import Likeness, match_both_ways
from .schedule import RigidLinkStage

BEND = 0.1                    # of the length of the links: length over which rotations are held alike


def rigid_link_fit(given: Inputs, T: np.ndarray, stages: Sequence[RigidLinkStage], tell: Callable[[int], None]
                   ) -> GraphFit:
    """The template bent onto the scan by all stages, from where a rigid transform (4, 4) places it."""
    size, everywhere = given.size, np.arange(len(given.template.vertices))
    fit = start_fit(given, T, stages[0].nodes)
    for stage in stages:
        fit = fit.refined(given, stage.nodes)
        for _ in range(stage.rounds):
            wanted = given.landmark_pull(stage.landmarks)
            if stage.reach:
                wanted += match_both_ways(given.template.with_vertices(fit.x), everywhere, size**2, given.target,
                                          stage.reach * size, 1.0, Likeness(normals=NORMALS * size))
            if wanted.A.any():
                fit = linked(fit, wanted, stage.length * size)
        tell(stage.rounds)
    return fit


def linked(fit: GraphFit, wanted: Pull, length: float) -> GraphFit:
    """The fit after damped Gauss-Newton steps over rotations and places of all nodes."""
    graph, pattern, motion = fit.graph, node_pattern(fit.graph), fit.motion
    lock = np.zeros(UNKNOWNS)
    lock[3] = 1.0                                                     # of the scale

    def terms(m: NodeMotion) -> list[Term]:
        return [data_term(graph, m, wanted), stretch_term(graph, m, length), bend_term(graph, m, BEND * length)]

    now, damping = terms(motion), 1e-5
    for _ in range(3):
        normal = [term.normal(pattern) for term in now]
        H = pattern.matrix(np.sum([blocks for blocks, _ in normal], axis=0))
        half = np.sum([g for _, g in normal], axis=0)
        half[:, 3] = 0
        most = H.diagonal().max()
        hold = damping * H.diagonal() + 1e-9 * most + 1e6 * most * np.tile(lock, len(half))
        step = -factor(csc_array(H + diags_array(hold)))(half.reshape(-1)).reshape(-1, UNKNOWNS)
        step[:, 3] = 0
        ahead = terms(motion.moved(step))
        if sum(t.value for t in ahead) > sum(t.value for t in now):
            damping *= 100
            continue
        motion, now, damping = motion.moved(step), ahead, max(damping / 10, 1e-7)
    x = deform(graph, motion)
    return replace(fit, x=x, motion=motion, energies={"data": wanted.energy(x)}, iterations=fit.iterations + 1,
                   moved=mean_move(fit.x, x))
