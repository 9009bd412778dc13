"""Retargeting: poses and travel of one skeleton for another, by the names of joints and the directions of bones."""
from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from scanprep.geometry import rotations

from ...export.bvh_read import BvhMotion
from ...export.rig import check_motion
from ..control.model import ControlModel

# What the joints of our parts are called elsewhere, in H-Anim, motion databases and animation programs, in small
# letters without separators; the first that a skeleton has is taken, and none twice. A knee may be a "leg" (below an
# "up leg") and a clavicle a "shoulder" (above an "arm"): so the order of the rows matters.
ROLES = {
    "humanoid_root": ("sacroiliac", "pelvis", "hips", "humanoidroot", "hip", "root"),
    "skullbase": ("skullbase", "head", "skull", "neck1", "neck"),
    "vl5": ("vl5", "spine", "spine1", "spine01", "abdomen", "lowerback", "waist", "torso", "chest", "back")}
SIDED_ROLES = {
    "shoulder": ("upperarm", "uparm", "humerus", "arm", "shldr", "shoulder"),
    "sternoclavicular": ("sternoclavicular", "clavicle", "collar", "collarbone", "shoulder"),
    "elbow": ("elbow", "forearm", "lowerarm", "lowarm", "radius"),
    "wrist": ("wrist", "radiocarpal", "hand"),
    "knee": ("knee", "lowerleg", "lowleg", "shin", "shank", "calf", "tibia", "leg"),
    "hip": ("upleg", "thigh", "upperleg", "femur", "hip", "leg", "hipjoint"),
    "ankle": ("ankle", "talocrural", "foot")}


def find_roles(names: Sequence[str]) -> dict[str, int]:
    """The joints that play the parts of the humanoid, {H-Anim name: joint}; case, separators and what stands before a
    colon do not matter.
    """
    plain: dict[str, int] = {}
    for j, name in enumerate(names):
        letters = re.sub(r"[^a-z0-9]", "", name.rsplit(":", 1)[-1].lower())
        letters = re.sub(r"^(mixamorig|bip|jbipc?|def|character)\d*", "", letters)
        plain.setdefault(re.sub(r"(jnt|bone)$", "", letters), j)
    forms = dict(ROLES)
    for word, words in SIDED_ROLES.items():
        for side, spelt in (("l", ("left", "l")), ("r", ("right", "r"))):
            forms[f"{side}_{word}"] = tuple(form for each in words for s in spelt for form in (s + each, each + s))
    out: dict[str, int] = {}
    for role, words in forms.items():
        free = [plain[form] for form in words if form in plain and plain[form] not in out.values()]
        if free:
            out[role] = free[0]
    return out


def above(parents: np.ndarray, j: int) -> list[int]:
    """The joint, its parent, and so on up to the root."""
    chain = [j]
    while parents[chain[-1]] >= 0:
        chain.append(int(parents[chain[-1]]))
    return chain


def trunk(parents: np.ndarray, roles: Mapping[str, int]) -> tuple[int, int]:
    """The lowest joint of the trunk above the pelvis, and the one that carries arms and head; the pelvis for both where
    the tree has none between.
    """
    pelvis = roles["humanoid_root"]
    chains = [above(parents, roles[role]) for role in ("l_shoulder", "r_shoulder") if role in roles]
    if len(chains) < 2:
        lowest = roles.get("vl5", pelvis)
        return lowest, lowest
    top = next(j for j in chains[0] if j in chains[1])
    way = above(parents, top)
    if pelvis not in way or top == pelvis:
        lowest = roles.get("vl5", top)
        return (lowest, top) if lowest in way else (top, top)
    return way[way.index(pelvis) - 1], top


@dataclass(frozen=True, eq=False)
class StatueMotion:
    """A motion of a statue, by the conventions of the body models."""

    poses: np.ndarray                # (T, J, 3) radians, against the default pose, which is that of the scan
    trans: np.ndarray                # (T, 3) metres, travel of the root's joint
    rate: float                      # frames a second
    matched: dict[str, str]          # {part of the statue: joint that it follows}
    lacking: tuple[str, ...] = ()    # parts that go with the one above them: the motion has no such joint


class Pairing:
    """A statue and a skeleton that moves, both at rest: `P` (J, 3, 3) is how the generic model's parts were rotated to
    the pose of the scan, `joints` (J, 3) those of the statue in the generic default pose, `ours` and `theirs` the parts
    and joints by their H-Anim names.
    """

    def __init__(self, control: ControlModel, pose: np.ndarray, moving: BvhMotion) -> None:
        self.control, self.moving = control, moving
        skeleton = control.skeleton
        self.P = skeleton.part_rotations(check_motion(skeleton, np.asarray(pose)[None], None, 1.0)[0][0])
        self.joints = skeleton.joints.copy()
        for j, p in enumerate(skeleton.parents[1:], start=1):
            self.joints[j] = self.joints[p] + self.P[p].T @ (skeleton.joints[j] - skeleton.joints[p])
        self.ours = find_roles(skeleton.names)
        self.theirs = find_roles(moving.names)
        wanted = ("humanoid_root", "l_hip", "r_hip", "l_shoulder", "r_shoulder")
        for what, found, all_names in (("control model", self.ours, skeleton.names),
                                       ("motion", self.theirs, moving.names)):
            missing = [role for role in wanted if role not in found]
            if missing:
                raise ValueError(f"{what}: expected joints named like {', '.join(missing)}, found only "
                                 f"{', '.join(all_names)}")
        self.axes = _axes(self.joints, self.ours)
        feet = [skeleton.joints[self.ours[r]] for r in ("l_ankle", "r_ankle", "l_hip", "r_hip") if r in self.ours]
        high = skeleton.joints[self.ours.get("skullbase", self.ours["l_shoulder"])] - np.mean(feet[:2], axis=0)
        self.up = _nearest_axis(high)

    def alignment(self, aligned: bool) -> dict[int, np.ndarray]:
        """For each part the rotation from the axes of the generic model to those of the motion at rest.

        The smallest rotation that brings our bone to theirs, after that of the part above. Feet stand flat, but where
        the legs are far apart at rest (as in the CMU files) they are taken to be square to the shanks from the front.
        """
        J = len(self.control.skeleton.parents)
        whole = self.whole(aligned)
        A = dict.fromkeys(range(J), whole)
        for side in "lr" if not aligned else "":
            for chain in (("shoulder", "elbow", "wrist"), ("hip", "knee", "ankle")):
                roles = [f"{side}_{name}" for name in chain]
                R = whole
                for role, following in pairwise(roles):
                    if {role, following} <= self.ours.keys() & self.theirs.keys():
                        own = self.joints[self.ours[following]] - self.joints[self.ours[role]]
                        other = self.moving.rest[self.theirs[following]] - self.moving.rest[self.theirs[role]]
                        R = Rotation.align_vectors(other, R @ own)[0].as_matrix() @ R
                        A[self.ours[role]] = R
                if chain[2] == "wrist" and roles[2] in self.ours:
                    A[self.ours[roles[2]]] = R                          # a hand continues the forearm
                elif {*roles[1:]} <= self.ours.keys() & self.theirs.keys():
                    knee, ankle = self.moving.rest[[self.theirs[role] for role in roles[1:]]]
                    left, down, _ = self.standing(False).T @ (ankle - knee) * [1, -1, 1]
                    aside = np.arctan2(left, down)
                    if abs(aside) > np.radians(10):
                        A[self.ours[roles[2]]] = rotations.exp(aside * self.standing(False)[:, 2]) @ whole
        return A

    def trunk(self) -> np.ndarray:
        """(T, 3, 3) of the one joint that stands for the trunk of the motion."""
        moving, theirs = self.moving, self.theirs
        low, top = trunk(moving.parents, theirs)
        rest, R, y = moving.rest, moving.rotations, moving.places
        roles = [role for role in ("l_shoulder", "r_shoulder", "skullbase") if role in theirs]
        points = rest[[theirs[role] for role in roles]]
        there = np.einsum("tab,kb->tka", R[:, top], points - rest[top]) + (y[:, top] - y[:, low])[:, None]
        return rotations.project(np.einsum("tka,kb->tab", there, points - rest[low]))

    def world(self, aligned: bool) -> np.ndarray:
        """The rotation (3, 3) from the axes of the motion to those of the scan: upwards to upwards, and forwards at
        rest to where the scan faces.
        """
        return _upright(self.P[0] @ self.axes[:, 2], self.up) @ self.standing(aligned).T

    def whole(self, aligned: bool) -> np.ndarray:
        """The rotation (3, 3) from the axes of the generic model to those of the motion, both standing at rest."""
        return self.standing(aligned) @ self.standing(True).T

    def standing(self, ours: bool) -> np.ndarray:
        """(3, 3) to the left, upwards and forwards in the rest of the generic model or of the motion.

        Upwards is the axis next to the trunk: joints of a person who stands upright need not lie above each other.
        """
        _, high, forwards = (self.axes if ours else _axes(self.moving.rest, self.theirs)).T
        return _upright(forwards, _nearest_axis(high))


def retargeted(pair: Pairing, aligned: bool, girdle: float = 0.2) -> StatueMotion:
    """The motion of the pair's skeleton on its statue; `aligned`: the generic model rests as that skeleton does.

    Where the motion has no clavicles, ours are raised by a share `girdle` of the upper arms' angle above the level.
    """
    moving, skeleton = pair.moving, pair.control.skeleton
    A = pair.alignment(aligned)
    role_of = {part: role for role, part in pair.ours.items()}
    M = np.empty((len(moving.places), len(skeleton.parents), 3, 3))     # from the generic model's axes to the world
    lacking, matched = [], {}
    for j, name in enumerate(skeleton.names):
        role = role_of.get(j, "")
        if role == "vl5":
            low, top = trunk(moving.parents, pair.theirs)
            M[:, j] = pair.trunk() @ A[j]
            matched[name] = moving.names[low] if low == top else f"{moving.names[low]} to {moving.names[top]}"
        elif role in pair.theirs:
            M[:, j] = moving.rotations[:, pair.theirs[role]] @ A[j]
            matched[name] = moving.names[pair.theirs[role]]
        else:
            lacking.append(name)
            M[:, j] = M[:, skeleton.parents[j]] if j else np.eye(3)
    _raise_clavicles(pair, M, girdle)
    V = pair.world(aligned)
    R = V @ M @ np.swapaxes(pair.P, -1, -2)
    poses = skeleton.pose_of(R)
    return StatueMotion(poses, _travel(pair, V, R, poses), moving.rate, matched, tuple(lacking))


def _raise_clavicles(pair: Pairing, M: np.ndarray, share: float) -> None:
    """Where the motion has no clavicles, raise ours by a share of what the upper arms are above the horizontal."""
    left, high, _ = pair.axes.T
    for side, outwards in (("l", left), ("r", -left)):
        parts = [pair.ours.get(f"{side}_{name}") for name in ("sternoclavicular", "shoulder", "elbow")]
        if None in parts or f"{side}_sternoclavicular" in pair.theirs:
            continue
        clavicle, arm, elbow = parts
        own = pair.joints[elbow] - pair.joints[arm]
        own = own / np.linalg.norm(own)
        sine = np.einsum("tab,a,tbc,c->t", np.swapaxes(M[:, clavicle], -1, -2), high, M[:, arm], own)
        angle = share * np.maximum(np.arcsin(np.clip(sine, -1, 1)), 0)
        M[:, clavicle] = M[:, clavicle] @ rotations.exp(angle[:, None] * np.cross(outwards, high))


def _travel(pair: Pairing, V: np.ndarray, R: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """(T, 3) travel of the root's joint, with the middle between the hips where that of the motion is, scaled."""
    control, up = pair.control, pair.up
    joints = control.skeleton.joints
    ours = [pair.ours["l_hip"], pair.ours["r_hip"]]
    theirs = [pair.theirs["l_hip"], pair.theirs["r_hip"]]
    middle = joints[ours].mean(axis=0)
    scale = _leg(joints, pair.ours, pair.theirs) / _leg(pair.moving.rest, pair.theirs, pair.ours)
    place = scale * pair.moving.places[:, theirs].mean(axis=1) @ V.T
    place = place - place[0] + middle
    trans = place + R[:, 0] @ (joints[0] - middle) - joints[0]
    lowest = np.concatenate([(control.rig.vertices(poses[k:k + 200], trans[k:k + 200]) @ up).min(axis=1)
                             for k in range(0, len(poses), 200)])
    # percentile: some frames may err
    return trans + ((control.mesh.vertices @ up).min() - np.percentile(lowest, 5)) * up


def _leg(joints: np.ndarray, roles: Mapping[str, int], others: Mapping[str, int]) -> float:
    """Mean length of the legs, as far as both skeletons have them; without knees that of the trunk."""
    chains = [[roles[f"{side}_{name}"] for name in ("hip", "knee", "ankle") if f"{side}_{name}" in roles.keys()
               & others.keys()] for side in "lr"]
    if min(map(len, chains)) < 2:
        chains = [[roles[f"{side}_hip"], roles[f"{side}_shoulder"]] for side in "lr"]
    return float(np.mean([np.linalg.norm(np.diff(joints[chain], axis=0), axis=1).sum() for chain in chains]))


def _axes(joints: np.ndarray, roles: Mapping[str, int]) -> np.ndarray:
    """(3, 3) columns: to the left, upwards and forwards of a body at rest, from its hips and shoulders."""
    hips, shoulders = ([joints[roles[f"{side}_{name}"]] for side in "lr"] for name in ("hip", "shoulder"))
    across = sum((a - b) / max(float(np.linalg.norm(a - b)), 1e-12) for a, b in (hips, shoulders))
    high = np.mean(shoulders, axis=0) - np.mean(hips, axis=0)
    forwards = np.cross(across, high)
    size = np.linalg.norm(forwards)
    if not size > 1e-6 * np.linalg.norm(across) * np.linalg.norm(high):
        raise ValueError("joints: expected hips and shoulders that are not in one line at rest")
    return np.stack([np.cross(high, forwards) / np.linalg.norm(high) / size, high / np.linalg.norm(high),
                     forwards / size], axis=1)


def _nearest_axis(direction: np.ndarray) -> np.ndarray:
    main = int(np.abs(direction).argmax())
    return np.eye(3)[main] * np.sign(direction[main])


def _upright(forwards: np.ndarray, up: np.ndarray) -> np.ndarray:
    """(3, 3) columns: to the left, upwards and, level, forwards."""
    level = forwards - (forwards @ up) * up
    if np.linalg.norm(level) < 0.1:                                     # lies on the back or on the face
        level = np.eye(3)[np.abs(up).argmin()]
        level = level - (level @ up) * up
    level = level / np.linalg.norm(level)
    return np.stack([np.cross(up, level), up, level], axis=1)
