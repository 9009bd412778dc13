"""Write BVH: a skeleton with its motion for animation programs; `motion.bvh` reads BVH."""
from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from scanprep.geometry.format_common import metres_of
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.storage import writing
from scanprep.geometry.tables import number_lines
from scanprep.skeleton.tree import Skeleton

from ..rig import check_motion, turn_up

_ORDER = "ZXY"                       # R = R_z R_x R_y, about axes that turn with the part
_TURNS = " ".join(f"{axis}rotation" for axis in _ORDER)


def write_bvh(path: str | Path, skeleton: Skeleton, poses: np.ndarray | None = None, trans: np.ndarray | None = None,
              rate: float = 30.0, unit: str = "cm", up: int = 2, body: Mesh | None = None) -> None:
    """Write a skeleton and its motion as BVH.

    Offsets are those between the joints at rest, where all parts have the axes of the world. The root has six channels
    for place and rotation, the others three for rotation. Rotations are Euler angles in degrees in the order Z, X, Y:
    `R = R_z R_x R_y`. The root's offset is zero and its channels hold its position. So readers that add the two and
    readers that do not agree. Everything is turned so that y is up, as BVH readers expect.

    Parameters
    ----------
    path : str or Path
        File to write.
    skeleton : Skeleton
        With the joints of the body that moves (`Rig.skeleton`, or the template's).
    poses : (T, J, 3) float, radians, optional
        Poses of all frames; without any, one frame at rest is written.
    trans : (T, 3) float, metres, optional
        Travel of the root's joint.
    rate : float, frames a second
        Frame rate.
    unit : "m", "cm", "mm" or "in"
        Unit of the lengths, which the file does not say; readers expect centimetres.
    up : int
        0, 1 or 2: the axis of the body that points up.
    body : Mesh, optional
        The rest mesh, to end the leaf parts where it ends; without it a leaf is as long as the bone before it.

    Raises
    ------
    ValueError
        A motion of other parts or not finite; a rate that is not positive; an unknown unit; an axis that
        does not exist; names with white space.
    """
    scale = 1 / metres_of(unit)
    spaced = [name for name in skeleton.names if name.split() != [name]]
    if spaced:
        raise ValueError(f"names: expected names without white space in BVH, got {spaced[0]!r}")
    if poses is None or not len(poses):
        poses, trans = np.zeros((1, len(skeleton.parents), 3)), None
    poses, trans = check_motion(skeleton, poses, trans, rate)
    U = turn_up(up).T
    lines = ["HIERARCHY", *_hierarchy(skeleton, scale * skeleton.joints @ U, scale * part_ends(skeleton, body) @ U),
             "MOTION", f"Frames: {len(poses)}", f"Frame Time: {1 / rate:.9f}"]
    # a row for each frame: position of the root, then angles of all joints in the order of the file
    places = scale * (skeleton.joints[0] + trans) @ U
    angles = euler_degrees(poses @ U)[:, _file_order(skeleton)]
    frames = np.concatenate([places, angles.reshape(len(poses), -1)], axis=1)
    lines += _numbers(frames)
    with writing(path) as beside:
        beside.write_text("\n".join(lines) + "\n", encoding="utf-8")


def euler_degrees(poses: np.ndarray) -> np.ndarray:
    """Convert poses (T, J, 3) to Euler angles (T, J, 3), degrees about z, x, y, without jumps of a full turn."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)      # at gimbal lock any of the equivalent answers is right
        angles = Rotation.from_rotvec(poses.reshape(-1, 3)).as_euler(_ORDER, degrees=True)
    return np.unwrap(angles.reshape(poses.shape), axis=0, period=360)


def part_ends(skeleton: Skeleton, body: Mesh | None = None) -> np.ndarray:
    """Find the far end of every part (J, 3), metres: the tip of its surface at rest along the part.

    Without a body, the end continues the bone before the part by its own length.
    """
    joints, parents = skeleton.joints, skeleton.parents
    ends = 2 * joints - joints[np.maximum(parents, 0)]
    for j in range(len(parents) if body is not None else 0):
        assert body is not None
        skin = body.vertices[np.unique(body.faces[skeleton.part_of_face == j])] - joints[j]
        along = skin.mean(axis=0)
        length = float(np.linalg.norm(along))
        if length > 0:
            ends[j] = joints[j] + along / length * max(float((skin @ along).max()) / length, length)
    return ends


def _file_order(skeleton: Skeleton) -> list[int]:
    """List the joints in the order of the file: every joint is followed by all that hangs below it."""
    order: list[int] = []
    waiting = [0]
    while waiting:
        j = waiting.pop()
        order.append(j)
        waiting += np.flatnonzero(skeleton.parents == j)[::-1].tolist()
    return order


def _hierarchy(skeleton: Skeleton, joints: np.ndarray, ends: np.ndarray) -> list[str]:
    lines: list[str] = []
    # braces that are still open are closed until the parent of the next joint is the innermost one
    level = np.zeros(len(joints), dtype=int)
    open_joints: list[int] = []
    for j in _file_order(skeleton):
        parent = int(skeleton.parents[j])
        while open_joints and open_joints[-1] != parent:
            lines.append("  " * level[open_joints.pop()] + "}")
        level[j] = level[parent] + 1 if j else 0
        pad = "  " * level[j]
        offset = joints[j] - joints[parent] if j else np.zeros(3)
        channels = f"3 {_TURNS}" if j else f"6 Xposition Yposition Zposition {_TURNS}"
        lines += [f"{pad}{'JOINT' if j else 'ROOT'} {skeleton.names[j]}", pad + "{", f"{pad}  {_offset(offset)}",
                  f"{pad}  CHANNELS {channels}"]
        open_joints.append(j)
        if not (skeleton.parents == j).any():
            lines += [f"{pad}  End Site", pad + "  {", f"{pad}    {_offset(ends[j] - joints[j])}", pad + "  }"]
    return lines + ["  " * level[j] + "}" for j in reversed(open_joints)]


def _offset(offset: np.ndarray) -> str:
    return "OFFSET " + _numbers(offset[None])[0]


def _numbers(rows: np.ndarray) -> list[str]:
    """Format numbers (T, K) as lines, without negative zeros."""
    digits = 8  # decimals: finer than a tenth of a micrometre in any unit
    zero = f"{0:.{digits}f}"
    return [line.replace(f"-{zero}", zero) for line in number_lines(rows, f"%.{digits}f", " ")]
