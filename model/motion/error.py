"""Retargeting error: how far joint centres, segments and twists are from those of the motion that a body follows."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from scanprep.geometry import rotations
from scanprep.skeleton.roles import NEEDED, SIDED_ROLES, find_numbered_roles, in_words
from scanprep.skeleton.tree import Skeleton

from .retarget import Pairing, body_axes
from .trunks import swing
from .twist import BENT, Roll, axial, find_hinges

# segments from the hips outwards; "hips" and "shoulders" are the middle between both sides
_ENDS = (("hips", "shoulders"), ("shoulders", "skullbase"),
         *((middle, f"{side}_{end}") for middle, end in (("hips", "hip"), ("shoulders", "shoulder")) for side in "lr"),
         *((f"{side}_{start}", f"{side}_{end}") for side in "lr" for start, end in
           (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"))))
MOST, LEAN = 10.0, 20.0              # degrees: acceptable mean error of segments, and difference of trunks at rest
SHARE = 0.05                         # share of frames with a wrong twist from which on a motion is to be looked at
ASIDE = 10.0                         # degrees: hinges of good motions are up to 7 beyond what is allowed


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


@dataclass(frozen=True, eq=False)
class TwistError:
    """How the P upper arms, forearms, thighs and shanks of a motion are twisted about their bones, degrees."""

    parts: tuple[str, ...]           # in words
    joints: tuple[str, ...]          # the elbow or knee of each, in words
    twists: np.ndarray               # (T, P) from the part above, 0 at rest
    limits: np.ndarray               # (P,) human ranges to both sides
    beside: np.ndarray               # (T, P) by how much more than is allowed the hinge bends beside its axis
    changed: np.ndarray              # (T, P) by how much the hinge contradicted the motion, and was followed
    rolled: np.ndarray               # (P,) by how much the bones of the motion were rolled otherwise at rest

    @property
    def reasons(self) -> list[str]:
        """Why the twists need a look, in words."""
        out, size = [], np.abs(self.twists)
        for p, (part, joint) in enumerate(zip(self.parts, self.joints, strict=True)):
            doubts = (
                (size, self.limits[p], f"the {part} is twisted by {{}} degrees about its axis, more than a person's"),
                (self.beside, ASIDE, f"the {joint} bends {{}} degrees more beside its axis than a person's: is the "
                 f"{part} twisted?"),
                (np.abs(self.changed), ASIDE, f"the motion twists the {part} by {{}} degrees against the bend of the "
                 f"{joint}, which was followed"))
            for degrees, most, why in doubts:
                wrong = degrees[degrees[:, p] > most, p]
                if len(wrong) > SHARE * len(degrees):
                    out.append(f"in {len(wrong)} of {len(degrees)} frames {why.format(f'{wrong.mean():.0f}')}")
        return out


def measure_twist(skeleton: Skeleton, poses: np.ndarray, centres: np.ndarray, rolls: Mapping[int, Roll] | None = None
                  ) -> TwistError | None:
    """Measure the twists of a body with a `skeleton` in poses (T, J, 3), radians, with joint centres (T, J, 3), metres.

    None for a body without the names, or the hinges, of a person.
    """
    roles, rolls = find_numbered_roles(skeleton.names, skeleton.joints), rolls or {}
    if not {*NEEDED} <= roles.keys():
        return None
    R, T = skeleton.part_rotations(poses), len(poses)
    none = Roll(0.0, np.zeros(T), np.zeros(3))
    names, twists, limits, beside, changed, rolled = [], [], [], [], [], []
    for hinge in find_hinges(skeleton.joints, roles, body_axes(skeleton.joints, roles)[:, 2], centres, roles):
        # the upper part against the trunk, also where a clavicle is between; the lower against the upper
        above = int(skeleton.parents[hinge.parts[0]])
        if above == roles.get(f"{hinge.side[0]}_sternoclavicular"):
            above = int(skeleton.parents[above])
        for k, (top, part) in enumerate(((above, hinge.parts[0]), hinge.parts[:2])):
            role = next(role for role, j in roles.items() if j == part)
            names.append((in_words(f"{SIDED_ROLES[role[2:]].part}_{hinge.side}"), f"{hinge.side} {hinge.joint}"))
            twists.append(axial(np.swapaxes(R[:, top], -1, -2) @ R[:, part], hinge.bones[k]))
            limits.append(hinge.limits[k])
            over = np.maximum(np.abs(hinge.angles(R[:, part], k)) - hinge.tolerance(k), 0)
            beside.append(np.where(hinge.bend > BENT, over, 0))
            changed.append(rolls.get(part, none).changing)
            rolled.append(np.degrees(rolls.get(part, none).constant))
    if not names:
        return None
    parts, joints = zip(*names, strict=True)
    turned, off, against = (np.degrees(np.stack(each, axis=1)) for each in (twists, beside, changed))
    return TwistError(parts, joints, turned, np.array(limits), off, against, np.array(rolled))


def _nodes(joints: np.ndarray, roles: dict[str, int]) -> dict[str, np.ndarray]:
    """Collect positions (..., 3) by name: of joints (..., J, 3) and of the middles between both sides."""
    out = {role: joints[..., j, :] for role, j in roles.items()}
    return out | {f"{name}s": (out[f"l_{name}"] + out[f"r_{name}"]) / 2 for name in ("hip", "shoulder")}
