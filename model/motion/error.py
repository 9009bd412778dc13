"""Retargeting error: how far joint centres and segments are from those of the motion that a body follows."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanprep.geometry import rotations

from .retarget import Pairing
from .trunks import swing

# segments from the hips outwards; "hips" and "shoulders" are the middle between both sides
_ENDS = (("hips", "shoulders"), ("shoulders", "skullbase"),
         *((middle, f"{side}_{end}") for middle, end in (("hips", "hip"), ("shoulders", "shoulder")) for side in "lr"),
         *((f"{side}_{start}", f"{side}_{end}") for side in "lr" for start, end in
           (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"))))
MOST, LEAN = 10.0, 20.0              # degrees: acceptable mean error of segments, and difference of trunks at rest


@dataclass(frozen=True, eq=False)
class RetargetingError:
    """How well a body follows a motion."""

    names: tuple[str, ...]           # of the ends of the S segments
    angles: np.ndarray               # (T, S) degrees between the segments of the body and of the motion
    distances: np.ndarray            # (T, S) metres, of the joint centres at their ends, for bones of our length
    wanted: np.ndarray               # (T, S, 3) metres, where these joint centres should be
    lean: float                      # degrees between the directions of the two trunks at rest

    @property
    def angle(self) -> float:
        """Degrees, the mean."""
        return float(self.angles.mean())

    @property
    def distance(self) -> float:
        """Metres, the mean."""
        return float(self.distances.mean())


def measure_error(pair: Pairing, poses: np.ndarray, centres: np.ndarray) -> RetargetingError:
    """Measure the error of a body in poses (T, J, 3), with joint centres (T, J, 3), against the motion of the pair.

    Bones differ in length. So the joints of the motion are placed anew from the middle of the hips, in the directions
    of its segments and at our distances. Hips, shoulders and head differ between trunks. So the difference of the
    trunk segments at rest is corrected, and reported as `lean`.
    """
    V, R = pair.world(False), pair.skeleton.part_rotations(poses)
    there, here = _nodes(pair.moving.places @ V.T, pair.theirs), _nodes(centres, pair.ours)
    their_rest = _nodes(pair.moving.rest @ V.T, pair.theirs)
    rest = _nodes(pair.skeleton.joints, pair.ours)
    frames = {"hips": R[:, pair.ours["humanoid_root"]], "shoulders": R[:, pair.middle()[0][-1]]}
    ends = [(a, b) for a, b in _ENDS if {a, b} <= there.keys() & here.keys()]
    wanted, angles, lean = {"hips": here["hips"]}, [], 0.0
    for a, b in ends:
        they, bone = there[b] - there[a], rest[b] - rest[a]
        if a in frames:
            C = swing(np.eye(3)[None], their_rest[b] - their_rest[a], bone[None])[0]
            they = np.einsum("tab,bc,tdc,td->ta", frames[a], C, frames[a], they)
            lean = float(np.degrees(np.linalg.norm(rotations.log(C)))) if b == "shoulders" else lean
        still = np.linalg.norm(their_rest[b] - their_rest[a])              # a trunk that bends is shorter
        wanted[b] = wanted[a] + np.linalg.norm(bone) / max(float(still), 1e-12) * they
        own = here[b] - here[a]
        angles.append(np.degrees(np.arctan2(np.linalg.norm(np.cross(they, own), axis=1), (they * own).sum(axis=1))))
    places = np.stack([wanted[b] for _, b in ends], axis=1)
    off = np.linalg.norm(np.stack([here[b] for _, b in ends], axis=1) - places, axis=2)
    return RetargetingError(tuple(b for _, b in ends), np.stack(angles, axis=1), off, places, lean)


def _nodes(joints: np.ndarray, roles: dict[str, int]) -> dict[str, np.ndarray]:
    """Collect positions (..., 3) by name: of joints (..., J, 3) and of the middles between both sides."""
    out = {role: joints[..., j, :] for role, j in roles.items()}
    return out | {f"{name}s": (out[f"l_{name}"] + out[f"r_{name}"]) / 2 for name in ("hip", "shoulder")}
