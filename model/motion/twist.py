"""Twist of limbs about their bones: the planes in which elbows and knees bend tell it, and human ranges judge it.

Joint centres do not show how a limb is turned about its own axis. The zero of a file's rotations may be any roll of the
bones. But elbows and knees are hinges: while they bend, the plane of the bend shows how the bones are turned.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from scanprep.geometry import rotations
from scanprep.skeleton.roles import above as way_up

BENT = np.radians(20)                # below it the plane of a bend is mostly noise of the joint centres
CARRY = np.radians(12)               # carrying angle of an elbow, out of the plane of its bend: people have 5 to 20
# limbs: three joints, where the lower bone bends to (front 1, back -1), degrees that the upper and the lower bone may
# turn about themselves out of the hinge, and the ranges of their twists from rest, where thumbs point forward
_LIMBS = ((("shoulder", "elbow", "wrist"), 1.0, (12.0, 85.0), (100.0, 85.0)),
          (("hip", "knee", "ankle"), -1.0, (12.0, 30.0), (60.0, 45.0)))
OFTEN = 0.25                         # share of bent frames from which on the hinge wins over a changing roll


@dataclass(frozen=True, eq=False)
class Hinge:
    """An elbow or knee that moves: its limb at rest, and how it bends in T frames."""

    side: str                        # "left" or "right"
    joint: str                       # "elbow" or "knee"
    parts: tuple[int, int, int]      # upper, lower, end
    bones: np.ndarray                # (2, 3) directions of the upper and the lower bone at rest
    axes: np.ndarray                 # (2, 3) axis of the hinge in either part at rest
    normal: np.ndarray               # (T, 3) axis of the bend in the world
    bend: np.ndarray                 # (T,) radians
    slack: tuple[float, float]       # degrees
    limits: tuple[float, float]      # degrees

    def angles(self, R: np.ndarray, k: int) -> np.ndarray:
        """Compute how far (T,), radians, part k with rotations R (T, 3, 3) must turn about its bone for the bend."""
        h = np.einsum("tba,tb->ta", R, self.normal)
        return np.asarray(np.arctan2(np.cross(self.axes[k], h) @ self.bones[k], h @ self.axes[k]))

    def tolerance(self, k: int) -> np.ndarray:
        """Compute how far (T,), radians, the bend may be from the axis of part k: far where it is hardly bent."""
        return np.radians(self.slack[k]) + np.arcsin(np.minimum(np.sin(CARRY) / np.sin(np.maximum(self.bend, BENT)), 1))


def find_hinges(joints: np.ndarray, roles: Mapping[str, int], front: np.ndarray, places: np.ndarray,
                moving_roles: Mapping[str, int]) -> list[Hinge]:
    """Find elbows and knees of a body with joints (J, 3) at rest; they bend as joints in places (T, K, 3) do.

    Both have their joints by H-Anim names. The lower bone bends to the `front` (3,) of the body, that of a leg back.
    """
    out = []
    for side in ("left", "right"):
        for chain, sign, slack, limits in _LIMBS:
            names = [f"{side[0]}_{name}" for name in chain]
            if not {*names} <= roles.keys() & moving_roles.keys():
                continue
            parts = [roles[name] for name in names]
            bones = _unit(np.diff(joints[parts], axis=0))
            axes = np.cross(bones, sign * front)
            if np.linalg.norm(axes, axis=1).min() < 0.3:               # at rest it points to where it would bend
                continue
            upper, lower = np.moveaxis(np.diff(places[:, [moving_roles[name] for name in names]], axis=1), 1, 0)
            normal = np.cross(upper, lower)
            bend = np.arctan2(np.linalg.norm(normal, axis=1), (upper * lower).sum(axis=1))
            out.append(Hinge(side, chain[1], (parts[0], parts[1], parts[2]), bones, _unit(axes), _unit(normal), bend,
                             slack, limits))
    return out


@dataclass(frozen=True, eq=False)
class Roll:
    """By how much a hinge turns a part about its bone, against the rotations of the file."""

    constant: float                  # radians, the difference of the two skeletons at rest
    changing: np.ndarray             # (T,) radians, where the file contradicts its own joint centres
    bone: np.ndarray                 # (3,) direction at rest


def find_roll(angle: np.ndarray, bend: np.ndarray, tolerance: np.ndarray) -> tuple[float, np.ndarray]:
    """Find the roll of a part, constant and changing (T,), from the angles (T,) that its hinge asks for, radians.

    What is within `tolerance` (T,) is no error. The mean over the bent frames is one roll at rest. If more remains in
    many frames, the hinge is followed. Between bent frames this is interpolated: the motion's own relative roll carries
    on.

    Examples
    --------
    >>> constant, changing = find_roll(np.full(3, 2.0), np.array([0.1, 1.0, 1.0]), np.full(3, 0.4))
    >>> round(constant, 3), changing
    (2.0, array([0., 0., 0.]))
    """
    bent = np.flatnonzero(bend > BENT)
    if not len(bent):
        return 0.0, np.zeros(len(angle))
    weight = np.sin(bend[bent])
    constant = _mean_angle(angle[bent], weight)
    if abs(constant) <= np.average(tolerance[bent], weights=weight):
        constant = 0.0
    # what remains, without jumps of whole turns
    off = np.unwrap(rotations.wrap_angle(angle[bent] - constant))
    off -= 2 * np.pi * np.rint(off.mean() / (2 * np.pi))
    if (np.abs(off) > tolerance[bent]).mean() < OFTEN:                    # a few: noise, or a knee bent backwards
        return constant, np.zeros(len(angle))
    return constant, np.interp(np.arange(len(angle)), bent, off)


def roll_limbs(hinges: Sequence[Hinge], parents: np.ndarray, world: Mapping[int, np.ndarray]
               ) -> tuple[dict[int, np.ndarray], dict[int, Roll]]:
    """Find how limbs must turn about their bones to suit their hinges.

    A forearm, shank, hand or foot takes the roll of the part above if that brings it nearer to its own. A limb that
    never bends takes the mirrored roll of the other side.

    Parameters
    ----------
    hinges : sequence of Hinge
        Elbows and knees.
    parents : (J,) int
        Of the parts of the body.
    world : {part: (T, 3, 3)}
        Rotations of the parts of the hinges, from their rest to the motion.

    Returns
    -------
    turns : {part: (3, 3)}
        Turns at rest of the parts of limbs, with all that they carry.
    rolls : {part: Roll}
        Of upper and lower parts.
    """
    turns, rolls, known = dict[int, np.ndarray](), dict[int, Roll](), dict[tuple[str, int], float]()
    for hinge in sorted(hinges, key=lambda hinge: -hinge.bend.max()):
        bent, roll = hinge.bend > BENT, 0.0
        for k, part in enumerate(hinge.parts[:2]):
            angle = hinge.angles(world[part], k)
            shared = _nearer(roll, angle[bent])
            constant, changing = find_roll(rotations.wrap_angle(angle - shared), hinge.bend, hinge.tolerance(k))
            roll = float(rotations.wrap_angle(shared + constant)) if bent.any() else -known.get((hinge.joint, k), 0.0)
            known[hinge.joint, k] = roll
            turns[part] = rotations.exp(roll * hinge.bones[k])
            rolls[part] = Roll(roll, changing, hinge.bones[k])
        # the end twists little against the lower part
        lower, end = hinge.parts[1:]
        inverse = np.swapaxes(world[lower] @ turns[lower], -1, -2)
        turns[end] = rotations.exp(_nearer(roll, -axial(inverse @ world[end], hinge.bones[1])) * hinge.bones[1])
    # parts between and beyond, such as fingers, turn with the part that carries them
    for j in range(len(parents)):
        carrier = next((up for up in way_up(parents, j) if up in turns), None)
        if carrier is not None:
            turns[j] = turns[carrier]
    return turns, rolls


def axial(R: np.ndarray, bone: np.ndarray) -> np.ndarray:
    """Compute the twists (T,), radians, of rotations R (T, 3, 3) about a bone (3,), after the smallest swing."""
    q = Rotation.from_matrix(R).as_quat()
    return rotations.wrap_angle(2 * np.arctan2(q[:, :3] @ bone, q[:, 3]))


def _nearer(roll: float, wanted: np.ndarray) -> float:
    """Return the roll if it is nearer to the wanted angles on average than none is, else 0."""
    mean = _mean_angle(wanted) if len(wanted) else 0.0
    return roll if abs(rotations.wrap_angle(mean - roll)) < abs(mean) else 0.0


def _mean_angle(angles: np.ndarray, weights: np.ndarray | float = 1.0) -> float:
    return float(np.angle((weights * np.exp(1j * angles)).sum()))


def _unit(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12))

