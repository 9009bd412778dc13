"""Poses of the synthetic people: everyday poses by name, random combinations of them, and a walk."""
from __future__ import annotations

import json
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from .anatomy import MIRROR_PART, PARENTS, BodyShape, RestFrames
from .landmarks import landmarks
from .topology import load_topology


@lru_cache(maxsize=1)
def average() -> RestFrames:
    """Return the skeleton that poses are defined on."""
    return RestFrames(BodyShape())


def _towards(axis: np.ndarray, direction: np.ndarray, twist: float) -> np.ndarray:
    """Return the rotation vector that twists a bone about `axis`, then swings it to `direction` the shortest way."""
    direction = direction / np.linalg.norm(direction)
    cross = np.cross(axis, direction)
    sine, cosine = np.linalg.norm(cross), axis @ direction
    swing = cross / max(sine, 1e-12) * np.arctan2(sine, cosine)
    return (Rotation.from_rotvec(swing) * Rotation.from_rotvec(twist * axis)).as_rotvec()


def arm(direction: tuple[float, float, float], elbow: float = 0, twist: float = 0, turn: float = 0, wrist: float = 0,
        side: int = 1) -> np.ndarray:
    """Return rotation vectors (3, 3) of upper arm, forearm and hand, left (side 1) or right (-1).

    Parameters
    ----------
    direction : (outwards, frontwards, upwards)
        Where the upper arm points, seen from the chest.
    elbow : float, degrees
        Flexion beyond that at rest.
    twist : float, degrees
        Of the upper arm, positive inwards.
    turn : float, degrees
        Pronation of the hand.
    wrist : float, degrees
        Flexion towards the palm.
    side : 1 or -1
        Left or right.
    """
    skeleton = average()
    out, front, up = direction
    upper, fore = skeleton.upper_arm_frame, skeleton.forearm_frame
    bend = np.cross(upper[2], upper[1])
    pose = np.array([_towards(upper[2], np.array([out, -front, up]), np.radians(twist)),
                     np.radians(elbow) * bend / np.linalg.norm(bend),
                     (Rotation.from_rotvec(np.radians(turn) * fore[2])
                      * Rotation.from_rotvec(np.radians(wrist) * fore[1])).as_rotvec()])
    return pose if side > 0 else pose * [1, -1, -1]


def leg(direction: tuple[float, float, float], knee: float = 0, twist: float = 0, foot: float = 0, side: int = 1
        ) -> np.ndarray:
    """Return rotation vectors (3, 3) of thigh, shin and foot, left (side 1) or right (-1).

    Parameters
    ----------
    direction : (outwards, frontwards, upwards)
        Where the thigh points, seen from the pelvis.
    knee : float, degrees
        Flexion.
    twist : float, degrees
        Of the thigh, positive outwards.
    foot : float, degrees
        Raising of the toes.
    side : 1 or -1
        Left or right.
    """
    skeleton = average()
    out, front, up = direction
    axis = skeleton.leg_frame[2]
    pose = np.array([_towards(axis, np.array([out, -front, up]), -np.radians(twist)),
                     np.radians([knee, 0, 0]), np.radians([-foot, 0, 0])])
    return pose if side > 0 else pose * [1, -1, -1]


def spine(bend: float = 0, lean: float = 0, turn: float = 0) -> np.ndarray:
    """Return rotation vectors (2, 3) of abdomen and chest; degrees frontwards, to the left, turned to the left."""
    whole = Rotation.from_euler("zyx", [turn, lean, bend], degrees=True).as_rotvec()
    # the chest takes a little more of the bend than the abdomen
    return np.stack([0.45 * whole, 0.55 * whole])


def head(nod: float = 0, lean: float = 0, turn: float = 0) -> np.ndarray:
    """Return the rotation vector (3,) of the head; degrees down, to the left, turned to the left."""
    return Rotation.from_euler("zyx", [turn, lean, nod], degrees=True).as_rotvec()


def compose_pose(left_arm: dict | None = None, right_arm: dict | None = None, left_leg: dict | None = None,
                 right_leg: dict | None = None, back: dict | None = None, neck: dict | None = None,
                 root: tuple[float, float, float] = (0, 0, 0)) -> np.ndarray:
    """Compose a pose (16, 3) from anatomical angles; what is not given stays at rest."""
    # directions of arms and legs at rest
    down_arm, down_leg = (0.59, 0.0, -0.81), (0.078, 0.0, -1.0)
    pose = np.zeros((16, 3))
    pose[0] = np.radians(root)
    pose[1:3] = spine(**(back or {}))
    pose[3] = head(**(neck or {}))
    pose[4:7] = arm(**{"direction": down_arm, **(left_arm or {})})
    pose[7:10] = arm(**{"direction": down_arm, **(right_arm or {})}, side=-1)
    pose[10:13] = leg(**{"direction": down_leg, **(left_leg or {})})
    pose[13:16] = leg(**{"direction": down_leg, **(right_leg or {})}, side=-1)
    return pose


# named poses as anatomical angles, and the joint angles of a gait cycle
_STORED: dict[str, Any] = json.loads(Path(__file__).with_name("poses.json").read_text(encoding="utf-8"))
NAMED_POSES = tuple(_STORED["named"])


def find_pose(name: str) -> np.ndarray:
    """Return a pose (16, 3), radians, by its name in `NAMED_POSES`."""
    if name not in NAMED_POSES:
        raise ValueError(f"name: no pose '{name}', expected one of {', '.join(NAMED_POSES)}")
    return _read_pose(name).copy()


@cache
def _read_pose(name: str) -> np.ndarray:
    """Compose a stored pose."""
    return compose_pose(**_STORED["named"][name])


def random_pose(rng: np.random.Generator) -> np.ndarray:
    """Draw a plausible pose (16, 3): arms, legs, back and neck each from a named pose, with noise."""
    limbs = [4, 5, 6], [7, 8, 9], [0, 10, 11, 12, 13, 14, 15], [1, 2], [3]
    # standard deviations of the noise in degrees, by part
    looseness = np.radians(np.array([4, 4, 4, 7, 8, 6, 9, 8, 6, 9, 4, 4, 5, 4, 4, 5.0]))
    pose = np.zeros((16, 3))
    for group in limbs:
        name = NAMED_POSES[rng.integers(len(NAMED_POSES))]
        source = find_pose(name)
        if rng.random() < 0.5:
            source = mirror_synthetic_pose(source)
        pose[group] = rng.uniform(0.55, 1.0) * source[group]
    noise = rng.normal(size=(16, 3)) * looseness[:, None] * 0.7
    # elbows and knees get no noise: they are hinges
    noise[[5, 8, 11, 14]] = 0.0
    return pose + noise


def mirror_synthetic_pose(pose: np.ndarray) -> np.ndarray:
    """Return the pose (..., 16, 3) of the mirror image."""
    return pose[..., MIRROR_PART, :] * [1, -1, -1]


def synthesise_walk(frames: int, rate: float = 60.0) -> tuple[np.ndarray, np.ndarray]:
    """Make a walk straight ahead.

    The lower foot stays on the floor; a gait cycle takes 1.1 seconds.

    Parameters
    ----------
    frames : int
        Number of frames.
    rate : float, frames per second
        Frame rate.

    Returns
    -------
    poses : (frames, 16, 3) float, radians
    trans : (frames, 3) float, metres
        Place of the root relative to rest.
    """
    cycles = np.arange(frames) / rate / 1.1
    poses = np.stack([_stride(phase) for phase in cycles % 1.0])
    # tabulate one cycle: lift and advance of the root that keep the lower foot on the floor
    steps = 120
    heights, advance = _footing(np.stack([_stride(k / steps) for k in range(steps + 1)]))
    cycle = np.concatenate([[0], np.cumsum(advance)])
    # look them up for every frame; each finished cycle adds its length
    place = (cycles % 1.0) * steps
    ahead = np.interp(place, np.arange(steps + 1), cycle) + np.floor(cycles) * cycle[-1]
    lift = np.interp(place, np.arange(steps + 1), heights)
    return poses, np.stack([np.zeros(frames), -ahead, lift], axis=1)


def _stride(phase: float) -> np.ndarray:
    """Compose the pose at a phase, 0 to 1, of the gait cycle."""
    curves = CubicSpline(np.linspace(0, 1, 11), np.array(_STORED["gait"]).T, bc_type="periodic")
    wave = 2 * np.pi * phase
    limbs: dict[str, dict[str, Any]] = {}
    for name, shift in (("left", 0.0), ("right", 0.5)):
        hip, knee, ankle = curves((phase + shift) % 1.0)
        swing = np.cos(wave + 2 * np.pi * shift)
        # legs follow the stored curves, arms swing against them
        limbs[f"{name}_leg"] = {"direction": (0.035, np.tan(np.radians(hip)), -1.0), "knee": float(knee),
                                "foot": float(ankle)}
        limbs[f"{name}_arm"] = {"direction": (0.28, 0.05 - 0.33 * swing, -1.0), "elbow": 10 - 9 * swing,
                                "twist": 12}
    # chest and head turn against the pelvis, which rocks with every step
    pose = compose_pose(limbs["left_arm"], limbs["right_arm"], limbs["left_leg"], limbs["right_leg"],
                        {"turn": 9 * np.cos(wave), "bend": 2}, {"turn": -5 * np.cos(wave), "nod": 1})
    pose[0] = Rotation.from_euler("zyx", [-4.5 * np.cos(wave), 2.5 * np.sin(wave), 2], degrees=True).as_rotvec()
    return pose


def _footing(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the lift of the root (T,) that puts the lower foot on the floor, and its advance (T - 1,)."""
    skeleton, part = average(), load_topology().part_of_vertex
    lowest, treads = [], []
    for foot, side in ((12, "left"), (15, "right")):
        sole = skeleton.vertices[(part == foot) & (skeleton.vertices[:, 2] < skeleton.joints[foot, 2])]
        # the model's feet are rigid, so they roll from the heel over the ball, where the bone ends
        tread = np.array([skeleton.vertices[landmarks()[f"{side} heel"]], skeleton.ends[foot]]) * [1, 1, 0]
        moved = np.stack([_carry(skeleton, pose, foot, np.vstack([tread, sole])) for pose in poses])
        treads.append(moved[:, :2])
        lowest.append(moved[:, 2:, 2].min(axis=1))
    points, lift = np.concatenate(treads, axis=1), -np.min(lowest, axis=0)
    # the body advances as the lowest points move back; 1 cm of height decides which are lowest
    weight = np.exp(-(points[:, :, 2] - points[:, :, 2].min(axis=1, keepdims=True)) / 0.01)
    weight = 0.5 * (weight[1:] + weight[:-1])
    weight /= weight.sum(axis=1, keepdims=True)
    advance = (weight * np.diff(points[:, :, 1], axis=0)).sum(axis=1)
    # smooth both over the cycle, which is periodic
    kernel = np.hanning(15) / np.hanning(15).sum()
    lift = np.convolve(np.r_[lift[-8:-1], lift, lift[1:8]], kernel, "valid")
    advance = np.convolve(np.r_[advance[-7:], advance, advance[:7]], kernel, "valid")
    return lift, advance


def _carry(skeleton: RestFrames, pose: np.ndarray, part: int, points: np.ndarray) -> np.ndarray:
    """Move points on a part with the skeleton in a pose."""
    chain = [part]
    while PARENTS[chain[-1]] >= 0:
        chain.append(int(PARENTS[chain[-1]]))
    for p in chain:
        points = skeleton.joints[p] + Rotation.from_rotvec(pose[p]).apply(points - skeleton.joints[p])
    return points
