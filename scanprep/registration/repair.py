"""Repair registrations with anatomically impossible limbs, by trying other rolls of these limbs.

Each candidate runs for a few rounds. The most plausible one then runs to the end. It is kept if it lies on the scan as
well as before and stretches no more.
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

LESS_DOUBTED = 0.1                     # least gain in severity that counts; an issue at its limit has 1


@near_origin
@one_thread()
def repair_limbs(template: Mesh, scan: Mesh | np.ndarray, fit: Registration, parts: PersonParts | None,
                 landmarks: Landmarks | None = None, config: RegistrationConfig | None = None,
                 progress: Callable[[int, int], None] | None = None, correspondences: Correspondences | None = None
                 ) -> Registration:
    """Re-roll the implausible limbs of a registration where that is better; else return it as it is.

    Parameters
    ----------
    template, scan, landmarks, config, correspondences
        As the registration was made with.
    fit : Registration
        The registration to repair.
    parts : PersonParts, optional
        Parts of a template that is a person; with None nothing is repaired.
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
    # the last stages match by position alone, so no path descriptors are computed
    inputs = replace(prepare_problem(template, scan), landmarks=landmarks, hints=correspondences)
    coarse = [stage for stage in stages if stage.nodes == stages[0].nodes]
    graph, report_progress = build_graph(template, coarse[0].nodes), progress or (lambda done, total: None)
    candidate_rolls = other_rolls(parts, parts.skeleton.fit_rotations(template, x), doubted, config.rolls)
    start, looks = motion_of(graph, x), list[tuple[float, float, GraphFit]]()
    # run each candidate through the coarse stages, three rounds each at most, and note severity and uncovered share
    short = [replace(stage, rounds=min(stage.rounds, 3), ends=0) for stage in coarse]
    now = severity(limb_doubts(template, parts, deform(graph, start)))
    for number, angles in enumerate(candidate_rolls):
        motion = roll_parts(graph, start, template, parts, x, angles)
        begun = GraphFit(deform(graph, motion), graph=graph, motion=motion, iterations=fit.iterations)
        trial = fit_stages(inputs, begun, short)
        looks.append((severity(limb_doubts(template, parts, trial.x)),
                      share_uncovered(scan, template.with_vertices(trial.x), 0.01 * inputs.size), trial))
        report_progress(number + 1, len(candidate_rolls) + 1)
    # run the most plausible candidate to the end, if it promises a gain; keep it only if it is better
    best = min(looks, key=lambda look: look[:2], default=None)
    if best is not None and best[0] + LESS_DOUBTED < now:
        end = snap_to_surface(inputs, fit_stages(inputs, best[2], stages[len(coarse) - 1:]), config)
        trial_fit = measure_fit(inputs, end, scan)
        if better(template, parts, trial_fit, fit):
            fit = replace(trial_fit, rolled=True)
    report_progress(len(candidate_rolls) + 1, len(candidate_rolls) + 1)
    return fit


def better(template: Mesh, parts: PersonParts, trial: Registration, fit: Registration) -> bool:
    """Test whether a trial is more plausible than a fit, covers the scan as well and is no more stretched."""
    less_covered = 0.001  # loss that is tolerated: share of the scan, and landmark distance in sizes
    return (severity(limb_doubts(template, parts, trial.mesh.vertices)) + LESS_DOUBTED
            < severity(limb_doubts(template, parts, fit.mesh.vertices))
            and trial.uncovered <= fit.uncovered + less_covered
            and not trial.landmark_rms > fit.landmark_rms + less_covered * size(template)
            and strain(template, trial.mesh) <= strain(template, fit.mesh))


def severity(doubts: tuple[PlausibilityIssue, ...]) -> float:
    """Return the total severity of all issues."""
    return sum(doubt.excess for doubt in doubts)


def strain(template: Mesh, registered: Mesh) -> float:
    """Compute the RMS logarithm of principal stretches, weighted by area."""
    logs = np.log(np.maximum(principal_stretches(template, registered), 1e-3))
    return float(np.sqrt(np.average((logs**2).mean(axis=0), weights=template.face_areas)))


def roll_parts(graph: DeformationGraph, motion: NodeMotion, template: Mesh, parts: PersonParts, x: np.ndarray,
               angles: np.ndarray) -> NodeMotion:
    """Roll every part of a graph motion about its own bone by an angle (16,), radians; the bones stay in place.

    Vertices x (N, 3), metres, are the current body, from which the bones are estimated.
    """
    skeleton = parts.skeleton
    R = skeleton.fit_rotations(template, x) @ parts.R_template_rest
    # rotation of each part about its current bone, through the centroid of its vertices
    turns = rotations.exp(angles[:, None] * np.einsum("pij,pj->pi", R, frames()[:, 0]))
    part = skeleton.part_of_vertex(template)
    middles = np.stack([x[part == p].mean(axis=0) for p in range(len(angles))])
    weights = np.eye(len(angles))[part[graph.node_vertices]]
    i, j = graph.edges.T
    links = csr_array(coo_array((np.ones(len(i)), (i, j)), shape=(len(weights), len(weights))))
    mean = diags_array(1 / np.asarray(links.sum(axis=1)).ravel()) @ links
    weights = 0.5 * (weights + mean @ weights)                    # blend the roll over one link at a joint
    turned = middles + np.einsum("pij,npj->npi", turns, motion.positions[:, None] - middles)
    return replace(motion, R=rotations.project(np.einsum("np,pij->nij", weights, turns)) @ motion.R,
                   positions=np.einsum("np,npi->ni", weights, turned))
