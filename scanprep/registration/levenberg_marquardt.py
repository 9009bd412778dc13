"""Levenberg-Marquardt over the motion of a deformation graph."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csc_array, diags_array

from ..geometry.sparse import factor
from .deformation_graph import DeformationGraph, NodeMotion
from .energies import UNKNOWNS, NodePattern, Pull, Term, bend_term, data_term, growth_term, stretch_term


@dataclass(frozen=True)
class Stiffness:
    """How much the nodes resist, each in metres of distance to the data."""

    stretch: float
    bend: float
    growth: float


def terms(graph: DeformationGraph, motion: NodeMotion, wanted: Pull, stiffness: Stiffness) -> dict[str, Term]:
    """All terms of the energy at one state."""
    return {"data": data_term(graph, motion, wanted),
            "stretch": stretch_term(graph, motion, stiffness.stretch),
            "bend": bend_term(graph, motion, stiffness.bend),
            "growth": growth_term(graph, motion, stiffness.growth)}


@dataclass(frozen=True, eq=False)
class Descent:
    """The end of a minimisation: the motion, the energy of each term, steps taken, whether it settled."""

    motion: NodeMotion
    energies: dict[str, float]
    iterations: int
    converged: bool


def minimise(graph: DeformationGraph, pattern: NodePattern, motion: NodeMotion, wanted: Pull, stiffness: Stiffness,
             iterations: int, tolerance: float = 1e-4) -> Descent:
    """Levenberg-Marquardt over the motion of all nodes.

    Parameters
    ----------
    tolerance : float
        Relative decrease of the energy below which it has settled.
    """
    damping, done, settled = 1e-5, 0, False
    now = terms(graph, motion, wanted, stiffness)
    value = sum(term.value for term in now.values())
    while done < iterations and not settled and damping < 1e3:
        normal = [term.normal(pattern) for term in now.values()]
        H = pattern.matrix(np.sum([blocks for blocks, _ in normal], axis=0))
        gradient = np.sum([half for _, half in normal], axis=0).reshape(-1)
        diagonal = H.diagonal()
        for _ in range(8):
            added = damping * diagonal + 1e-9 * diagonal.max()
            step = -factor(H + csc_array(diags_array(added)))(gradient).reshape(-1, UNKNOWNS)
            trial = motion.moved(step)
            ahead = terms(graph, trial, wanted, stiffness)
            ahead_value = sum(term.value for term in ahead.values())
            if ahead_value <= value:
                break
            damping = max(damping, 1e-5) * 10
        else:
            break
        settled = value - ahead_value <= tolerance * value
        motion, now, value, damping, done = trial, ahead, ahead_value, damping / 5, done + 1
    return Descent(motion, {name: term.value for name, term in now.items()}, done, settled)
