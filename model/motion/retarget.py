"""A motion of one skeleton on another whose rest pose, bones and parts differ: segments point where they pointed.

Every part of ours that has a counterpart takes its rotation, after that which brings our bone to theirs at rest: the
directions of the limbs are then those of the motion exactly, and so is the twist about them. A trunk of any number of
joints is brought to as many as we have.
"""
from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.pictures.camera import upright
from scanprep.skeleton.tree import Skeleton

from ..export.rig import check_motion, joint_places, turn_up
from .moving import MovingSkeleton
from .roles import NEEDED, numbered_roles, trunk, way

Vertices = Callable[[np.ndarray, np.ndarray], np.ndarray]   # poses (T, J, 3), trans (T, 3) -> (T, N, 3), metres
ALIKE = 10.0                         # degrees between the bones of two skeletons that rest alike
SAME = 1e-3                          # metres that the bones of one person may differ
AT_ONCE = 200                        # frames whose meshes are held at a time


@dataclass(frozen=True, eq=False)
class Retargeted:
    """A motion that was brought onto a body, by the conventions of the body models."""

    poses: np.ndarray                # (T, J, 3) radians, against the body at rest
    trans: np.ndarray                # (T, 3) metres, travel of the root's joint
    rate: float                      # frames a second
    matched: dict[str, str]          # {part of the body: joint that it follows}
    lacking: tuple[str, ...] = ()    # parts that go with the one above them: the motion has no such joint
    scale: float = 1.0               # of the travel: how much longer our legs are


class Pairing:
    """A body and a skeleton that moves, both at rest.

    Parameters
    ----------
    skeleton : Skeleton
        With the joints of the body.
    vertices : Vertices
        The body's surface in some poses.
    moving : MovingSkeleton
    pose : (J, 3) float, radians, optional
        Of a statue: how the generic model's parts were rotated to the pose of the scan, which is its rest.

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
        self.ours = numbered_roles(skeleton.names, skeleton.joints)
        self.theirs = numbered_roles(moving.names, moving.rest)
        for what, found, names in (("body", self.ours, skeleton.names), ("motion", self.theirs, moving.names)):
            missing = [role for role in NEEDED if role not in found]
            if missing:
                raise ValueError(f"{what}: expected joints named like {', '.join(missing)}, found only "
                                 f"{', '.join(names)}"[:400])
        self.axes = _axes(self.joints, self.ours)
        feet = [skeleton.joints[self.ours[r]] for r in ("l_ankle", "r_ankle", "l_hip", "r_hip") if r in self.ours]
        high = skeleton.joints[self.ours.get("skullbase", self.ours["l_shoulder"])] - np.mean(feet[:2], axis=0)
        self.up = _nearest_axis(high)

    def alignment(self, aligned: bool) -> dict[int, np.ndarray]:
        """For each part the rotation from the axes of the generic model to those of the motion at rest.

        The smallest rotation that brings our bone to theirs, after that of the part above. Feet stand flat, but where
        the legs are far apart at rest (as in the CMU files) they are taken to be square to the shanks from the front.
        """
        whole = self.whole(aligned)
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
        """Our parts from the pelvis to the one that carries the arms, and from there to the head, all with ends."""
        parents, ours = self.skeleton.parents, self.ours
        arms = [way(parents, ours["humanoid_root"], ours[f"{side}_shoulder"]) for side in "lr"]
        carrier = [part for part in arms[0] if part in arms[1]][-1]
        head = ours.get("skullbase", carrier)
        return way(parents, ours["humanoid_root"], carrier), way(parents, carrier, head)

    def trunk(self) -> tuple[dict[int, np.ndarray], dict[int, str]]:
        """The rotation (T, 3, 3) of each of our parts between pelvis and head, without both, and what it follows."""
        moving, R = self.moving, self.moving.rotations
        below, beyond = self.middle()
        parts, low, top = below[1:], *trunk(moving.parents, self.theirs)
        joints = way(moving.parents, low, top)
        head = self.theirs.get("skullbase", top)
        necks = way(moving.parents, top, head)
        pelvis = self.theirs["humanoid_root"]
        if len(joints) < len(parts):
            steps = [pelvis, *joints] if joints[0] != pelvis else joints
            out, told = _spread(moving, steps, parts)
        else:
            out, told = self._groups(joints, parts, [role for role in ("l_shoulder", "r_shoulder", "skullbase")
                                                     if role in self.theirs])
        more = _spread(moving, necks, beyond[1:])
        for part in beyond[1:-1]:
            out[part], told[part] = more[0][part], more[1][part]
        return {part: np.broadcast_to(M, R[:, 0].shape) for part, M in out.items()}, told

    def _groups(self, joints: list[int], parts: list[int], carried: list[str]
                ) -> tuple[dict[int, np.ndarray], dict[int, str]]:
        """The joints of their trunk in as many groups as we have parts, and the rotation of each.

        A group brings the next one where its joints bring it; the last one neck and shoulders, as nearly as one
        rotation can.
        """
        if not parts:
            return {}, {}
        moving = self.moving
        rest, R, y = moving.rest, moving.rotations, moving.places
        starts = self._starts(joints, parts)
        out, told = {}, {}
        for part, first, after in zip(parts, starts, [*starts[1:], len(joints)], strict=True):
            low, top = joints[first], joints[after - 1]
            told[part] = moving.names[low] if low == top else f"{moving.names[low]} to {moving.names[top]}"
            if low == top:
                out[part] = R[:, low]
            elif after < len(joints):
                mean = rotations.project(R[:, joints[first:after]].mean(axis=1))
                out[part] = _swung(mean, rest[joints[after]] - rest[low], y[:, joints[after]] - y[:, low])
            else:
                points = rest[[self.theirs[role] for role in carried]]
                there = np.einsum("tab,kb->tka", R[:, top], points - rest[top]) + (y[:, top] - y[:, low])[:, None]
                out[part] = rotations.project(np.einsum("tka,kb->tab", there, points - rest[low]))
        return out, told

    def _starts(self, joints: list[int], parts: list[int]) -> tuple[int, ...]:
        """Which of their joints begins each of our parts: where along the trunk it is nearest."""
        parents, below = self.skeleton.parents, self.middle()[0]
        links = [b if parents[b] == a else a for a, b in pairwise(below)]
        ours = _heights(self.joints, self.joints[links], self.ours)
        theirs = _heights(self.moving.rest, self.moving.rest[joints], self.theirs)
        choices = combinations(range(1, len(joints)), len(parts) - 1)
        return min(((0, *some) for some in choices), key=lambda some: float(np.abs(ours - theirs[list(some)]).sum()))

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


def retargeted(pair: Pairing, aligned: bool = False, girdle: float = 0.2) -> Retargeted:
    """The motion of the pair's skeleton on its body; `aligned`: the body rests as that skeleton does.

    Where the motion has no clavicles, ours are raised by a share `girdle` of the upper arms' angle above the level.
    """
    moving, skeleton = pair.moving, pair.skeleton
    A = pair.alignment(aligned)
    role_of = {part: role for role, part in pair.ours.items()}
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
    _raise_clavicles(pair, M, girdle)
    V = pair.world(aligned)
    R = V @ M @ np.swapaxes(pair.P, -1, -2)
    poses = skeleton.pose_of(R)
    scale = _leg(skeleton.joints, pair.ours, pair.theirs) / _leg(moving.rest, pair.theirs, pair.ours)
    return Retargeted(poses, _travel(pair, V, poses, scale), moving.rate, matched, tuple(lacking), scale)


def copied(skeleton: Skeleton, rest: Mesh, vertices: Vertices, moving: MovingSkeleton) -> Retargeted | None:
    """The motion of the same parts, which rest alike in axes of another name; None where it is another skeleton.

    The tree may hang on another part; bones may be those of another person.
    """
    names = skeleton.names
    if set(moving.names) != set(names):
        return None
    order = [moving.names.index(name) for name in names]
    above = [names[p] if p >= 0 else "" for p in skeleton.parents]
    theirs_above = [moving.names[p] if p >= 0 else "" for p in moving.parents[order]]
    shared = [j for j in range(len(names)) if above[j] == theirs_above[j]]       # joints that link the same parts
    bones = [j for j in shared if above[j] and skeleton.parents[j] in shared]
    if not bones or len(bones) < (len(names) - 1) / 2:
        return None
    ours, theirs = skeleton.joints[bones] - skeleton.joints[skeleton.parents[bones]], moving.offsets[order][bones]
    Q = _turn(ours, theirs, turn_up(upright(rest)[0]))
    if Q is None:
        return None
    scale = np.linalg.norm(ours, axis=1).sum() / np.linalg.norm(theirs, axis=1).sum()
    poses = skeleton.pose_of(Q.T @ moving.rotations[:, order] @ Q)
    trans = scale * moving.places[:, order[shared[0]]] @ Q - joint_places(skeleton, poses)[:, shared[0]]
    if np.abs(scale * theirs @ Q - ours).max() > SAME:                  # another person: soles where theirs would be
        trans = trans + lift(vertices, poses, trans, Q.T @ [0, 1, 0]) * (Q.T @ [0, 1, 0])
    return Retargeted(poses, trans, moving.rate, dict(zip(names, names, strict=True)), (), float(scale))


def _turn(ours: np.ndarray, theirs: np.ndarray, usual: np.ndarray) -> np.ndarray | None:
    """The rotation that swaps axes and brings bones (n, 3) nearest to others, the usual one where it is as near; None
    where they do not rest alike.
    """
    turns = np.concatenate([usual[None], Rotation.create_group("O").as_matrix().round()])
    sizes = np.linalg.norm(ours, axis=1) * np.linalg.norm(theirs, axis=1)
    kept = sizes > 1e-9
    if not kept.any():
        return None
    cosine = np.einsum("na,kab,nb->kn", theirs[kept], turns, ours[kept]) / sizes[kept]
    off = np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean(axis=1)
    best = int(np.flatnonzero(off < off.min() + 1e-3)[0])
    return turns[best] if off[best] < ALIKE else None


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


def _travel(pair: Pairing, V: np.ndarray, poses: np.ndarray, scale: float) -> np.ndarray:
    """(T, 3) travel of the root's joint, with the middle between the hips where that of the motion is, scaled."""
    skeleton, joints = pair.skeleton, pair.skeleton.joints
    ours = [pair.ours["l_hip"], pair.ours["r_hip"]]
    theirs = [pair.theirs["l_hip"], pair.theirs["r_hip"]]
    place = scale * pair.moving.places[:, theirs].mean(axis=1) @ V.T
    place = place - place[0] + joints[ours].mean(axis=0)
    trans = place - joint_places(skeleton, poses)[:, ours].mean(axis=1)
    return trans + lift(pair.vertices, poses, trans, pair.up) * pair.up


def lift(vertices: Vertices, poses: np.ndarray, trans: np.ndarray, up: np.ndarray) -> float:
    """How far a motion must rise for its lowest points to be where those of the body at rest are, metres."""
    still = (vertices(np.zeros((1, *poses.shape[1:])), np.zeros((1, 3))) @ up).min()
    lowest = np.concatenate([(vertices(poses[k:k + AT_ONCE], trans[k:k + AT_ONCE]) @ up).min(axis=1)
                             for k in range(0, len(poses), AT_ONCE)])
    return float(still - np.percentile(lowest, 5))                      # percentile: some frames may err


def _spread(moving: MovingSkeleton, steps: Sequence[int], parts: Sequence[int]
            ) -> tuple[dict[int, np.ndarray], dict[int, str]]:
    """Rotations (T, 3, 3) for parts that follow some joints, spread evenly over them; the last follows the last."""
    out, told = {}, {}
    for i, part in enumerate(parts, start=1):
        at = i * (len(steps) - 1) / len(parts)
        before, share = int(at), at - int(at)
        first, second = steps[before], steps[min(before + 1, len(steps) - 1)]
        turn = np.swapaxes(moving.rotations[:, first], -1, -2) @ moving.rotations[:, second]
        out[part] = moving.rotations[:, first] @ rotations.exp(share * rotations.log(turn)) if share else (
            moving.rotations[:, first])
        told[part] = moving.names[first] + (f" to {moving.names[second]}" if share else "")
    return out, told


def _swung(R: np.ndarray, before: np.ndarray, now: np.ndarray) -> np.ndarray:
    """Rotations (T, 3, 3) after the smallest ones that bring `R @ before` (3,) to the directions `now` (T, 3)."""
    was = R @ before
    if np.linalg.norm(before) < 1e-6:
        return R
    axis = np.cross(was, now)
    sine = np.linalg.norm(axis, axis=1, keepdims=True)
    angle = np.arctan2(sine, np.einsum("ta,ta->t", was, now)[:, None])
    return np.asarray(rotations.exp(angle * axis / np.maximum(sine, 1e-12)) @ R)


def _heights(joints: np.ndarray, points: np.ndarray, roles: Mapping[str, int]) -> np.ndarray:
    """(n,) how far along the trunk points (n, 3) are, 0 at the hips and 1 at the shoulders."""
    hips, shoulders = (joints[[roles[f"l_{name}"], roles[f"r_{name}"]]].mean(axis=0) for name in ("hip", "shoulder"))
    along = shoulders - hips
    return np.asarray((points - hips) @ along / (along @ along))


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
