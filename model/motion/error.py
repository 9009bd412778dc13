"""How far a body's joint centres and segments are from those of the motion that it follows."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..linear import PointOperator, Subject
from .retarget import Pairing

# Segments from the hips outwards; "hips" and "shoulders" are the middle between both sides.
_ENDS = (("hips", "shoulders"), ("shoulders", "skullbase"),
         *((middle, f"{side}_{end}") for middle, end in (("hips", "hip"), ("shoulders", "shoulder")) for side in "lr"),
         *((f"{side}_{start}", f"{side}_{end}") for side in "lr" for start, end in
           (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"))))
MOST = 10.0                          # degrees that segments may be off, on average


@dataclass(frozen=True, eq=False)
class Followed:
    """How well a body follows a motion."""

    names: tuple[str, ...]           # of the ends of the S segments
    angles: np.ndarray               # (T, S) degrees between the segments of the body and of the motion
    distances: np.ndarray            # (T, S) metres, of the joint centres at their ends, where bones are as ours
    wanted: np.ndarray               # (T, S, 3) metres, where those would be

    @property
    def angle(self) -> float:
        """Degrees, the mean."""
        return float(self.angles.mean())

    @property
    def distance(self) -> float:
        """Metres, the mean."""
        return float(self.distances.mean())


def joint_centres(subject: Subject, poses: np.ndarray, trans: np.ndarray) -> np.ndarray:
    """(T, J, 3) metres: where the joints are, as affine combinations of the surface around them."""
    regressor = subject.skeleton.joint_regressor(subject.template)
    M, N, _ = subject.basis.shape
    basis = (regressor @ subject.basis.transpose(1, 0, 2).reshape(N, -1)).reshape(-1, M, 3).transpose(1, 0, 2)
    return PointOperator(subject.terms, basis.astype(np.float64), subject.origin).evaluate(poses, trans)


def followed(pair: Pairing, centres: np.ndarray) -> Followed:
    """The error of a body whose joints are at centres (T, J, 3), metres, against the motion of the pair.

    Bones differ in length, so the joints of the motion are set out anew from the middle of the hips: in the directions
    of its segments, as far apart as ours are at rest.
    """
    there = _nodes(pair.moving.places @ pair.world(False).T, pair.theirs)
    here, rest = _nodes(centres, pair.ours), _nodes(pair.skeleton.joints, pair.ours)
    ends = [(a, b) for a, b in _ENDS if {a, b} <= there.keys() & here.keys()]
    wanted, angles = {"hips": here["hips"]}, []
    for a, b in ends:
        theirs, ours = there[b] - there[a], here[b] - here[a]
        size = np.linalg.norm(theirs, axis=1, keepdims=True)
        wanted[b] = wanted[a] + np.linalg.norm(rest[b] - rest[a]) * theirs / np.maximum(size, 1e-12)
        sine = np.linalg.norm(np.cross(theirs, ours), axis=1)
        angles.append(np.degrees(np.arctan2(sine, (theirs * ours).sum(axis=1))))
    places = np.stack([wanted[b] for _, b in ends], axis=1)
    off = np.linalg.norm(np.stack([here[b] for _, b in ends], axis=1) - places, axis=2)
    return Followed(tuple(b for _, b in ends), np.stack(angles, axis=1), off, places)


def _nodes(joints: np.ndarray, roles: dict[str, int]) -> dict[str, np.ndarray]:
    """Places (..., 3) by name, of joints (..., J, 3) and the middles between both sides."""
    out = {role: joints[..., j, :] for role, j in roles.items()}
    return out | {f"{name}s": (out[f"l_{name}"] + out[f"r_{name}"]) / 2 for name in ("hip", "shoulder")}
