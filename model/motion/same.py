"""Copy a motion of a skeleton with the same parts, whatever the axes of its file and the root of its tree."""
from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from scanprep.geometry.mesh import Mesh
from scanprep.pictures.camera import guess_upright
from scanprep.skeleton.tree import Skeleton

from ..rig import joint_places, turn_up
from .moving import MovingSkeleton
from .retarget import Retargeted, Vertices, lift

# degrees between bones in one rest pose: of twelve synthetic people up to 16, those of A-poses and T-poses 40 and more
FARTHEST = 25


def same_skeleton(skeleton: Skeleton, other: Skeleton) -> bool:
    """Tell whether two skeletons have the same parts in the same order and rest pose, of different people or of one."""
    if skeleton.names != other.names or not np.array_equal(skeleton.parents, other.parents):
        return False
    bones = np.stack([one.joints[1:] - one.joints[one.parents[1:]] for one in (skeleton, other)])
    sizes = np.linalg.norm(bones, axis=2).prod(axis=0)
    cosine = (bones[0] * bones[1]).sum(axis=1)
    return bool((cosine >= np.cos(np.radians(FARTHEST)) * sizes).all())


def copy_motion(skeleton: Skeleton, rest: Mesh, vertices: Vertices, moving: MovingSkeleton) -> Retargeted | None:
    """Copy a motion of the same parts with the same rest pose in other axes; None for another skeleton.

    The tree may have another root, and the bones may be those of another person.
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
    # the rotation of axes, of the 24 that swap them, that brings our bones nearest to theirs; the usual one comes first
    turns = np.concatenate([turn_up(guess_upright(rest)[0])[None], Rotation.create_group("O").as_matrix().round()])
    sizes = np.linalg.norm(ours, axis=1) * np.linalg.norm(theirs, axis=1)
    kept = sizes > 1e-9
    if not kept.any():
        return None
    cosine = np.einsum("na,kab,nb->kn", theirs[kept], turns, ours[kept]) / sizes[kept]
    angles = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    off = angles.mean(axis=1)
    best = int(np.flatnonzero(off < off.min() + 1e-3)[0])
    if off[best] >= 10 or angles[best].max() >= FARTHEST:             # degrees: the rest poses differ
        return None
    Q = turns[best]
    scale = np.linalg.norm(ours, axis=1).sum() / np.linalg.norm(theirs, axis=1).sum()
    poses = skeleton.pose_of(Q.T @ moving.rotations[:, order] @ Q)
    trans = scale * moving.places[:, order[shared[0]]] @ Q - joint_places(skeleton, poses)[:, shared[0]]
    if np.abs(scale * theirs @ Q - ours).max() > 1e-3:          # metres: bones of another person; correct the soles
        trans = trans + lift(vertices, poses, trans, Q.T @ [0, 1, 0]) * (Q.T @ [0, 1, 0])
    return Retargeted(poses, trans, moving.rate, dict(zip(names, names, strict=True)))
