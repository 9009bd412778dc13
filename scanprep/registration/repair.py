"""A registration in which limbs came to lie as no person's do, with other rolls of these limbs.

The last stages are followed to the end from each, and what leaves the least to doubt is kept, if it lies on the scan
and stretches no more than what was there.
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
from .deformation_graph import DeformationGraph, build_graph
from .graph_fit import GraphFit, NodeMotion, deform, followed
from .limbs import Doubt, frames, limb_doubts, limb_measures
from .matches import Landmarks, prepare
from .nonrigid import Registration, finished, measured, principal_stretches
from .person import PersonParts
from .rolls import other_rolls
from .schedule import RegistrationConfig

LESS_DOUBTED = 0.1                     # 1 is a doubt where it begins
LESS_COVERED = 0.001                   # share of the scan
EASED = 1                              # links over which a roll sets in at a joint


@one_thread()
def repaired(template: Mesh, scan: Mesh | np.ndarray, fit: Registration, parts: PersonParts | None,
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
    stages = tuple(stage for stage in config.graph if stage.positions == 1 and not stage.paths and stage.reach)
    x = fit.mesh.vertices
    if parts is None or not config.rolls or not stages or not (doubted := _doubted(template, parts, x)):
        return fit
    tries = other_rolls(parts, parts.skeleton.fit_rotations(template, x), doubted, config.rolls)
    given, graph = prepare(template, scan, landmarks, correspondences), build_graph(template, stages[0].nodes)
    start, best = motion_of(graph, x), fit
    for number, angles in enumerate(tries):
        motion = rolled(graph, start, template, parts, x, angles)
        begun = GraphFit(deform(graph, motion), graph, motion, iterations=best.iterations)
        trial = measured(given, finished(given, followed(given, begun, stages, config.ends, _silent), config), scan)
        if better(template, parts, trial, best):
            best = replace(trial, rolled=True)
        if progress:
            progress(number + 1, len(tries))
        if best is not fit and not _doubted(template, parts, best.mesh.vertices):
            break
    return best


def _doubted(template: Mesh, parts: PersonParts, x: np.ndarray) -> list[int]:
    """The parts of vertices (N, 3) that lie as no person's do, the gravest first."""
    return limb_measures(template, parts, x).doubted(parts.skeleton)


def _silent(steps: int) -> None:
    """Steps within a try are not told."""


def better(template: Mesh, parts: PersonParts, trial: Registration, fit: Registration) -> bool:
    """Whether less is to be doubted in a registration than in another, on the scan as well and no more stretched."""
    return (gravity(limb_doubts(template, parts, trial.mesh.vertices)) + LESS_DOUBTED
            < gravity(limb_doubts(template, parts, fit.mesh.vertices))
            and trial.uncovered <= fit.uncovered + LESS_COVERED
            and not trial.landmark_rms > fit.landmark_rms + LESS_COVERED * size(template)
            and strain(template, trial.mesh) <= strain(template, fit.mesh))


def gravity(doubts: tuple[Doubt, ...]) -> float:
    """How much is to be doubted in all."""
    return sum(doubt.excess for doubt in doubts)


def strain(template: Mesh, registered: Mesh) -> float:
    """The root mean square over the area of the logarithm of stretches."""
    logs = np.log(np.maximum(principal_stretches(template, registered), 1e-3))
    return float(np.sqrt(np.average((logs**2).mean(axis=0), weights=template.face_areas)))


def motion_of(graph: DeformationGraph, x: np.ndarray) -> NodeMotion:
    """The motion of the nodes that takes the template to vertices (N, 3), metres: what best carries their links."""
    i, j = graph.edges.T
    at = x[graph.node_vertices]
    now, rest = at[j] - at[i], graph.edge_vectors
    gather = csr_array(coo_array((np.ones(len(i)), (i, np.arange(len(i)))), shape=(len(at), len(i))))
    R = rotations.project((gather @ np.einsum("ei,ej->eij", now, rest).reshape(-1, 9)).reshape(-1, 3, 3))
    grown = gather @ (now**2).sum(axis=1) / (gather @ (rest**2).sum(axis=1))
    return NodeMotion(R, 0.5 * np.log(grown), at)


def rolled(graph: DeformationGraph, motion: NodeMotion, template: Mesh, parts: PersonParts, x: np.ndarray,
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
    for _ in range(EASED):
        weights = 0.5 * (weights + mean @ weights)
    turned = middles + np.einsum("pij,npj->npi", turns, motion.positions[:, None] - middles)
    return replace(motion, R=rotations.project(np.einsum("np,pij->nij", weights, turns)) @ motion.R,
                   positions=np.einsum("np,npi->ni", weights, turned))
