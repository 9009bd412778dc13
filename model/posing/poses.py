"""Poses by hand, from joint angles."""
from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from scanprep.skeleton.edit import find_part_number
from scanprep.skeleton.tree import Skeleton


def pose_from_angles(skeleton: Skeleton, angles: Mapping[str | int, Any]) -> np.ndarray:
    """Build a pose in which some parts are rotated relative to their parents and all others are at rest.

    Parameters
    ----------
    skeleton : Skeleton
        The model's skeleton.
    angles : dict of str or int to rotation
        Parts by name or number. A rotation is an axis-angle vector (3,) in radians, or an axis and degrees:
        `("x", 30)`, `((0, 1, 1), -45)`. Axes are those of the template.

    Returns
    -------
    (J, 3) float, radians
        The pose.

    Raises
    ------
    ValueError
        A part that is unknown or given twice, or a rotation of another form.

    Examples
    --------
    >>> from model import load_built_in_model
    >>> skeleton = load_built_in_model().skeleton
    >>> pose = pose_from_angles(skeleton, {"forearm_left": ("x", 90)})
    >>> bool(np.isclose(np.linalg.norm(pose), np.pi / 2))
    True
    """
    pose = np.zeros((len(skeleton.parents), 3))
    seen: set[int] = set()
    for part, angle in angles.items():
        j = find_part_number(skeleton, part)
        if j in seen:
            raise ValueError(f"angles: part '{skeleton.names[j]}' is given twice")
        seen.add(j)
        pose[j] = rotation_vector(angle, f"angles['{part}']")
    return pose


def rotation_vector(given: Any, name: str) -> np.ndarray:
    """Convert a vector, or an axis with degrees, to an axis-angle vector (3,), radians."""
    axes = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
    if isinstance(given, tuple | list) and len(given) == 2:
        axis, degrees = given
        if isinstance(axis, str) and axis not in axes:
            raise ValueError(f"{name}: expected an axis x, y or z, got '{axis}'")
        along = _finite(axes[axis] if isinstance(axis, str) else axis, name)
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
