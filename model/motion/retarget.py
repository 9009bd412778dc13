"""Retargeting: a motion of one skeleton on another with a different rest pose, bones and parts.

Every part of ours with a counterpart takes the counterpart's rotation, after the rotation that aligns the two bones at
rest. So the directions of the limbs are exactly those of the motion. Their twists are too, unless elbows and knees
would then bend aside. A trunk of any number of joints is mapped to ours.
"""
from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from scanprep.geometry import rotations
from scanprep.skeleton.roles import NEEDED, above, find_numbered_roles, trunk, way
from scanprep.skeleton.tree import Skeleton

from ..rig import check_motion, joint_places
from .moving import MovingSkeleton
from .trunks import group_trunk, heights, nearest_starts, spread_rotations
from .twist import Roll, find_hinges, roll_limbs

Vertices = Callable[[np.ndarray, np.ndarray], np.ndarray]   # poses (T, J, 3), trans (T, 3) -> (T, N, 3), metres


@dataclass(frozen=True, eq=False)
class Retargeted:
    """A retargeted motion, in the conventions of the body models."""

    poses: np.ndarray                # (T, J, 3) radians, against the body at rest
    trans: np.ndarray                # (T, 3) metres, travel of the root's joint
    rate: float                      # frames a second
    matched: dict[str, str]          # {part of the body: joint that it follows}
    lacking: tuple[str, ...] = ()    # parts that the motion has no joint for; they follow their parent
    scale: float = 1.0               # of the travel: ratio of the lengths of the legs
    rolls: Mapping[int, Roll] = field(default_factory=dict)      # of parts, by their hinges


class Pairing:
    """A body and a moving skeleton, both at rest, with their corresponding joints.

    Parameters
    ----------
    skeleton : Skeleton
        With the joints of the body.
    vertices : Vertices
        The body's surface in some poses.
    moving : MovingSkeleton
        The skeleton of the motion.
    pose : (J, 3) float, radians, optional
        For a statue: rotations of the generic model's parts to the pose of the scan, which is its rest.

    Attributes
    ----------
    P : (J, 3, 3) float
        The rotations of that pose.
    joints : (J, 3) float, metres
        Those of the body with that pose undone.
    ours, theirs : dict
        Parts and joints by their H-Anim names.
    """

    def __init__(self, skeleton: Skeleton, vertices: Vertices, moving: MovingSkeleton, pose: np.ndarray | None = None
                 ) -> None:
        self.skeleton, self.vertices, self.moving = skeleton, vertices, moving
        pose = np.zeros(skeleton.joints.shape) if pose is None else np.asarray(pose)
        self.P = skeleton.part_rotations(check_motion(skeleton, pose[None], None, 1.0)[0][0])
        self.joints = skeleton.joints.copy()
        for j, p in enumerate(skeleton.parents[1:], start=1):
            self.joints[j] = self.joints[p] + self.P[p].T @ (skeleton.joints[j] - skeleton.joints[p])
        self.ours = find_numbered_roles(skeleton.names, skeleton.joints)
        self.theirs = find_numbered_roles(moving.names, moving.rest)
        for what, found, names in (("body", self.ours, skeleton.names), ("motion", self.theirs, moving.names)):
            missing = [role for role in NEEDED if role not in found]
            if missing:
                raise ValueError(f"{what}: expected joints named like {', '.join(missing)}, found only "
                                 f"{', '.join(names)}"[:400])
        self.axes = body_axes(self.joints, self.ours)
        feet = [skeleton.joints[self.ours[r]] for r in ("l_ankle", "r_ankle", "l_hip", "r_hip") if r in self.ours]
        high = skeleton.joints[self.ours.get("skullbase", self.ours["l_shoulder"])] - np.mean(feet[:2], axis=0)
        self.up = _nearest_axis(high)

    def alignment(self, aligned: bool) -> dict[int, np.ndarray]:
        """Compute for each part the rotation from the axes of the generic model to those of the motion at rest.

        It is the smallest rotation that aligns our bone with theirs, after that of the parent. Feet stand flat. Where
        the legs are far apart at rest, as in the CMU files, feet are perpendicular to the shanks seen from the front.
        """
        # from the axes of the generic model to those of the motion, both standing at rest
        whole = self.standing(aligned) @ self.standing(True).T
        A = dict.fromkeys(range(len(self.joints)), whole)
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
        for j, p in enumerate(self.skeleton.parents.tolist()):
            if p >= 0 and j not in self.ours.values():
                A[j] = A[p]                                             # fingers, toes, a second piece of a thigh
        return A

    def middle(self) -> tuple[list[int], list[int]]:
        """List our parts from the pelvis to the one that carries the arms, and from there to the head, with ends."""
        parents, ours = self.skeleton.parents, self.ours
        arms = [way(parents, ours["humanoid_root"], ours[f"{side}_shoulder"]) for side in "lr"]
        carrier = [part for part in arms[0] if part in arms[1]][-1]
        head = ours.get("skullbase", carrier)
        return way(parents, ours["humanoid_root"], carrier), way(parents, carrier, head)

    def trunk(self) -> tuple[dict[int, np.ndarray], dict[int, str]]:
        """Compute the rotation (T, 3, 3) of each of our parts between pelvis and head, and what it follows."""
        # the joints of their trunk and neck, however the tree is arranged
        moving, R = self.moving, self.moving.rotations
        below, beyond = self.middle()
        parts, low, top = below[1:], *trunk(moving.parents, self.theirs)
        pelvis = self.theirs["humanoid_root"]
        joints = way(moving.parents, low, top)
        if pelvis not in above(moving.parents, top) and "vl5" in self.theirs:      # a tree that hangs on the chest
            joints = way(moving.parents, pelvis, top)[1:]
        necks = way(moving.parents, top, self.theirs.get("skullbase", top))
        if len(joints) < len(parts):
            out, told = spread_rotations(moving, [pelvis, *joints] if joints[0] != pelvis else joints, parts)
        elif parts:
            links = [b if self.skeleton.parents[b] == a else a for a, b in pairwise(below)]
            starts = nearest_starts(heights(self.joints, links, self.ours), heights(moving.rest, joints, self.theirs))
            carried = [self.theirs[role] for role in ("l_shoulder", "r_shoulder", "skullbase") if role in self.theirs]
            out, told = group_trunk(moving, joints, starts, parts, carried)
        else:
            out, told = {}, {}
        more = spread_rotations(moving, necks, beyond[1:])
        for part in beyond[1:-1]:
            out[part], told[part] = more[0][part], more[1][part]
        return {part: np.broadcast_to(M, R[:, 0].shape) for part, M in out.items()}, told

    def world(self, aligned: bool) -> np.ndarray:
        """Compute the rotation (3, 3) from the axes of the motion to those of the scan: up to up, front to front."""
        return _upright(self.P[0] @ self.axes[:, 2], self.up) @ self.standing(aligned).T

    def standing(self, ours: bool) -> np.ndarray:
        """Compute the axes (3, 3) left, up and front in the rest pose of the generic model or of the motion.

        Up is the coordinate axis nearest to the trunk, since the joints of a standing person are not in one line.
        """
        _, high, forwards = (self.axes if ours else body_axes(self.moving.rest, self.theirs)).T
        return _upright(forwards, _nearest_axis(high))


def retarget_pair(pair: Pairing, aligned: bool = False, here: bool = False) -> Retargeted:
    """Retarget the motion of a pair's skeleton to its body; with `aligned`, the two have the same rest pose.

    Where the motion has no clavicles, ours are raised by a fifth of the upper arms' elevation.
    Travel is scaled as the legs are, about the origin of the file. With `here` it begins where the body stands at rest.
    """
    # rotation of every part: of the trunk, of the joint with the same role or name, else that of the parent
    moving, skeleton = pair.moving, pair.skeleton
    A = pair.alignment(aligned)
    role_of = {part: role for role, part in pair.ours.items()}
    # elbows and knees tell how the bones of the other skeleton are rolled at rest
    hinges = [] if aligned else find_hinges(pair.joints, pair.ours, pair.axes[:, 2], moving.places, pair.theirs)
    turns, rolls = roll_limbs(hinges, skeleton.parents, {
        part: moving.rotations[:, pair.theirs[role_of[part]]] @ A[part] for hinge in hinges for part in hinge.parts})
    A |= {part: A[part] @ turn for part, turn in turns.items()}
    between, told = pair.trunk()
    M = np.empty((len(moving.places), len(skeleton.parents), 3, 3))     # from the body's own axes to the world
    lacking, matched = [], {}
    for j, name in enumerate(skeleton.names):
        role = role_of.get(j, "")
        if j in between:
            M[:, j] = between[j] @ A[j]
            matched[name] = told[j]
        elif role in pair.theirs:
            M[:, j] = moving.rotations[:, pair.theirs[role]] @ A[j]
            matched[name] = moving.names[pair.theirs[role]]
        elif name in moving.names:
            M[:, j] = moving.rotations[:, moving.names.index(name)] @ A[j]
            matched[name] = name
        else:
            lacking.append(name)
            M[:, j] = M[:, skeleton.parents[j]] if j else np.eye(3)
        if j in rolls and rolls[j].changing.any():
            M[:, j] = M[:, j] @ rotations.exp(rolls[j].changing[:, None] * rolls[j].bone)
    # missing clavicles are raised by a fifth of the upper arms' angle above the horizontal: the girdle's share there
    left, high, _ = pair.axes.T
    for side, outwards in (("l", left), ("r", -left)):
        parts = [pair.ours.get(f"{side}_{name}") for name in ("sternoclavicular", "shoulder", "elbow")]
        if None in parts or f"{side}_sternoclavicular" in pair.theirs:
            continue
        clavicle, arm, elbow = parts
        own = pair.joints[elbow] - pair.joints[arm]
        own = own / np.linalg.norm(own)
        sine = np.einsum("tab,a,tbc,c->t", np.swapaxes(M[:, clavicle], -1, -2), high, M[:, arm], own)
        angle = 0.2 * np.maximum(np.arcsin(np.clip(sine, -1, 1)), 0)
        M[:, clavicle] = M[:, clavicle] @ rotations.exp(angle[:, None] * np.cross(outwards, high))
    V = pair.world(aligned)
    poses = skeleton.pose_of(V @ M @ np.swapaxes(pair.P, -1, -2))
    # travel: the middle between the hips follows that of the motion, scaled; soles stay at their height
    scale = _leg(skeleton.joints, pair.ours, pair.theirs) / _leg(moving.rest, pair.theirs, pair.ours)
    ours, theirs = ([roles["l_hip"], roles["r_hip"]] for roles in (pair.ours, pair.theirs))
    place = scale * moving.places[:, theirs].mean(axis=1) @ V.T
    if here:
        place = place - place[0] + skeleton.joints[ours].mean(axis=0)
    trans = place - joint_places(skeleton, poses)[:, ours].mean(axis=1)
    trans = trans + lift(pair.vertices, poses, trans, pair.up) * pair.up
    return Retargeted(poses, trans, moving.rate, matched, tuple(lacking), scale, rolls)


def lift(vertices: Vertices, poses: np.ndarray, trans: np.ndarray, up: np.ndarray) -> float:
    """Compute how far, metres, a motion must rise for its lowest points to be at the height of the soles at rest."""
    still = (vertices(np.zeros((1, *poses.shape[1:])), np.zeros((1, 3))) @ up).min()
    lowest = np.concatenate([(vertices(poses[k:k + 200], trans[k:k + 200]) @ up).min(axis=1)
                             for k in range(0, len(poses), 200)])       # 200 meshes are held in memory at a time
    return float(still - np.percentile(lowest, 5))                      # a percentile, as some frames may be wrong


def _leg(joints: np.ndarray, roles: Mapping[str, int], others: Mapping[str, int]) -> float:
    """Compute the mean length of the legs, as far as both skeletons have them; without knees that of the trunk."""
    chains = [[roles[f"{side}_{name}"] for name in ("hip", "knee", "ankle") if f"{side}_{name}" in roles.keys()
               & others.keys()] for side in "lr"]
    if min(map(len, chains)) < 2:
        chains = [[roles[f"{side}_hip"], roles[f"{side}_shoulder"]] for side in "lr"]
    return float(np.mean([np.linalg.norm(np.diff(joints[chain], axis=0), axis=1).sum() for chain in chains]))


def body_axes(joints: np.ndarray, roles: Mapping[str, int]) -> np.ndarray:
    """Compute the axes of a body at rest from its hips and shoulders: columns left, up and front (3, 3)."""
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
    """Build axes from front and up: columns left, up and the level front (3, 3)."""
    level = forwards - (forwards @ up) * up
    if np.linalg.norm(level) < 0.1:                                     # a body that lies on its back or face
        level = np.eye(3)[np.abs(up).argmin()]
        level = level - (level @ up) * up
    level = level / np.linalg.norm(level)
    return np.stack([np.cross(up, level), up, level], axis=1)
