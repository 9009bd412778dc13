"""A walk for the synthetic people, from joint angles over the gait cycle."""
from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from .anatomy import PARENTS, Anatomy
from .poses import average, compose

# Joint angles over one gait cycle from heel strike, degrees (typical values of published gait analysis).
_PHASE = np.linspace(0, 1, 11)
_HIP = np.array([28, 24, 15, 5, -5, -11, -4, 14, 27, 31, 28.0])
_KNEE = np.array([4, 16, 14, 8, 5, 10, 34, 60, 52, 18, 4.0])
_ANKLE = np.array([0, -4, 3, 7, 10, 8, -14, -8, 0, 2, 0.0])


def walk(frames: int, rate: float = 60.0, speed: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """A walk straight ahead.

    Parameters
    ----------
    frames : int
    rate : float, frames a second
    speed : float
        1 is a gait cycle of 1.1 seconds.

    Returns
    -------
    (frames, 16, 3) float, radians
    (frames, 3) float, metres
        The place of the root against rest, so that the lower foot stays on the floor.
    """
    t = np.arange(frames) / rate * speed / 1.1
    poses = np.stack([_stride(phase) for phase in t % 1.0])
    fine = 120
    heights, advance = _footing(np.stack([_stride(k / fine) for k in range(fine + 1)]))
    cycle = np.concatenate([[0], np.cumsum(advance)])
    at = (t % 1.0) * fine
    ahead = np.interp(at, np.arange(fine + 1), cycle) + np.floor(t) * cycle[-1]
    lift = np.interp(at, np.arange(fine + 1), heights)
    return poses, np.stack([np.zeros(frames), -ahead, lift], axis=1)


def _stride(phase: float) -> np.ndarray:
    from scipy.interpolate import CubicSpline

    curves = CubicSpline(_PHASE, np.stack([_HIP, _KNEE, _ANKLE], axis=1), bc_type="periodic")
    wave = 2 * np.pi * phase
    limbs: dict[str, dict[str, Any]] = {}
    for name, shift in (("left", 0.0), ("right", 0.5)):
        hip, knee, ankle = curves((phase + shift) % 1.0)
        swing = np.cos(wave + 2 * np.pi * shift)
        limbs[f"{name}_leg"] = {"direction": (0.035, np.tan(np.radians(hip)), -1.0), "knee": float(knee),
                                "foot": float(ankle)}
        limbs[f"{name}_arm"] = {"direction": (0.28, 0.05 - 0.33 * swing, -1.0), "elbow": 10 - 9 * swing,
                                "twist": 12}
    pose = compose(limbs["left_arm"], limbs["right_arm"], limbs["left_leg"], limbs["right_leg"],
                   {"turn": 9 * np.cos(wave), "bend": 2}, {"turn": -5 * np.cos(wave), "nod": 1})
    pose[0] = Rotation.from_euler("zyx", [-4.5 * np.cos(wave), 2.5 * np.sin(wave), 2], degrees=True).as_rotvec()
    return pose


def _footing(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lift of the root (T,) that puts the lower foot on the floor, and how far it moves ahead (T - 1,)."""
    a = average()
    soles = []
    for foot in (12, 15):
        toe = a.ends[foot] * [1, 1, 0]
        heel = a.joints[foot] * [1, 1, 0] + [0, 0.055, 0]
        soles.append([_carried(a, pose, foot, np.stack([heel, toe])) for pose in poses])
    points = np.swapaxes(np.array(soles), 0, 1).reshape(len(poses), 4, 3)
    lowest = points[:, :, 2].min(axis=1)
    weight = np.exp(-(points[:, :, 2] - lowest[:, None]) / 0.01)
    weight = 0.5 * (weight[1:] + weight[:-1])
    weight /= weight.sum(axis=1, keepdims=True)
    advance = (weight * np.diff(points[:, :, 1], axis=0)).sum(axis=1)
    kernel = np.hanning(15) / np.hanning(15).sum()
    smooth = np.convolve(np.r_[lowest[-8:-1], lowest, lowest[1:8]], kernel, "valid")
    advance = np.convolve(np.r_[advance[-7:], advance, advance[:7]], kernel, "valid")
    return -smooth, advance


def _carried(a: Anatomy, pose: np.ndarray, part: int, points: np.ndarray) -> np.ndarray:
    chain = [part]
    while PARENTS[chain[-1]] >= 0:
        chain.append(int(PARENTS[chain[-1]]))
    for p in chain:
        points = a.joints[p] + Rotation.from_rotvec(pose[p]).apply(points - a.joints[p])
    return points
