"""How far a body's joint centres and segments are from those of the motion that it follows."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanprep.geometry import rotations

from .retarget import Pairing
from .trunks import swing

# Segments from the hips outwards; "hips" and "shoulders" are the middle between both sides.
_ENDS = (("hips", "shoulders"), ("shoulders", "skullbase"),
         *((middle, f"{side}_{end}") for middle, end in (("hips", "hip"), ("shoulders", "shoulder")) for side in "lr"),
         *((f"{side}_{start}", f"{side}_{end}") for side in "lr" for start, end in
           (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"))))
MOST, LEAN = 10.0, 20.0              # degrees that segments may be off on average, and a trunk lean otherwise at rest


@dataclass(frozen=True, eq=False)
class RetargetingError:
    """How well a body follows a motion."""

    names: tuple[str, ...]           # of the ends of the S segments
    angles: np.ndarray               # (T, S) degrees between the segments of the body and of the motion
    distances: np.ndarray            # (T, S) metres, of the joint centres at their ends, where bones are as ours
    wanted: np.ndarray               # (T, S, 3) metres, where those would be
    lean: float                      # degrees, how much their trunk leans otherwise at rest than ours

    @property
    def angle(self) -> float:
        """Degrees, the mean."""
        return float(self.angles.mean())

    @property
    def distance(self) -> float:
        """Metres, the mean."""
        return float(self.distances.mean())


def measure_error(pair: Pairing, poses: np.ndarray, centres: np.ndarray) -> RetargetingError:
    """The error of a body in poses (T, J, 3), with its joints at centres (T, J, 3), against the motion of the pair.

    Bones differ in length, so the joints of the motion are set out anew from the middle of the hips: in the directions
    of its segments, as far apart as ours are at rest. Hips, shoulders and head are not at the same places in two
    trunks: by how much a segment of the trunk points elsewhere at rest is allowed for, and told.
    """
    V, R = pair.world(False), pair.skeleton.part_rotations(poses)
    there, here = _nodes(pair.moving.places @ V.T, pair.theirs), _nodes(centres, pair.ours)
    their_rest = _nodes(pair.moving.rest @ V.T, pair.theirs)
    rest = _nodes(pair.skeleton.joints, pair.ours)
    frames = {"hips": R[:, pair.ours["humanoid_root"]], "shoulders": R[:, pair.middle()[0][-1]]}
    ends = [(a, b) for a, b in _ENDS if {a, b} <= there.keys() & here.keys()]
    wanted, angles, lean = {"hips": here["hips"]}, [], 0.0
    for a, b in ends:
        theirs, bone = there[b] - there[a], rest[b] - rest[a]
        if a in frames:
            C = swing(np.eye(3)[None], their_rest[b] - their_rest[a], bone[None])[0]
            theirs = np.einsum("tab,bc,tdc,td->ta", frames[a], C, frames[a], theirs)
            lean = float(np.degrees(np.linalg.norm(rotations.log(C)))) if b == "shoulders" else lean
        still = np.linalg.norm(their_rest[b] - their_rest[a])              # a trunk that bends is shorter
        wanted[b] = wanted[a] + np.linalg.norm(bone) / max(float(still), 1e-12) * theirs
        own = here[b] - here[a]
        angles.append(np.degrees(np.arctan2(np.linalg.norm(np.cross(theirs, own), axis=1), (theirs * own).sum(axis=1))))
    places = np.stack([wanted[b] for _, b in ends], axis=1)
    off = np.linalg.norm(np.stack([here[b] for _, b in ends], axis=1) - places, axis=2)
    return RetargetingError(tuple(b for _, b in ends), np.stack(angles, axis=1), off, places, lean)


def _nodes(joints: np.ndarray, roles: dict[str, int]) -> dict[str, np.ndarray]:
    """Places (..., 3) by name, of joints (..., J, 3) and the middles between both sides."""
    out = {role: joints[..., j, :] for role, j in roles.items()}
    return out | {f"{name}s": (out[f"l_{name}"] + out[f"r_{name}"]) / 2 for name in ("hip", "shoulder")}
