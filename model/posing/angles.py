"""Poses by hand: from joint angles, and by rotating a joint."""
from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np

from scanprep.geometry import rotations
from scanprep.skeleton.tree import Skeleton

Frame = Literal["parent", "world", "own"]

_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


def pose_from_angles(skeleton: Skeleton, angles: Mapping[str | int, Any]) -> np.ndarray:
    """A pose in which some parts are turned against their parents and all others are at rest.

    Parameters
    ----------
    skeleton : Skeleton
    angles : {part: turn}
        Parts by name or number. A turn is an axis-angle vector (3,) in radians, or an axis and degrees: `("x", 30)`,
        `((0, 1, 1), -45)`. Axes are those of the template.

    Returns
    -------
    (J, 3) float, radians

    Raises
    ------
    ValueError
        A part that is not known or given twice, a turn that is neither.
    """
    pose = np.zeros((len(skeleton.parents), 3))
    seen: set[int] = set()
    for part, angle in angles.items():
        j = part_number(skeleton, part)
        if j in seen:
            raise ValueError(f"angles: part '{skeleton.names[j]}' is given twice")
        seen.add(j)
        pose[j] = turn_vector(angle, f"angles['{part}']")
    return pose


def rotate_joint(skeleton: Skeleton, pose: np.ndarray, part: str | int, rotation: Any, frame: Frame = "parent"
                 ) -> np.ndarray:
    """Rotate one part, and what hangs below it, further from where it is.

    Parameters
    ----------
    skeleton : Skeleton
    pose : (..., J, 3) float, radians
    part : str or int
    rotation
        As in `pose_from_angles`: axis-angle vector, or axis and degrees.
    frame : str
        Whose axes these are: of the part's "parent" (of the world for the root), of the "world", or of the part's
        "own" present frame.

    Returns
    -------
    (..., J, 3) float, radians

    Raises
    ------
    ValueError
        A part or frame that is not known, a rotation that is neither.
    """
    pose = np.array(pose, dtype=np.float64)
    j = part_number(skeleton, part)
    if pose.shape[-2:] != (len(skeleton.parents), 3):
        raise ValueError(f"pose: expected shape (..., {len(skeleton.parents)}, 3), got {pose.shape}")
    more, now = rotations.exp(turn_vector(rotation, "rotation")), rotations.exp(pose[..., j, :])
    if frame == "own":
        turned = now @ more
    elif frame == "parent" or (frame == "world" and j == 0):
        turned = more @ now
    elif frame == "world":
        above = skeleton.part_rotations(pose)[..., skeleton.parents[j], :, :]
        turned = np.swapaxes(above, -1, -2) @ more @ above @ now
    else:
        raise ValueError(f"frame: expected 'parent', 'world' or 'own', got {frame!r}")
    pose[..., j, :] = rotations.log(turned)
    return pose


def part_number(skeleton: Skeleton, part: str | int) -> int:
    """The number of a part given by name or number, or ValueError."""
    if isinstance(part, str):
        if part not in skeleton.names:
            raise ValueError(f"part: no '{part}'; the skeleton has {', '.join(skeleton.names)}")
        return skeleton.names.index(part)
    if not 0 <= part < len(skeleton.parents):
        raise ValueError(f"part: expected 0..{len(skeleton.parents) - 1}, got {part}")
    return int(part)


def turn_vector(given: Any, name: str) -> np.ndarray:
    """The axis-angle vector (3,), radians, of a vector or of an axis with degrees."""
    if isinstance(given, tuple | list) and len(given) == 2:
        axis, degrees = given
        if isinstance(axis, str) and axis not in _AXES:
            raise ValueError(f"{name}: expected an axis x, y or z, got '{axis}'")
        along = _finite(_AXES[axis] if isinstance(axis, str) else axis, name)
        length = float(np.linalg.norm(along))
        if not length:
            raise ValueError(f"{name}: the axis has no direction")
        return np.radians(float(degrees)) * along / length
    return _finite(given, name)


def _finite(given: Any, name: str) -> np.ndarray:
    try:
        vector = np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        vector = np.zeros(0)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ValueError(f"{name}: expected an axis-angle vector of 3 numbers, or an axis and degrees, got {given!r}")
    return vector
