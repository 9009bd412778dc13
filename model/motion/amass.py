"""Motions of the SMPL family as AMASS stores them: their joints, and an assumed rest pose, which the files lack.

The rest positions of the joints are in the model files, which have licences of their own. On a model that was imported
from such a file, motions are copied. For all other models the rest pose is assumed to be a T-pose.
"""
from __future__ import annotations

from pathlib import Path

import numpy as np

from scanprep.geometry.storage import save_arrays
from scanprep.skeleton.tree import Skeleton

from ..rig import joint_places, turn_up
from .files import StoredMotion
from .moving import MovingSkeleton

# joints of the body, in the order of the poses, and their parents
NAMES = ("pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle",
         "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder",
         "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist")
PARENTS = np.array([-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19])
BODY = len(NAMES)
FINGERS = 30                         # joints, at the end of whole-body poses
# A T-pose of a person of average build, metres: x to the left, y up, z to the front. The right side mirrors the left.
_T_POSE = {"pelvis": (0, 0.97, 0), "left_hip": (0.09, 0.92, 0), "left_knee": (0.10, 0.50, 0),
           "left_ankle": (0.105, 0.08, -0.03), "left_foot": (0.11, 0.02, 0.10), "spine1": (0, 1.08, -0.02),
           "spine2": (0, 1.21, -0.02), "spine3": (0, 1.27, -0.01), "neck": (0, 1.48, -0.03),
           "head": (0, 1.56, 0.01), "left_collar": (0.07, 1.40, -0.02), "left_shoulder": (0.18, 1.43, -0.02),
           "left_elbow": (0.45, 1.43, -0.02), "left_wrist": (0.71, 1.43, -0.02)}
UNCERTAIN = "a T-pose, stated: AMASS files do not hold theirs; 5 to 10 degrees uncertain"


def t_pose() -> np.ndarray:
    """Compute the assumed rest positions (22, 3), metres, of the joints of the body."""
    left = [name.replace("right_", "left_") for name in NAMES]
    mirror = [[-1 if name.startswith("right_") else 1, 1, 1] for name in NAMES]
    return np.array([_T_POSE[name] for name in left]) * np.array(mirror)


def moving_body(motion: StoredMotion) -> MovingSkeleton:
    """Build the 22 joints of the body in a motion of the family, with the T-pose at rest.

    The axes are turned so that y is up.
    """
    if motion.poses.shape[1] < BODY:
        raise ValueError(f"poses: expected at least the {BODY} joints of the body, found {motion.poses.shape[1]}")
    rest = t_pose()
    tree = Skeleton(np.arange(BODY), PARENTS, rest, NAMES)
    R = tree.part_rotations(motion.poses[:, :BODY])
    high = R[:, 0, :, 1].mean(axis=0)                    # mean direction of the trunk; z is up, in some files y
    up = 1 if high[1] > abs(high[2]) + 0.3 else 2
    U = turn_up(up)
    offsets = rest - np.where(PARENTS[:, None] < 0, 0, rest[PARENTS])
    places = joint_places(tree, motion.poses[:, :BODY], motion.trans - rest[0]) @ U.T
    return MovingSkeleton(NAMES, PARENTS, offsets, U @ R, places, motion.rate)


def with_joints(poses: np.ndarray, count: int) -> np.ndarray:
    """Convert poses (T, J, 3) to the joints of another model of the family.

    The body is copied, and the fingers if both have them; the other joints rest.
    """
    T, J = poses.shape[:2]
    if J == count:
        return poses
    out = np.zeros((T, count, 3))
    out[:, :BODY] = poses[:, :BODY]
    if min(J, count) >= BODY + FINGERS:
        out[:, -FINGERS:] = poses[:, -FINGERS:]
    return out


def write_amass(path: str | Path, poses: np.ndarray, trans: np.ndarray, betas: np.ndarray | None, rate: float,
                gender: str, family: str) -> None:
    """Write a motion of a model of the family, poses (T, J, 3) of 24, 52 or 55 joints, under the names of AMASS."""
    T, J = poses.shape[:2]
    if J not in (24, 52, 55):
        raise ValueError(f"poses: expected 24, 52 or 55 joints of a model of the SMPL family, got {J}")
    flat = poses.reshape(T, -1)
    arrays = {"poses": flat, "root_orient": flat[:, :3], "pose_body": flat[:, 3:3 * BODY], "trans": trans,
              "betas": np.zeros(0) if betas is None else betas, "gender": np.array(gender),
              "mocap_frame_rate": np.array(float(rate)), "surface_model_type": np.array(family)}
    if J > 24:
        arrays["pose_hand"] = flat[:, -3 * FINGERS:]
    if J == 55:
        arrays |= {"pose_jaw": flat[:, 66:69], "pose_eye": flat[:, 69:75]}
    save_arrays(path, arrays)
