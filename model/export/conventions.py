"""Conventions of animation programs: root, names, bones along the limbs, soles on the ground, face to the viewer."""
from __future__ import annotations

from dataclasses import replace

import numpy as np

from scanprep.geometry.farthest_points import spread_indices
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.sides import side_of
from scanprep.pictures.camera import guess_upright, stance

from ..rig import Rig, change_root, transform_rig, turn_up
from .bvh import part_ends
from .names import Names, rename_bones


def for_programs(rig: Rig, poses: np.ndarray, trans: np.ndarray, up: int, root: str | None = None,
                 names: Names | None = None, ground: bool = False, front: bool = False
                 ) -> tuple[Rig, np.ndarray, np.ndarray]:
    """Convert a body and its motion to the conventions of animation programs, for GLB and BVH files.

    The surface moves as before, except that `ground` and `front` move the whole. Bones get axes along the limbs
    (`aim_bones`).

    Parameters
    ----------
    rig : Rig
        The body.
    poses : (T, J, 3) float, radians
        T is 0 without a motion.
    trans : (T, 3) float, metres
        Travel of the root's joint.
    up : int
        0, 1 or 2: the axis of the body that points up.
    root : str, optional
        The part that the skeleton hangs on.
    names : "mixamo", "unity", "unreal", "vrm", "h-anim" or "opensim", optional
        Whose names the bones have.
    ground : bool
        The lowest point at rest, and the lowest of the motion, at height 0.
    front : bool
        The body at rest, and the motion by its mean heading, turned to the viewer: to +z where y is up, to -y where
        z is up.
    """
    rig, poses, trans = place_on_ground(rig, poses, trans, up, ground, front)
    if root is not None:
        rig, poses, trans = change_root(rig, poses, trans, root)
    rig = aim_bones(rig, up)
    return (rig if names is None else rename_bones(rig, names)), poses, trans


def aim_bones(rig: Rig, up: int) -> Rig:
    """Turn the bones' axes so that y points along the limb, to the next joint.

    Where bones branch, the next joint is that of the largest branch near the middle of the body. So a pelvis points up
    the spine and a chest to the head. At the end of a limb y points to the end of the surface. Roll: z is as near to
    the front as y allows, or to up where the bone itself points within 60 degrees of the front or back. So x is the
    hinge of elbows, knees and ankles, and left and right mirror each other.
    """
    vertical, ahead = stance(replace(rig.mesh, up=up), vertical=np.eye(3)[up])
    ends, joints = part_ends(rig.skeleton, rig.mesh), rig.skeleton.joints
    axes = np.empty_like(rig.axes)
    for j in range(len(axes)):
        child = _next(rig, j, np.cross(vertical, ahead))
        y = (ends[j] if child is None else joints[child]) - joints[j]
        length = np.linalg.norm(y)
        y = y / length if length > 1e-9 else vertical
        # 0.5 is the cosine of 60 degrees: a foot points forwards, so its z is up
        z = ahead if abs(y @ ahead) < 0.5 else vertical
        z = z - (z @ y) * y
        z /= np.linalg.norm(z)
        axes[j] = np.column_stack([np.cross(y, z), y, z])
    return replace(rig, axes=axes)


def place_on_ground(rig: Rig, poses: np.ndarray, trans: np.ndarray, up: int, ground: bool, front: bool
                    ) -> tuple[Rig, np.ndarray, np.ndarray]:
    """Put the rig and its motion (T may be 0) on the ground and turn the face to the viewer, as in `for_programs`."""
    Q = W = np.eye(3)
    if front:
        body = replace(rig.mesh, up=up)
        Q = to_viewer(*stance(body, vertical=np.eye(3)[up]), up)
        if len(poses):
            turned = rig.skeleton.part_rotations(poses)[:, 0]
            W = to_viewer(*stance(body, turned, np.eye(3)[up]), up)
    rig, poses, trans = transform_rig(rig, poses, trans, (Q, np.zeros(3)), (W, np.zeros(3)))
    if not ground:
        return rig, poses, trans
    vertical = np.eye(3)[up]
    shift = step = -rig.mesh.vertices[:, up].min() * vertical
    if len(poses):
        # the lowest point of the motion, in at most 200 frames spread evenly
        chosen = spread_indices(len(poses), 200)
        # twenty bodies are held in memory at a time
        step = -min(float(rig.vertices(poses[some], trans[some])[..., up].min())
                    for some in np.array_split(chosen, -(-len(chosen) // 20))) * vertical
    return transform_rig(rig, poses, trans, (np.eye(3), shift), (np.eye(3), step))


def stand_mesh(body: Mesh, rest: Mesh, ground: bool, front: bool, turned: np.ndarray | None = None) -> Mesh:
    """Move a mesh's lowest point to height 0 and turn its face to the viewer: -y where z is up, else +z.

    The same body at rest shows which way is up and front. Its root is rotated by `turned` (3, 3) in the mesh.
    """
    up = guess_upright(rest)[0]
    points = body.vertices
    if front:
        points = points @ to_viewer(*stance(rest, turned, np.eye(3)[up]), up).T
    return body.with_vertices(points - ground * points[:, up].min() * np.eye(3)[up], up)


def to_viewer(vertical: np.ndarray, ahead: np.ndarray, up: int) -> np.ndarray:
    """Compute the rotation (3, 3) that takes unit vectors `vertical` to the axis `up`, and `ahead` to the viewer."""
    U = turn_up(up)
    return np.stack([U[1], U[2], U[0]]).T @ np.stack([vertical, ahead, np.cross(vertical, ahead)])


def _next(rig: Rig, j: int, across: np.ndarray) -> int | None:
    """Find the joint that a bone points to, None at the end of a limb; `across` (3,) is the unit vector to the left."""
    parents, joints = rig.skeleton.parents, rig.skeleton.joints
    children = np.flatnonzero(parents == j)
    if len(children) < 2:
        return int(children[0]) if len(children) else None
    # several children: prefer those without a side in their name, then near the middle, then large ones
    size = rig.skeleton.descends[children] @ np.bincount(rig.skeleton.part_of_face, minlength=len(parents))
    aside = np.abs((joints[children] - joints[j]) @ across)
    sided = np.array([side_of(rig.skeleton.names[c]) != 0 for c in children])
    return int(children[np.lexsort((-size, aside > 0.5 * aside.max(), sided))[0]])
