"""Motions of other skeletons, and how far two motions are apart."""
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise

import numpy as np
from people_bodies import small_people

from model.export.bvh import write_bvh
from model.motion import amass
from model.rig import joint_places, make_rig
from scanprep.geometry import rotations
from scanprep.skeleton.tree import Skeleton
from scanprep.synthetic.people import random_pose

FRAMES = 8
Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])      # from the axes of the people to those of files
OTHERS = {"pelvis": "Hips", "abdomen": "LowerBack", "chest": "Spine1", "head": "Head",
          **{f"{ours}_{side.lower()}": side + theirs for side in ("Left", "Right") for ours, theirs in
             (("upper_arm", "Arm"), ("forearm", "ForeArm"), ("hand", "Hand"), ("thigh", "UpLeg"), ("shin", "Leg"),
              ("foot", "Foot"))}}


@lru_cache(maxsize=1)
def random_poses():
    rng = np.random.default_rng(5)
    return np.array([random_pose(rng) for _ in range(FRAMES)])


def degrees(a, b):
    """The largest angle between poses."""
    return np.degrees(np.linalg.norm(rotations.compose(-a.reshape(-1, 3), b.reshape(-1, 3)), axis=1)).max()


def apart(a, b):
    """Mean distance of surfaces (T, N, 3) whose middles are laid on each other in each frame, millimetres."""
    a, b = a - a.mean(axis=1, keepdims=True), b - b.mean(axis=1, keepdims=True)
    return 1000 * np.linalg.norm(a - b, axis=2).mean()


def elsewhere(tmp_path, poses, trans, scale=39.37):
    """The motion of the mean person as somebody else has it: arms level at rest, other names, one more joint in the
    trunk, fingers, turned about the vertical, in another unit; the path of the BVH.
    """
    rig = make_rig(small_people(), np.zeros(1))
    names, parents, J = list(rig.skeleton.names), rig.skeleton.parents, rig.skeleton.joints
    A = np.tile(np.eye(3), (16, 1, 1))
    for side in ("left", "right"):
        arm = [names.index(f"{part}_{side}") for part in ("upper_arm", "forearm", "hand")]
        bone = J[arm[1]] - J[arm[0]]
        A[arm] = rotations.exp(np.arctan2(-bone[2], np.hypot(bone[0], bone[1])) * np.array([bone[1], -bone[0], 0])
                               / np.hypot(bone[0], bone[1]))
    R = rig.skeleton.part_rotations(poses) @ np.swapaxes(A, -1, -2)
    rest = joint_places(rig.skeleton, rig.skeleton.pose_of(A))
    Q = rotations.exp(np.array([0, 1.1, 0])) @ Y_UP
    chest, hand = names.index("chest"), names.index("hand_left")
    middle = (rest[names.index("abdomen")] + rest[chest]) / 2
    # the abdomen in two joints that turn alike, and a finger that turns on its own
    order = [*range(chest), 16, *range(chest, 16), 17]
    above = np.array([*parents, names.index("abdomen"), hand])
    above[chest] = 16
    rest = np.vstack([rest, middle, rest[hand] + [0.08, 0, 0]])
    R = np.concatenate([R, R[:, [names.index("abdomen")]], R[:, [hand]] @ rotations.exp(np.array([0.4, 0, 0]))], axis=1)
    number, called = np.argsort(order), [*(OTHERS[name] for name in names), "Spine", "LeftHandIndex1"]
    tree = Skeleton(np.arange(18), np.array([-1 if above[j] < 0 else number[above[j]] for j in order]),
                    (rest @ Q.T)[order], tuple(called[j] for j in order))
    moved = (Q @ R @ Q.T)[:, order]
    write_bvh(tmp_path / "theirs.bvh", replace(tree, joints=scale * tree.joints), tree.pose_of(moved),
              scale * (trans @ Q.T), 24.0, "m", 1)
    return tmp_path / "theirs.bvh"


def of_amass(poses, up=2):
    """The 22 joints of a motion of the mean person in a T-pose of its own, as AMASS has them: poses (T, 22, 3)."""
    ours = make_rig(small_people(), np.zeros(1)).skeleton
    names, rest = ours.names, amass.t_pose()
    part = dict.fromkeys(("spine1", "spine2"), "abdomen") | {"pelvis": "pelvis", "head": "head"}
    A = {}
    for side in ("left", "right"):
        for theirs, mine in (("hip", "thigh"), ("knee", "shin"), ("ankle", "foot"), ("foot", "foot"),
                             ("shoulder", "upper_arm"), ("elbow", "forearm"), ("wrist", "hand")):
            part[f"{side}_{theirs}"] = f"{mine}_{side}"
        for chain in (("shoulder", "elbow", "wrist"), ("hip", "knee", "ankle")):
            R = Y_UP
            for a, b in pairwise(chain):
                i, k = (names.index(part[f"{side}_{end}"]) for end in (a, b))
                there = rest[amass.NAMES.index(f"{side}_{b}")] - rest[amass.NAMES.index(f"{side}_{a}")]
                bone = R @ (ours.joints[k] - ours.joints[i])
                axis = np.cross(bone, there)
                angle = np.arctan2(np.linalg.norm(axis), bone @ there)
                R = rotations.exp(angle * axis / np.linalg.norm(axis)) @ R
                A[f"{side}_{a}"] = R
            if chain[2] == "wrist":
                A[f"{side}_wrist"] = R
    world = ours.part_rotations(poses)
    R = np.stack([world[:, names.index(part.get(name, "chest"))] @ A.get(name, Y_UP).T for name in amass.NAMES], axis=1)
    if up == 1:
        R = Y_UP @ R
    return Skeleton(np.arange(22), amass.PARENTS, rest, amass.NAMES).pose_of(R)


SOURCES = {
    "cmu": {part: name for part, name in OTHERS.items()},
    "mixamo": {part: f"mixamorig:{name.replace('LowerBack', 'Spine')}" for part, name in OTHERS.items()},
    "makehuman": {"pelvis": "root", "abdomen": "spine05", "chest": "spine01", "head": "head",
                  **{f"{ours}_{side}": f"{theirs}.{side[0].upper()}" for side in ("left", "right") for ours, theirs in
                     (("upper_arm", "upperarm01"), ("forearm", "lowerarm01"), ("hand", "wrist"),
                      ("thigh", "upperleg01"), ("shin", "lowerleg01"), ("foot", "foot"))}}}


def limb_bones(skeleton):
    """{part: (3,) direction of its bone at rest}; hands and feet go on as the part before."""
    J, out = skeleton.joints, {}
    for j, name in enumerate(skeleton.names):
        if name.endswith(("_left", "_right")):
            child = next((k for k, p in enumerate(skeleton.parents) if p == j), None)
            bone = J[j] - J[skeleton.parents[j]] if child is None else J[child] - J[j]
            out[name] = bone / np.linalg.norm(bone)
    return out


def export_rolled(path, poses, trans, kind="cmu", down=None, rolls=None):
    """A motion of the mean person as another program writes it: other names, straight arms so many degrees `down` from
    level at rest (ours if None), bones rolled at rest by `rolls` {part: degrees on the left, mirrored on the right}.
    The motion in the world is the same for all of them.
    """
    ours = make_rig(small_people(), np.zeros(1)).skeleton
    bones, A = limb_bones(ours), np.tile(np.eye(3), (16, 1, 1))
    for side, sign in (("left", 1), ("right", -1)):
        R = np.eye(3)
        for part in ("upper_arm", "forearm", "hand") if down is not None else ():
            j = ours.names.index(f"{part}_{side}")
            bone, angle = R @ bones[ours.names[j]], np.radians(down)
            axis = np.cross(bone, [sign * np.cos(angle), 0, -np.sin(angle)])
            sine = np.linalg.norm(axis)
            R = rotations.exp(np.arcsin(min(sine, 1)) * axis / max(sine, 1e-12)) @ R if part != "hand" else R
            A[j] = R
        for part, roll in (rolls or {}).items():
            j = ours.names.index(f"{part}_{side}")
            A[j] = A[j] @ rotations.exp(sign * np.radians(roll) * bones[ours.names[j]])
    R = Y_UP @ ours.part_rotations(poses) @ np.swapaxes(A, -1, -2) @ Y_UP.T
    rest = joint_places(ours, ours.pose_of(A))
    tree = Skeleton(np.arange(16), ours.parents, rest @ Y_UP.T, tuple(SOURCES[kind][name] for name in ours.names))
    write_bvh(path, tree, tree.pose_of(R), trans @ Y_UP.T, 24.0, "cm", 1)
    return path
