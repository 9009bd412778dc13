"""Where a person stands in a scan of which neither up nor front is known: from rough starts to the best pose."""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.geometry.target import Target
from scanprep.geometry.thinning import thin

from .features import limb_angles, limbs
from .pose_search import COARSE, FINE, Posed, PoseSearch

CAP, NORMALS = 0.08, 0.05        # metres: of a distance, and what a difference of normals of one is worth
UNSEEN = 0.3                     # weight of the body's distances to the scan, which may show a part only
HEADINGS = 8
PART = 0.85                      # of the model's height: lower scans may be of a part of a person
TRIED, ARMS_BENT = 8, 6          # starts of the body, and of an arm, that are bent a little
RIVAL = 1.3                      # a stand that fits worse by this factor is no more than the other facing
ASTRAY = 0.01, 0.25              # shares of a scan off the body, by more than a hand: arms are in a wrong place
# Outwards, frontwards, upwards: where an upper arm may point, and a forearm, which else goes on straight.
UPPER_ARMS = ((0.4, 0, -1), (0.7, 0.4, -0.7), (0.6, -0.6, -0.7), (1, 0, 0), (0.8, 0.6, 0.2), (0.2, 1, 0), (0.8, 0, 0.7),
              (0.2, 0, 1), (0.2, 0.7, 0.7))
FOREARMS = ((0, 1, 0), (-0.75, 0.1, 0.65), (0.1, 0.1, 1), (-1, 0.4, 0))


@dataclass(frozen=True, eq=False)
class Stand:
    """A control model that stands in a scan."""

    T: np.ndarray  # (4, 4), similarity from the scan to the axes and the size of the control model
    posed: Posed
    off: float     # metres, root mean square distance of the scan from the body, at most `CAP` each, turned normals
                   # counted in
    misfit: float  # metres, the same with the distances of the body from the scan, which count less: what the best
                   # stand is chosen by

    @property
    def scale(self) -> float:
        return float(np.cbrt(np.linalg.det(self.T[:3, :3])))

    def to_scan(self, points: np.ndarray) -> np.ndarray:
        """Points (n, 3) of the control model in the axes of the scan."""
        return (points - self.T[:3, 3]) @ self.T[:3, :3] / self.scale**2

    def direction(self, search: PoseSearch, axis: np.ndarray) -> np.ndarray:
        """A direction of the root part in the scan, unit."""
        return np.asarray(search.model.frames(self.posed.x).R[0] @ axis @ self.T[:3, :3] / self.scale)


def find_person(search: PoseSearch, target: Target, metres: float) -> list[Stand]:
    """The best stand in a scan and the best one that faces another way, best first. The scan is in its own unit, of so
    many `metres`.
    """
    bent = sorted((bend(search, target, T, search.start, COARSE) for T in rough_stands(search, target, metres)[:TRIED]),
                  key=lambda stand: stand.misfit)
    best = bent[:1] + [s for s in bent[1:] if _facing(search, s) @ _facing(search, bent[0]) < 0.5][:1]
    best = sorted((bend(search, target, s.T, s.posed, FINE) for s in best), key=lambda stand: stand.misfit)
    found = [with_arms(search, target, best[0])]
    for rival in best[1:]:
        close = rival.misfit < RIVAL * found[0].misfit
        found.append(with_arms(search, target, rival) if close else rival)
    return sorted(found, key=lambda stand: stand.misfit)


def bend(search: PoseSearch, target: Target, T: np.ndarray, posed: Posed, stages: tuple) -> Stand:
    """The stand that a start leads to."""
    goal = moved(target, T).thinned(0.02)
    posed = search.run(posed, goal, stages)
    return Stand(T, posed, *misfit(search.mesh(posed), goal))


def moved(target: Target, T: np.ndarray) -> Target:
    """A target after a similarity (4, 4)."""
    turn = T[:3, :3] / np.cbrt(np.linalg.det(T[:3, :3]))
    return replace(target, points=target.points @ T[:3, :3].T + T[:3, 3], normals=target.normals @ turn.T)


def misfit(body: Mesh, goal: Target) -> tuple[float, float]:
    """How far apart a body and a scan are: `off` and `misfit` of a `Stand`."""
    there = Surface(body).closest(goal.points)
    facing = np.einsum("nd,nd->n", body.face_normals[there.faces], goal.normals)
    facing = facing if goal.oriented else np.abs(facing)
    off = np.minimum(there.distances**2 + NORMALS**2 * (1 - facing), CAP**2)
    near = cKDTree(np.hstack([goal.points, NORMALS * goal.normals]))
    back = np.minimum(near.query(np.hstack([body.vertices, NORMALS * body.vertex_normals]))[0] ** 2, CAP**2)
    unseen = float(back @ body.vertex_areas) / float(body.vertex_areas.sum())
    return float(np.sqrt(off.mean())), float(np.sqrt(off.mean() + UNSEEN * unseen))


def rough_stands(search: PoseSearch, target: Target, metres: float) -> list[np.ndarray]:
    """Similarities (4, 4) from the scan to the control model, those that bring points nearest first."""
    mesh = search.model.control.mesh
    sample = thin(mesh.vertices, 0.05)
    points, scale = mesh.vertices[sample], 2 * NORMALS
    here = np.hstack([points, scale * mesh.vertex_normals[sample]])
    tree = cKDTree(here)
    keep = thin(target.points, 0.022 * float(np.linalg.norm(np.ptp(target.points, axis=0))))
    found = []
    for T, turn in _placements(mesh, target.points[keep], metres):
        there = np.hstack([target.points[keep] @ T[:3, :3].T + T[:3, 3], scale * target.normals[keep] @ turn.T])
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
        if metres * tall < PART * (highest - lowest):
            ways += [(metres, False), (metres, True)]
        for k in range(HEADINGS if ways else 0):
            heading = rotations.exp(np.array([0, 0, 2 * np.pi * k / HEADINGS]))
            turn = heading @ np.array([right, np.cross(up, right), up])
            for scale, hangs in ways:
                placed = scale * points @ turn.T
                level = highest - placed[:, 2].max() if hangs else lowest - placed[:, 2].min()
                T = np.eye(4)
                T[:3, :3], T[:3, 3] = scale * turn, [*(middle - placed[:, :2].mean(axis=0)), level]
                yield T, turn


def with_arms(search: PoseSearch, target: Target, stand: Stand) -> Stand:
    """The same stand, with arms tried elsewhere while much of the scan lies off the body."""
    goal = moved(target, stand.T).thinned(0.02)
    coarse = goal.thinned(0.05)
    for base, middle, end in limbs(search.model):
        astray = (Surface(search.mesh(stand.posed)).closest(goal.points).distances > CAP).mean()
        if not ASTRAY[0] < astray < ASTRAY[1]:
            break
        if end is None or not _is_arm(search, base):
            continue
        starts = [_pointed(search, stand.posed, base, middle, end, np.array([upper, fore]))
                  for upper in UPPER_ARMS for fore in (upper, *FOREARMS)]
        starts.sort(key=lambda posed: misfit(search.mesh(posed), coarse)[1])
        # No coarser: from afar a hand beside the head is drawn to the head.
        tried = min((bend(search, target, stand.T, posed, FINE[1:]) for posed in starts[:ARMS_BENT]),
                    key=lambda s: s.misfit)
        stand = min(stand, bend(search, target, stand.T, tried.posed, FINE), key=lambda s: s.misfit)
    return stand


def _is_arm(search: PoseSearch, base: int) -> bool:
    """A limb whose base lies in the upper half."""
    o, z = search.model.control.skeleton.joints, search.model.control.mesh.vertices[:, 2]
    return bool(o[base, 2] > 0.5 * (z.min() + z.max()))


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


def _facing(search: PoseSearch, stand: Stand) -> np.ndarray:
    return stand.direction(search, np.array([0.0, -1, 0]))
