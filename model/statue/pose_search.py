"""The pose of a control model on a scan without any features: matches of the surface in place of clicks."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanprep.matching.matches import Likeness, Target, match_both_ways
from scanprep.matching.thinning import thin
from scanprep.ranges import Cell, Count, Positive, Settings

from .articulated import Articulated


@dataclass(frozen=True)
class PoseStage(Settings):
    """Rounds of matching at one reach. Lengths are those of the control model.

    Attributes
    ----------
    reach : float, metres
        Farthest match that counts.
    prior : float, metres
        Distance to the data that an angle of one radian is worth.
    growth : float, metres
        Distance to the data that a length twice the default one is worth.
    slide : float
        Force of a match along the surface, as a share of that across it.
    detail : float, metres
        Spacing to which the scan is thinned.
    rounds : int
    """

    reach: Positive
    prior: Positive
    growth: Positive
    slide: float
    detail: Cell
    rounds: Count


COARSE = (PoseStage(0.5, 0.05, 0.2, 0.5, 0.05, 5), PoseStage(0.3, 0.03, 0.15, 0.3, 0.04, 5))
FINE = (PoseStage(0.2, 0.015, 0.1, 0.15, 0.03, 6), PoseStage(0.12, 0.01, 0.08, 0.05, 0.025, 6),
        PoseStage(0.08, 0.006, 0.05, 0.03, 0.02, 6))


class PoseSearch:
    """A control model, prepared to be posed onto scans."""

    def __init__(self, model: Articulated, normals: float = 0.06) -> None:
        self.model, self.normals = model, normals
        mesh = model.control.mesh
        self.area = float(mesh.face_areas.sum())
        self.sample = thin(mesh.vertices, 0.03)
        S = len(model.lengths)
        self.bounds = np.concatenate([model.limits, [[0.6, 1.6]] * S, [[-np.inf, np.inf]] * 3])

    def run(self, x: np.ndarray, target: Target, stages: tuple[PoseStage, ...]) -> np.ndarray:
        """Parameters (P,) that bring the control model onto the target, from a start (P,)."""
        for stage in stages:
            goal = target.thinned(stage.detail)
            for _ in range(stage.rounds):
                x = self.step(x, goal, stage)
        return x

    def step(self, x: np.ndarray, goal: Target, stage: PoseStage) -> np.ndarray:
        """One round of matching, and one Gauss-Newton step within the limits."""
        model = self.model
        frames = model.frames(x)
        vertices = model.positions(frames, model.vertices)
        wanted = match_both_ways(model.control.mesh.with_vertices(vertices), self.sample, self.area, goal,
                                 stage.reach, stage.slide, Likeness(normals=self.normals)).wanted
        D = model.derivatives(frames, model.vertices)
        H = np.einsum("nip,nij,njq->pq", D, wanted.A, D, optimize=True)
        g = np.einsum("nip,ni->p", D, np.einsum("nij,nj->ni", wanted.A, vertices) - wanted.b)
        A, S = len(model.axes), len(model.lengths)
        hold = np.zeros(len(x))
        hold[:A] = self.area * stage.prior**2
        hold[A:A + S] = self.area * stage.growth**2
        hold[:A][model.joint_of == 0] = 0
        centre = model.rest.copy()
        centre[A:A + S] = model.size(x)
        g += hold * (x - centre)
        H += np.diag(hold) + 1e-9 * np.trace(H) / len(x) * np.eye(len(x))
        return _bounded_step(x, H, g, self.bounds)


def _bounded_step(x: np.ndarray, H: np.ndarray, g: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """The minimum of a quadratic within bounds, by fixing what a step would carry beyond them."""
    free = np.ones(len(x), dtype=bool)
    step = np.zeros(len(x))
    for _ in range(4):
        step[free] = -np.linalg.solve(H[np.ix_(free, free)], g[free] + H[np.ix_(free, ~free)] @ step[~free])
        new = np.clip(x + step, *bounds.T)
        out = free & (new != x + step)
        if not out.any():
            break
        step[out] = (new - x)[out]
        free &= ~out
    return np.clip(x + step, *bounds.T)
