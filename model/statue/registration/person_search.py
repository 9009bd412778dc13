"""Where and how a person stands in a scan of which neither up nor front is known: rough starts, then the best pose."""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from scanprep.geometry import rotations
from scanprep.geometry.farthest_points import thin
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.geometry.target import Target, orient
from scanprep.registration.matches import Described, Likeness, Pull, pull, tukey

from .articulated import Articulated, Points
from .features import limb_angles, limbs


class PoseStage(NamedTuple):
    """Rounds of matching at one reach; lengths are metres of the control model."""

    reach: float   # farthest match that counts
    prior: float   # distance to the data that an angle of one radian is worth
    growth: float  # distance to the data that a length twice the default one is worth
    slide: float   # force of a match along the surface, as a share of that across it
    detail: float  # spacing to which the scan is thinned
    rounds: int


COARSE = (PoseStage(0.5, 0.05, 0.2, 0.5, 0.05, 5), PoseStage(0.3, 0.03, 0.15, 0.3, 0.04, 5))
FINE = (PoseStage(0.2, 0.015, 0.1, 0.15, 0.03, 6), PoseStage(0.12, 0.01, 0.08, 0.05, 0.025, 6),
        PoseStage(0.08, 0.006, 0.05, 0.03, 0.02, 6))


@dataclass(frozen=True, eq=False)
class Posed:
    """A control model on its way to a scan: parameters (P,), and how far every segment's surface stands off the default
    one, (S,) metres.
    """

    x: np.ndarray
    girth: np.ndarray


class PoseSearch:
    """A control model, prepared to be posed onto scans.

    Matches in both directions draw its surface; what they want of the parameters is solved for within the limits of
    the joints, one Gauss-Newton step a round. Between the steps every segment grows thicker or thinner.
    """

    def __init__(self, model: Articulated) -> None:
        self.model, self.normals = model, 0.06      # metres that a difference of normals of one is worth in matching
        mesh = model.control.mesh
        self.area = float(mesh.face_areas.sum())
        self.sample = thin(mesh.vertices, 0.03)
        self.segments = model.control.weights @ model.is_of
        # lengths from 0.6 to 1.6 of the default ones
        self.bounds = np.concatenate([model.limits, [[0.6, 1.6]] * len(model.lengths), [[-np.inf, np.inf]] * 3])

    def points(self, girth: np.ndarray) -> Points:
        """All vertices of a body so thick, in the default pose."""
        mesh, off = self.model.control.mesh, (self.segments @ girth)[:, None]
        return Points(self.model.control.weights, mesh.vertices + off * mesh.vertex_normals)

    def mesh(self, posed: Posed) -> Mesh:
        """The control mesh as it lies."""
        vertices = self.model.positions(self.model.frames(posed.x), self.points(posed.girth))
        return self.model.control.mesh.with_vertices(vertices)

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
        return Posed(moved, np.clip(posed.girth + more, -0.03, 0.12))              # metres off the default surface

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
        # metres: not taken for each other
        good = (found >= 0) & (chosen[found] >= 0) & ~goal.border[found] & (apart < max(2 * stage.reach, 0.25))
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


CAP, NORMALS = 0.08, 0.05        # metres: of a distance, and what a difference of normals of one is worth
# Outwards, frontwards, upwards: where an upper arm may point, and a forearm, which else goes on straight.
UPPER_ARMS = ((0.4, 0, -1), (0.7, 0.4, -0.7), (0.6, -0.6, -0.7), (1, 0, 0), (0.8, 0.6, 0.2), (0.2, 1, 0), (0.8, 0, 0.7),
              (0.2, 0, 1), (0.2, 0.7, 0.7))
FOREARMS = ((0, 1, 0), (-0.75, 0.1, 0.65), (0.1, 0.1, 1), (-1, 0.4, 0))


@dataclass(frozen=True, eq=False)
class Stand:
    """A control model that stands in a scan."""

    T: np.ndarray  # (4, 4), similarity from the scan to the axes and the size of the control model
    posed: Posed
    off: float     # metres, RMS distance of the scan from the body, at most `CAP` each, with what normals differ
    misfit: float  # metres, the same with the body from the scan, which counts less: the best stand has the least

    @property
    def scale(self) -> float:
        return float(np.cbrt(np.linalg.det(self.T[:3, :3])))

    def to_scan(self, points: np.ndarray) -> np.ndarray:
        """Points (n, 3) of the control model in the axes of the scan."""
        return (points - self.T[:3, 3]) @ self.T[:3, :3] / self.scale**2

    def facing(self, search: PoseSearch) -> np.ndarray:
        """(3,) unit, to where the root part looks in the scan: -y of the control model."""
        return -np.asarray(search.model.frames(self.posed.x).R[0][:, 1] @ self.T[:3, :3] / self.scale)


def find_person(search: PoseSearch, target: Target, metres: float) -> list[Stand]:
    """The best stand in a scan whose unit is so many `metres`, and the best that faces another way."""
    by_misfit, start = attrgetter("misfit"), Posed(search.model.rest, np.zeros(len(search.model.lengths)))
    bent = sorted((bend(search, target, T, start, COARSE) for T in rough_stands(search, target, metres)[:8]),
                  key=by_misfit)
    front = bent[0].facing(search)
    best = bent[:1] + [s for s in bent[1:] if s.facing(search) @ front < 0.5][:1]
    best = sorted((bend(search, target, s.T, s.posed, FINE) for s in best), key=by_misfit)
    found = [with_arms(search, target, best[0])]
    for rival in best[1:]:
        close = rival.misfit < 1.3 * found[0].misfit    # what fits worse is no more than the other facing
        found.append(with_arms(search, target, rival) if close else rival)
    return sorted(found, key=by_misfit)


def bend(search: PoseSearch, target: Target, T: np.ndarray, posed: Posed, stages: tuple[PoseStage, ...]) -> Stand:
    """The stand that a start leads to."""
    goal = moved(target, T).thinned(0.02)
    for stage in stages:
        near = goal.thinned(stage.detail)
        for _ in range(stage.rounds):
            posed = search.step(posed, near, stage)
    return Stand(T, posed, *misfit(search.mesh(posed), goal))


def moved(target: Target, T: np.ndarray) -> Target:
    """A target after a similarity (4, 4)."""
    R = T[:3, :3] / np.cbrt(np.linalg.det(T[:3, :3]))
    return replace(target, points=target.points @ T[:3, :3].T + T[:3, 3], normals=target.normals @ R.T)


def misfit(body: Mesh, goal: Target) -> tuple[float, float]:
    """How far apart a body and a scan are: `off` and `misfit` of a `Stand`."""
    there = Surface(body).closest(goal.points)
    facing = np.einsum("nd,nd->n", body.face_normals[there.faces], goal.normals)
    facing = facing if goal.oriented else np.abs(facing)
    off = np.minimum(there.distances**2 + NORMALS**2 * (1 - facing), CAP**2)
    near = cKDTree(np.hstack([goal.points, NORMALS * goal.normals]))
    back = np.minimum(near.query(np.hstack([body.vertices, NORMALS * body.vertex_normals]))[0] ** 2, CAP**2)
    unseen = float(back @ body.vertex_areas) / float(body.vertex_areas.sum())
    return float(np.sqrt(off.mean())), float(np.sqrt(off.mean() + 0.3 * unseen))      # it may show a part only


def rough_stands(search: PoseSearch, target: Target, metres: float) -> list[np.ndarray]:
    """Similarities (4, 4) from the scan to the control model, those that bring points nearest first."""
    mesh = search.model.control.mesh
    sample = thin(mesh.vertices, 0.05)
    points, scale = mesh.vertices[sample], 2 * NORMALS
    here = np.hstack([points, scale * mesh.vertex_normals[sample]])
    tree = cKDTree(here)
    keep = thin(target.points, 0.022 * float(np.linalg.norm(np.ptp(target.points, axis=0))))
    found = []
    for T, R in _placements(mesh, target.points[keep], metres):
        there = np.hstack([target.points[keep] @ T[:3, :3].T + T[:3, 3], scale * target.normals[keep] @ R.T])
        apart = np.minimum(tree.query(there)[0], 4 * CAP), np.minimum(cKDTree(there).query(here)[0], 4 * CAP)
        found.append((float(np.mean(apart[0] ** 2) + 0.5 * np.mean(apart[1] ** 2)), T))
    return [T for _, T in sorted(found, key=lambda pair: pair[0])]


def _placements(body: Mesh, points: np.ndarray, metres: float) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Similarities and their rotations: every axis may be up, the front anywhere, and a low scan may be a part."""
    lowest, highest = body.vertices[:, 2].min(), body.vertices[:, 2].max()
    middle = body.vertices[:, :2].mean(axis=0)
    directions: list[np.ndarray] = []
    for axis in [*np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2], *np.eye(3)]:
        directions += [way * axis for way in (1, -1) if all(way * axis @ other < 0.94 for other in directions)]
    for up in directions:
        right = np.cross(up, np.eye(3)[np.abs(up).argmin()])
        right /= np.linalg.norm(right)
        tall = float(np.ptp(points @ up))
        whole = (highest - lowest) / tall
        ways = [(whole, False)] if 0.7 < metres / whole < 1.3 else []
        if metres * tall < 0.85 * (highest - lowest):    # lower scans may be of a part of a person
            ways += [(metres, False), (metres, True)]
        for k in range(8 if ways else 0):
            heading = rotations.exp(np.array([0, 0, 2 * np.pi * k / 8]))
            R = heading @ np.array([right, np.cross(up, right), up])
            for scale, hangs in ways:
                placed = scale * points @ R.T
                level = highest - placed[:, 2].max() if hangs else lowest - placed[:, 2].min()
                T = np.eye(4)
                T[:3, :3], T[:3, 3] = scale * R, [*(middle - placed[:, :2].mean(axis=0)), level]
                yield T, R


def with_arms(search: PoseSearch, target: Target, stand: Stand) -> Stand:
    """The same stand, with arms tried elsewhere while much of the scan lies off the body."""
    goal = moved(target, stand.T).thinned(0.02)
    coarse = goal.thinned(0.05)
    o, z = search.model.control.skeleton.joints, search.model.control.mesh.vertices[:, 2]
    for base, middle, end in limbs(search.model):
        astray = (Surface(search.mesh(stand.posed)).closest(goal.points).distances > CAP).mean()
        if not 0.01 < astray < 0.25:    # of the scan off the body by more than a hand: arms are in a wrong place
            break
        if end is None or o[base, 2] <= 0.5 * (z.min() + z.max()):      # a leg
            continue
        starts = [_pointed(search, stand.posed, base, middle, end, np.array([upper, fore]))
                  for upper in UPPER_ARMS for fore in (upper, *FOREARMS)]
        starts.sort(key=lambda posed: misfit(search.mesh(posed), coarse)[1])
        # No coarser: from afar a hand beside the head is drawn to the head.
        tried = min((bend(search, target, stand.T, posed, FINE[1:]) for posed in starts[:6]),
                    key=attrgetter("misfit"))
        stand = min(stand, bend(search, target, stand.T, tried.posed, FINE), key=attrgetter("misfit"))
    return stand


def _pointed(search: PoseSearch, posed: Posed, base: int, middle: int, end: int, arm: np.ndarray) -> Posed:
    """The same pose but for one arm, whose two bones point outwards, frontwards and upwards as told."""
    model, x = search.model, posed.x.copy()
    skeleton = model.control.skeleton
    side = np.sign(skeleton.joints[base, 0]) or 1.0
    above = model.frames(x).R[skeleton.parents[base]]
    goal = arm * [side, -1, 1] @ model.frames(x).R[0].T @ above
    of_base, hinge = model.joint_of == base, model.joint_of == middle
    angles = model.split(x)[0]
    angles[np.isin(model.joint_of, np.flatnonzero(skeleton.descends[:, middle]))] = 0
    angles[of_base], angles[hinge] = limb_angles(model, base, middle, end, goal)
    A = len(angles)
    x[:A] = np.clip(x[:A], *model.limits.T)
    return Posed(x, posed.girth)
