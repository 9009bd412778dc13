"""Poses of the synthetic people: everyday poses by name, and random ones between them."""
from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.spatial.transform import Rotation

from .anatomy import Anatomy, BodyShape

_LEFT_ARM, _RIGHT_ARM, _LEFT_LEG, _RIGHT_LEG = 4, 7, 10, 13


@lru_cache(maxsize=1)
def average() -> Anatomy:
    """The skeleton that poses are made for."""
    return Anatomy(BodyShape())


def _rotvec(degrees_about: tuple[float, float, float]) -> np.ndarray:
    return np.radians(np.array(degrees_about))


def _towards(axis: np.ndarray, direction: np.ndarray, twist: float) -> np.ndarray:
    """The rotation vector that turns `axis` about itself by `twist` and then to `direction` the shortest way."""
    direction = direction / np.linalg.norm(direction)
    cross = np.cross(axis, direction)
    sine, cosine = np.linalg.norm(cross), axis @ direction
    swing = cross / max(sine, 1e-12) * np.arctan2(sine, cosine)
    return (Rotation.from_rotvec(swing) * Rotation.from_rotvec(twist * axis)).as_rotvec()


def arm(direction: tuple[float, float, float], elbow: float = 0, twist: float = 0, turn: float = 0,
        wrist: float = 0,
        side: int = 1) -> np.ndarray:
    """Rotation vectors (3, 3) of upper arm, forearm and hand.

    Parameters
    ----------
    direction : outwards, frontwards, upwards
        Where the upper arm points, seen from the chest.
    elbow, twist, turn, wrist : degrees
        Flexion beyond rest; rotation of the upper arm about itself, positive inwards; pronation of the
        hand; flexion of the wrist towards the palm.
    side : 1 left, -1 right
    """
    a = average()
    out, front, up = direction
    upper, fore = a.upper_arm_frame, a.forearm_frame
    bend = np.cross(upper[2], upper[1])
    pose = np.array([_towards(upper[2], np.array([out, -front, up]), np.radians(twist)),
                     np.radians(elbow) * bend / np.linalg.norm(bend),
                     (Rotation.from_rotvec(np.radians(turn) * fore[2])
                      * Rotation.from_rotvec(np.radians(wrist) * fore[1])).as_rotvec()])
    return pose if side > 0 else pose * [1, -1, -1]


def leg(direction: tuple[float, float, float], knee: float = 0, twist: float = 0, foot: float = 0, side: int = 1
        ) -> np.ndarray:
    """Rotation vectors (3, 3) of thigh, shin and foot.

    Parameters
    ----------
    direction : outwards, frontwards, upwards
        Where the thigh points, seen from the pelvis.
    knee, twist, foot : degrees
        Flexion; rotation of the thigh about itself, positive outwards; raising of the toes.
    """
    a = average()
    out, front, up = direction
    axis = a.leg_frame[2]
    pose = np.array([_towards(axis, np.array([out, -front, up]), -np.radians(twist)),
                     np.radians([knee, 0, 0]), np.radians([-foot, 0, 0])])
    return pose if side > 0 else pose * [1, -1, -1]


def spine(bend: float = 0, lean: float = 0, turn: float = 0) -> np.ndarray:
    """Rotation vectors (2, 3) of abdomen and chest: degrees frontwards, to the left, turned to the left."""
    whole = Rotation.from_euler("zyx", [turn, lean, bend], degrees=True).as_rotvec()
    return np.stack([0.45 * whole, 0.55 * whole])


def head(nod: float = 0, lean: float = 0, turn: float = 0) -> np.ndarray:
    """Rotation vector (3,) of the head, degrees: down, to the left, turned to the left."""
    return Rotation.from_euler("zyx", [turn, lean, nod], degrees=True).as_rotvec()


DOWN_ARM = (0.59, 0.0, -0.81)
DOWN_LEG = (0.078, 0.0, -1.0)


def compose(left_arm: dict | None = None, right_arm: dict | None = None, left_leg: dict | None = None,
            right_leg: dict | None = None, back: dict | None = None, neck: dict | None = None,
            root: tuple[float, float, float] = (0, 0, 0)) -> np.ndarray:
    """A pose (16, 3) from anatomical angles; what is not given stays at rest."""
    pose = np.zeros((16, 3))
    pose[0] = _rotvec(root)
    pose[1:3] = spine(**(back or {}))
    pose[3] = head(**(neck or {}))
    pose[4:7] = arm(**{"direction": DOWN_ARM, **(left_arm or {})})
    pose[7:10] = arm(**{"direction": DOWN_ARM, **(right_arm or {})}, side=-1)
    pose[10:13] = leg(**{"direction": DOWN_LEG, **(left_leg or {})})
    pose[13:16] = leg(**{"direction": DOWN_LEG, **(right_leg or {})}, side=-1)
    return pose


def _both(**kwargs: object) -> dict:
    return {"left_arm": dict(kwargs), "right_arm": dict(kwargs)}


def _legs(**kwargs: object) -> dict:
    return {"left_leg": dict(kwargs), "right_leg": dict(kwargs)}


_NAMED: dict[str, dict] = {
    "rest": {},
    "attention": _both(direction=(0.30, 0.0, -1), elbow=-4),
    "t_pose": _both(direction=(1, 0, 0), twist=0),
    "arms_up": _both(direction=(0.45, 0.1, 1), elbow=0),
    "arms_forward": _both(direction=(0.12, 1, 0.0), elbow=-5, turn=20),
    "strong_arms": _both(direction=(1, 0.15, 0.1), elbow=95, twist=-90),
    "hands_on_hips": _both(direction=(0.88, -0.25, -0.68), elbow=72, twist=55, turn=30),
    "surrender": _both(direction=(1, 0.1, -0.05), elbow=75, twist=-80, turn=30),
    "left_arm_up": {"left_arm": {"direction": (0.3, 0.15, 1)}, "back": {"lean": -12},
                    "neck": {"turn": 25, "nod": -12}},
    "point_right": {"right_arm": {"direction": (0.75, 0.65, 0.15)}, "neck": {"turn": -40}, "back": {"turn": -20},
                    "left_arm": {"direction": (0.45, -0.1, -0.9), "elbow": 25}},
    "sitting": {**_legs(direction=(0.16, 1, -0.05), knee=88), **_both(direction=(0.35, 0.55, -0.8), elbow=45,
                                                                      turn=40),
                "back": {"bend": 10}},
    "squat": {**_legs(direction=(0.35, 1, -0.25), knee=92, twist=12, foot=14),
              **_both(direction=(0.1, 1, -0.1), elbow=5),
              "back": {"bend": 14}, "root": (22, 0, 0)},
    "kick_left": {"left_leg": {"direction": (0.08, 1, -0.45), "knee": 12, "foot": -25},
                  "back": {"bend": 8, "turn": -15},
                  "left_arm": {"direction": (0.7, -0.6, -0.5), "elbow": 25},
                  "right_arm": {"direction": (0.5, 0.8, -0.2), "elbow": 30}},
    "kick_back_right": {"right_leg": {"direction": (0.1, -0.45, -1), "knee": 75, "foot": -30},
                        "left_leg": {"direction": (0.05, 0.15, -1), "knee": 14, "foot": 6},
                        "left_arm": {"direction": (0.4, 0.7, -0.5), "elbow": 50},
                        "right_arm": {"direction": (0.6, -0.5, -0.7), "elbow": 35}, "back": {"bend": 12}},
    "side_kick_right": {"right_leg": {"direction": (1, 0.15, -0.6), "knee": 5}, "back": {"lean": 20},
                        **_both(direction=(0.6, 0.4, -0.6), elbow=80)},
    "lunge_left": {"left_leg": {"direction": (0.1, 1, -0.55), "knee": 70}, "root": (4, 0, 0),
                   "right_leg": {"direction": (0.08, -0.55, -1), "knee": 22, "foot": 10},
                   "left_arm": {"direction": (0.5, -0.3, -0.9), "elbow": 30},
                   "right_arm": {"direction": (0.4, 0.5, -0.8), "elbow": 40}},
    "knee_up_right": {"right_leg": {"direction": (0.12, 1, 0.15), "knee": 105, "foot": -10},
                      "left_arm": {"direction": (0.4, 0.6, -0.6), "elbow": 70},
                      "right_arm": {"direction": (0.45, -0.5, -0.8), "elbow": 60}},
    "twist_left": {"back": {"turn": 50}, "neck": {"turn": 30}, "left_arm": {"direction": (0.9, -0.35, -0.1),
                                                                            "elbow": 20},
                   "right_arm": {"direction": (0.25, 0.9, -0.15), "elbow": 35}},
    "twist_right": {"back": {"turn": -50, "bend": 8}, "neck": {"turn": -20},
                    **_both(direction=(1, 0.1, -0.15), elbow=25)},
    "bow": {"back": {"bend": 42}, "neck": {"nod": 15}, "root": (28, 0, 0), **_legs(direction=(0.078, 0.53, -1.0)),
            **_both(direction=(0.45, 0.45, -0.85), elbow=8)},
    "lean_left": {"back": {"lean": 32}, "neck": {"lean": 10},
                  "right_arm": {"direction": (0.3, 0.1, 1), "elbow": 25},
                  "left_arm": {"direction": (0.55, 0.1, -0.8)}},
    "lean_back": {"back": {"bend": -24}, "neck": {"nod": -20}, **_both(direction=(0.8, 0.35, 0.55), elbow=15)},
    "boxer": {"left_arm": {"direction": (0.35, 0.6, -0.7), "elbow": 98, "twist": -10},
              "right_arm": {"direction": (0.40, 0.35, -0.8), "elbow": 102, "twist": -10},
              "back": {"bend": 10, "turn": -20}, "left_leg": {"direction": (0.14, 0.35, -1), "knee": 24,
                                                              "foot": 4},
              "right_leg": {"direction": (0.16, -0.15, -1), "knee": 22, "twist": 15, "foot": 10}},
    "throw_right": {"right_arm": {"direction": (0.85, -0.35, 0.45), "elbow": 85, "twist": -70},
                    "back": {"turn": -30, "bend": -8},
                    "left_arm": {"direction": (0.35, 0.9, 0.1), "elbow": 15},
                    "left_leg": {"direction": (0.1, 0.45, -1), "knee": 15},
                    "right_leg": {"direction": (0.12, -0.25, -1), "knee": 12}},
    "run": {"left_leg": {"direction": (0.06, 0.85, -0.75), "knee": 85}, "root": (10, 0, 0),
            "right_leg": {"direction": (0.06, -0.4, -1), "knee": 35, "foot": -18},
            "left_arm": {"direction": (0.35, -0.6, -0.75), "elbow": 80},
            "right_arm": {"direction": (0.3, 0.55, -0.8), "elbow": 85}, "back": {"turn": 8, "bend": 6}},
    "balance": {"root": (50, 0, 0), "right_leg": {"direction": (0.06, -0.75, -0.8), "knee": 5, "foot": -30},
                "left_leg": {"direction": (0.03, 0.95, -0.75), "knee": 6}, **_both(direction=(1, 0.25, 0.1)),
                "back": {"bend": -12}, "neck": {"nod": -25}},
    "wave_right": {"right_arm": {"direction": (0.8, 0.25, 0.2), "elbow": 85, "twist": -85, "turn": -20},
                   "neck": {"turn": -20, "lean": -8}, "left_arm": {"direction": (0.5, -0.1, -0.9), "elbow": 15},
                   "left_leg": {"direction": (0.2, 0.05, -1), "twist": 12}},
    "stretch_across": {"right_arm": {"direction": (-0.30, 0.95, -0.1), "elbow": 12}, "back": {"turn": 15},
                       "left_arm": {"direction": (0.9, -0.3, -0.3), "elbow": 20}, "neck": {"turn": -25}},
}
NAMED_POSES = tuple(_NAMED)


def named_pose(name: str) -> np.ndarray:
    """A pose (16, 3), radians, by its name in `NAMED_POSES`.

    Raises
    ------
    ValueError
        A name that is not known.
    """
    if name not in _NAMED:
        raise ValueError(f"name: no pose '{name}', expected one of {', '.join(NAMED_POSES)}")
    return compose(**_NAMED[name])


_GROUPS = ([4, 5, 6], [7, 8, 9], [0, 10, 11, 12, 13, 14, 15], [1, 2], [3])
JITTER = np.radians(np.array([4, 4, 4, 7, 8, 6, 9, 8, 6, 9, 4, 4, 5, 4, 4, 5.0]))


def random_pose(rng: np.random.Generator, spread: float = 1.0) -> np.ndarray:
    """A plausible pose (16, 3): arms, legs, back and neck each drawn from the named poses, loosened.

    Parameters
    ----------
    spread : float
        How far from rest: 0 gives rest, 1 poses as varied as the named ones.
    """
    pose = np.zeros((16, 3))
    for group in _GROUPS:
        name = NAMED_POSES[rng.integers(len(NAMED_POSES))]
        source = named_pose(name)
        if rng.random() < 0.5:
            source = mirrored_pose(source)
        pose[group] = rng.uniform(0.55, 1.0) * source[group]
    noise = rng.normal(size=(16, 3)) * JITTER[:, None] * 0.7
    noise[[5, 8, 11, 14]] = 0.0
    return spread * (pose + noise)


def mirrored_pose(pose: np.ndarray) -> np.ndarray:
    """The pose (..., 16, 3) of the mirror image."""
    from .anatomy import MIRROR_PART

    return pose[..., MIRROR_PART, :] * [1, -1, -1]
