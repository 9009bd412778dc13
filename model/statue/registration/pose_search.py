"""The pose of a control model on a scan without any features: matches of the surface in place of clicks."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.target import Target, orient
from scanprep.geometry.thinning import thin
from scanprep.ranges import Cell, Count, Positive, Settings
from scanprep.registration.energies import Pull, pull
from scanprep.registration.matches import Described, Likeness, tukey

from .articulated import Articulated, Points

BOUNDS = 0.6, 1.6               # of a length, as multiples of the default one
GIRTH = -0.03, 0.12             # metres off the default surface
ELSEWHERE = 0.25                 # metres between places on the body that are not taken for each other


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


@dataclass(frozen=True, eq=False)
class Posed:
    """A control model on its way to a scan."""

    x: np.ndarray      # (P,), parameters
    girth: np.ndarray  # (S,) metres, how far the surface of every segment stands off the default one: people are not
                       # equally thick


class PoseSearch:
    """A control model, prepared to be posed onto scans.

    Matches in both directions draw its surface; what they want of the parameters is solved for within the limits of
    the joints, one Gauss-Newton step a round. Between the steps every segment grows thicker or thinner.
    """

    def __init__(self, model: Articulated, normals: float = 0.06) -> None:
        self.model, self.normals = model, normals
        mesh = model.control.mesh
        self.area = float(mesh.face_areas.sum())
        self.sample = thin(mesh.vertices, 0.03)
        self.segments = model.control.weights @ model.is_of
        self.bounds = np.concatenate([model.limits, np.tile(BOUNDS, (len(model.lengths), 1)), [[-np.inf, np.inf]] * 3])

    @property
    def start(self) -> Posed:
        return Posed(self.model.rest, np.zeros(len(self.model.lengths)))

    def points(self, girth: np.ndarray) -> Points:
        """All vertices of a body so thick, in the default pose."""
        mesh = self.model.control.mesh
        thicker = (self.segments @ girth)[:, None] * mesh.vertex_normals
        return Points(self.model.control.weights, mesh.vertices + thicker)

    def mesh(self, posed: Posed) -> Mesh:
        """The control mesh as it lies."""
        vertices = self.model.positions(self.model.frames(posed.x), self.points(posed.girth))
        return self.model.control.mesh.with_vertices(vertices)

    def run(self, posed: Posed, target: Target, stages: tuple[PoseStage, ...]) -> Posed:
        """Bring the control model onto a target that has its size and stands near it."""
        for stage in stages:
            goal = target.thinned(stage.detail)
            for _ in range(stage.rounds):
                posed = self.step(posed, goal, stage)
        return posed

    def step(self, posed: Posed, goal: Target, stage: PoseStage) -> Posed:
        """One round of matching, one step of the parameters, then of the girth."""
        model, x = self.model, posed.x
        frames, points = model.frames(x), self.points(posed.girth)
        mesh = model.control.mesh.with_vertices(model.positions(frames, points))
        wanted = self.wanted(mesh, goal, stage)
        D = model.derivatives(frames, points)
        rows = D.reshape(-1, len(x))
        H = rows.T @ (wanted.A @ D).reshape(-1, len(x))
        g = rows.T @ (np.einsum("nij,nj->ni", wanted.A, mesh.vertices) - wanted.b).ravel()
        A, S = len(model.axes), len(model.lengths)
        hold, centre = np.zeros(len(x)), model.rest.copy()
        hold[:A] = self.area * stage.prior**2 * (model.joint_of != 0)
        hold[A:A + S] = self.area * stage.growth**2
        centre[A:A + S] = model.size(x)
        H += np.diag(hold) + 1e-9 * np.trace(H) / len(x) * np.eye(len(x))
        moved = _bounded_step(x, H, g + hold * (x - centre), self.bounds)
        off = wanted.b - np.einsum("nij,nj->ni", wanted.A, mesh.vertices + D @ (moved - x))
        outward = mesh.vertex_normals
        weight = np.einsum("ni,nij,nj->n", outward, wanted.A, outward)
        more = (self.segments.T @ np.einsum("ni,ni->n", outward, off)) / (self.segments.T @ weight + 0.02 * self.area)
        return Posed(moved, np.clip(posed.girth + more, *GIRTH))

    def wanted(self, mesh: Mesh, goal: Target, stage: PoseStage) -> Pull:
        """What matches in both directions want of the vertices.

        A match of a vertex counts where its point of the scan, in turn, chooses a vertex nearby on the body: a forearm
        that was not scanned is not drawn to the hip.
        """
        goal = orient(goal, mesh, self.normals)
        like, N = Likeness(normals=self.normals), len(mesh.vertices)
        mine = Described(mesh.vertices, mesh.vertex_normals)
        theirs = Described(goal.points, goal.normals)
        chosen, far = theirs.matched(mine, stage.reach, like)
        p = np.flatnonzero(chosen >= 0)
        wanted = pull(N, chosen[p], goal.points[p], self.area / len(goal.points) * tukey(far[p], stage.reach),
                      goal.normals[p], stage.slide)
        found, far = mine.of(self.sample).matched(theirs, stage.reach, like)
        rest = self.model.control.mesh.vertices
        apart = np.linalg.norm(rest[self.sample] - rest[chosen[found]], axis=1)
        good = (found >= 0) & (chosen[found] >= 0) & ~goal.border[found] & (apart < max(2 * stage.reach, ELSEWHERE))
        weights = self.area / len(self.sample) * tukey(far[good], stage.reach)
        return wanted + pull(N, self.sample[good], goal.points[found[good]], weights, goal.normals[found[good]],
                             stage.slide)


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
