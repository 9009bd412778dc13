"""A registration in which limbs came to lie as no person's do, with other rolls of these limbs.

Each is followed for a few rounds. The one that leaves the least to doubt then is followed to the end, and kept if it
lies on the scan and stretches no more than what was there.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.sparse import coo_array, csr_array, diags_array

from ..correspondence.correspondences import Correspondences
from ..geometry import rotations
from ..geometry.mesh import Mesh
from ..judgement import size
from ..threads import one_thread
from .deformation_graph import DeformationGraph, NodeMotion, build_graph, deform, motion_of
from .graph_fit import GraphFit, fit_stages
from .limbs import PlausibilityIssue, frames, limb_doubts
from .matches import Landmarks, prepare_problem
from .nonrigid import Registration, measure_fit, near_origin, principal_stretches, share_uncovered, snap_to_surface
from .person import PersonParts
from .rolls import other_rolls
from .schedule import RegistrationConfig

LESS_DOUBTED = 0.1                     # 1 is a doubt where it begins


@near_origin
@one_thread()
def repair_limbs(template: Mesh, scan: Mesh | np.ndarray, fit: Registration, parts: PersonParts | None,
                 landmarks: Landmarks | None = None, config: RegistrationConfig | None = None,
                 progress: Callable[[int, int], None] | None = None, correspondences: Correspondences | None = None
                 ) -> Registration:
    """A registration with its doubted limbs rolled otherwise, where that is better; else as it is.

    Parameters
    ----------
    template, scan, landmarks, config, correspondences
        As the registration was made with.
    fit : Registration
    parts : PersonParts, optional
        Of a template that is a person; where there are none, nothing is repaired.
    progress : callable, optional
        Called as progress(done, total).

    Returns
    -------
    Registration
    """
    config = config or RegistrationConfig()
    stages = config.near_stages
    x = fit.mesh.vertices
    if parts is None or not config.rolls or not stages:
        return fit
    doubted = list(dict.fromkeys(doubt.part for doubt in limb_doubts(template, parts, x)))
    if not doubted:
        return fit
    # the last stages match by positions alone: no path to landmarks or hints is needed
    inputs = replace(prepare_problem(template, scan), landmarks=landmarks, hints=correspondences)
    coarse = [stage for stage in stages if stage.nodes == stages[0].nodes]
    graph, tell = build_graph(template, coarse[0].nodes), progress or (lambda done, total: None)
    tries = other_rolls(parts, parts.skeleton.fit_rotations(template, x), doubted, config.rolls)
    start, looks = motion_of(graph, x), list[tuple[float, float, GraphFit]]()
    # what becomes of each in the coarse stages, cut short to three rounds: how much is to be doubted, and the share of
    # the scan off it; with as little detail as the rolls are looked at with
    short = [replace(stage, rounds=min(stage.rounds, 3), ends=0) for stage in coarse]
    now = severity(limb_doubts(template, parts, deform(graph, start)))
    for number, angles in enumerate(tries):
        motion = roll_parts(graph, start, template, parts, x, angles)
        begun = GraphFit(deform(graph, motion), graph=graph, motion=motion, iterations=fit.iterations)
        trial = fit_stages(inputs, begun, short)
        looks.append((severity(limb_doubts(template, parts, trial.x)),
                      share_uncovered(scan, template.with_vertices(trial.x), 0.01 * inputs.size), trial))
        tell(number + 1, len(tries) + 1)
    best = min(looks, key=lambda look: look[:2], default=None)
    if best is not None and best[0] + LESS_DOUBTED < now:
        end = snap_to_surface(inputs, fit_stages(inputs, best[2], stages[len(coarse) - 1:]), config)
        found = measure_fit(inputs, end, scan)
        if better(template, parts, found, fit):
            fit = replace(found, rolled=True)
    tell(len(tries) + 1, len(tries) + 1)
    return fit


def better(template: Mesh, parts: PersonParts, trial: Registration, fit: Registration) -> bool:
    """Whether less is to be doubted in a registration than in another, on the scan as well and no more stretched."""
    less_covered = 0.001  # share of the scan
    return (severity(limb_doubts(template, parts, trial.mesh.vertices)) + LESS_DOUBTED
            < severity(limb_doubts(template, parts, fit.mesh.vertices))
            and trial.uncovered <= fit.uncovered + less_covered
            and not trial.landmark_rms > fit.landmark_rms + less_covered * size(template)
            and strain(template, trial.mesh) <= strain(template, fit.mesh))


def severity(doubts: tuple[PlausibilityIssue, ...]) -> float:
    """How much is to be doubted in all."""
    return sum(doubt.excess for doubt in doubts)


def strain(template: Mesh, registered: Mesh) -> float:
    """The root mean square over the area of the logarithm of stretches."""
    logs = np.log(np.maximum(principal_stretches(template, registered), 1e-3))
    return float(np.sqrt(np.average((logs**2).mean(axis=0), weights=template.face_areas)))


def roll_parts(graph: DeformationGraph, motion: NodeMotion, template: Mesh, parts: PersonParts, x: np.ndarray,
               angles: np.ndarray) -> NodeMotion:
    """A motion of nodes with every part rolled about its own bone by an angle (16,), radians, the bone left in place.

    Vertices x (N, 3), metres, tell where the bones are.
    """
    skeleton = parts.skeleton
    R = skeleton.fit_rotations(template, x) @ parts.R_template_rest
    turns = rotations.exp(angles[:, None] * np.einsum("pij,pj->pi", R, frames()[:, 0]))
    part = skeleton.part_of_vertex(template)
    middles = np.stack([x[part == p].mean(axis=0) for p in range(len(angles))])
    weights = np.eye(len(angles))[part[graph.node_vertices]]
    i, j = graph.edges.T
    links = csr_array(coo_array((np.ones(len(i)), (i, j)), shape=(len(weights), len(weights))))
    mean = diags_array(1 / np.asarray(links.sum(axis=1)).ravel()) @ links
    weights = 0.5 * (weights + mean @ weights)                    # a roll sets in over one link at a joint
    turned = middles + np.einsum("pij,npj->npi", turns, motion.positions[:, None] - middles)
    return replace(motion, R=rotations.project(np.einsum("np,pij->nij", weights, turns)) @ motion.R,
                   positions=np.einsum("np,npi->ni", weights, turned))
