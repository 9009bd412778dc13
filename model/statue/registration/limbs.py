"""The start of a registration by features in closed form: every limb from its base, middle and end joints."""
from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from scanprep.geometry import rotations

from .articulated import Articulated


def limbs(model: Articulated) -> list[tuple[int, int, int | None]]:
    """Base, middle and end joint of every limb: a joint of three axes, on it one of one axis, and what it carries."""
    freedom = np.bincount(model.joint_of, minlength=len(model.control.axes))
    parents = model.control.skeleton.parents
    found = []
    for middle in range(1, len(parents)):
        base = int(parents[middle])
        if base > 0 and freedom[middle] == 1 and freedom[base] == 3:
            ends = np.flatnonzero(parents == middle)
            found.append((base, middle, int(ends[0]) if len(ends) else None))
    return found


def analytic_start(model: Articulated, at: Mapping[str, np.ndarray]) -> np.ndarray:
    """Lengths from joints that are neighbours, and each limb from its base, middle and end joints in closed form."""
    skeleton = model.control.skeleton
    o, names = skeleton.joints, skeleton.names
    x = model.rest.copy()
    angles, factors, _ = model.split(x)
    ratios: dict[int, list[float]] = {}
    for c in range(1, len(o)):
        p = skeleton.parents[c]
        if names[c] in at and names[p] in at:
            ratios.setdefault(int(model.control.segment_of_part[p]), []).append(float(
                np.linalg.norm(at[names[c]] - at[names[p]]) / max(np.linalg.norm(o[c] - o[p]), 1e-9)))
    for s, values in ratios.items():
        factors[s] = np.mean(values)
    for base, middle, end in limbs(model):
        if names[base] in at and names[middle] in at:
            goal = [at[names[middle]] - at[names[base]]]
            if end is not None and names[end] in at:
                goal.append(at[names[end]] - at[names[middle]])
            angles[model.joint_of == base], angles[model.joint_of == middle] = limb_angles(
                model, base, middle, end, np.array(goal))
    return x


def limb_angles(model: Articulated, base: int, middle: int, end: int | None, goal: np.ndarray
                ) -> tuple[np.ndarray, float]:
    """Angles (3,) of the base joint and that of the middle one that point one or two bones along directions.

    Parameters
    ----------
    base, middle, end : int
        Joints; `end` counts with two directions.
    goal : (1 or 2, 3) float
        In the axes of the part that the base joint is on.
    """
    o, of_base, hinge = model.control.skeleton.joints, model.joint_of == base, model.joint_of == middle
    rest = np.array([o[middle] - o[base], *([o[end] - o[middle]] if len(goal) == 2 else [])])
    return _limb(_unit(rest), _unit(goal), model.axes[of_base], model.axes[hinge][0], model.limits[of_base],
                 model.limits[hinge][0])


def _limb(rest: np.ndarray, goal: np.ndarray, axes: np.ndarray, hinge: np.ndarray, limits: np.ndarray,
          hinge_limits: np.ndarray) -> tuple[np.ndarray, float]:
    """Angles (3,) of the base and that of the hinge that turn one or two bones (1 or 2, 3), unit, to their goals.

    A hinge has two angles at which the bones enclose the right one: of these the one that is farther inside the
    limits of both joints, or else nearer to the default pose.
    """
    bends = _bends(hinge, rest[0], rest[1], float(goal[0] @ goal[1])) if len(goal) == 2 else np.zeros(1)
    tried = []
    for bend in bends:
        allowed = float(np.clip(bend, *hinge_limits))
        turned = np.concatenate([rest[:1], rest[1:] @ rotations.exp(allowed * hinge).T])
        # The identity decides how a straight limb is turned about itself.
        H = goal.T @ turned + 1e-3 * np.eye(3)
        angles = np.linalg.solve(axes.T, rotations.log(rotations.project(H[None])[0]))
        beyond = np.abs(angles - np.clip(angles, *limits.T)).sum() + abs(bend - allowed)
        tried.append((round(float(beyond), 3), abs(allowed), allowed, angles))
    _, _, bend, angles = min(tried, key=lambda t: t[:2])
    return angles, bend


def _bends(axis: np.ndarray, first: np.ndarray, second: np.ndarray, cosine: float) -> np.ndarray:
    """The two angles of a hinge at which two bones, unit, enclose an angle of the given cosine, or come nearest."""
    still = (first @ axis) * (axis @ second)
    a, b = first @ second - still, first @ np.cross(axis, second)
    middle, half = np.arctan2(b, a), np.arccos(np.clip((cosine - still) / max(np.hypot(a, b), 1e-12), -1, 1))
    return (np.array([middle - half, middle + half]) + np.pi) % (2 * np.pi) - np.pi


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12)
