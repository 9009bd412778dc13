"""Retargeting of trunks: any number of joints to any number of parts."""
from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from scanprep.geometry import rotations

from .moving import MovingSkeleton


def group_trunk(moving: MovingSkeleton, joints: Sequence[int], starts: Sequence[int], parts: Sequence[int],
                carried: Sequence[int]) -> tuple[dict[int, np.ndarray], dict[int, str]]:
    """Compute rotations (T, 3, 3) for fewer parts than joints of a trunk, and what each follows.

    Each part stands for the joints from one of `starts` to the next, and carries the next part as these joints do. The
    last part carries the `carried` joints, neck and shoulders, as nearly as one rotation can.
    """
    rest, R, y = moving.rest, moving.rotations, moving.places
    out, told = {}, {}
    for part, first, after in zip(parts, starts, [*starts[1:], len(joints)], strict=True):
        low, top = joints[first], joints[after - 1]
        told[part] = moving.names[low] if low == top else f"{moving.names[low]} to {moving.names[top]}"
        if low == top:
            out[part] = R[:, low]
        elif after < len(joints):
            mean = rotations.project(R[:, joints[first:after]].mean(axis=1))
            out[part] = swing(mean, rest[joints[after]] - rest[low], y[:, joints[after]] - y[:, low])
        else:
            points = rest[carried]
            there = np.einsum("tab,kb->tka", R[:, top], points - rest[top]) + (y[:, top] - y[:, low])[:, None]
            out[part] = rotations.project(np.einsum("tka,kb->tab", there, points - rest[low]))
    return out, told


def nearest_starts(ours: np.ndarray, theirs: np.ndarray) -> list[int]:
    """Choose which of their joints begins each of our parts, by heights (n,) and (m,), m at least n.

    Each part takes the nearest joint that leaves enough joints for the rest.
    """
    out, spare = [0], len(theirs) - len(ours)
    for i, height in enumerate(ours[1:], start=1):
        first = out[-1] + 1
        out.append(first + int(np.abs(theirs[first:i + spare + 1] - height).argmin()))
    return out


def heights(joints: np.ndarray, some: Sequence[int], roles: Mapping[str, int]) -> np.ndarray:
    """Compute how far along the trunk some of the joints (J, 3) are, (n,): 0 at the hips and 1 at the shoulders."""
    hips, shoulders = (joints[[roles[f"l_{name}"], roles[f"r_{name}"]]].mean(axis=0) for name in ("hip", "shoulder"))
    along = shoulders - hips
    return np.asarray((joints[some] - hips) @ along / (along @ along))


def spread_rotations(moving: MovingSkeleton, steps: Sequence[int], parts: Sequence[int]
                     ) -> tuple[dict[int, np.ndarray], dict[int, str]]:
    """Interpolate rotations (T, 3, 3) for parts spread evenly over joints; the last part follows the last joint."""
    out, told = {}, {}
    for i, part in enumerate(parts, start=1):
        at = i * (len(steps) - 1) / len(parts)
        before, share = int(at), at - int(at)
        first, second = steps[before], steps[min(before + 1, len(steps) - 1)]
        turn = np.swapaxes(moving.rotations[:, first], -1, -2) @ moving.rotations[:, second]
        out[part] = moving.rotations[:, first] @ rotations.exp(share * rotations.log(turn)) if share else (
            moving.rotations[:, first])
        told[part] = moving.names[first] + (f" to {moving.names[second]}" if share else "")
    return out, told


def swing(R: np.ndarray, before: np.ndarray, now: np.ndarray) -> np.ndarray:
    """Rotate R (T, 3, 3) by the smallest rotations that bring `R @ before` (3,) to the directions `now` (T, 3)."""
    was = R @ before
    if np.linalg.norm(before) < 1e-6:
        return R
    axis = np.cross(was, now)
    sine = np.linalg.norm(axis, axis=1, keepdims=True)
    angle = np.arctan2(sine, np.einsum("ta,ta->t", was, now)[:, None])
    return np.asarray(rotations.exp(angle * axis / np.maximum(sine, 1e-12)) @ R)
