"""Edit a skeleton by hand: merge parts, rename them, move joints, one by one or from a file.

A file of edits is JSON, a list carried out from the first to the last:

    [{"merge": ["chest", "shoulder_left"]},
     {"rename": {"part3": "neck"}},
     {"move_joint": "neck", "position": [0.0, 0.02, 1.43]}]

Parts are given by name or by number; numbers are those of the skeleton at that entry. Positions are in metres on the
template.
"""
from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..geometry import storage
from ..geometry.mesh import Mesh
from .tree import Skeleton


def find_part_number(skeleton: Skeleton, part: int | str) -> int:
    """Return the number of a part that is given by name or number; ValueError for an unknown part."""
    names = skeleton.names
    if isinstance(part, str) and part in names:
        return names.index(part)
    digits = str(part)
    if not isinstance(part, bool) and digits.isdecimal() and int(digits) < len(names):
        return int(digits)
    raise ValueError(f"part: expected one of {', '.join(names)} or a number below {len(names)}, got {part!r}")


def merge_parts(skeleton: Skeleton, template: Mesh, a: int | str, b: int | str) -> Skeleton:
    """Merge two parts into one with the name of the first.

    They must be linked, or touch and share a parent. In the second case the joint lies midway between their joints.

    Parameters
    ----------
    skeleton : Skeleton
        The skeleton to edit.
    template : Mesh
        Its template.
    a, b : str or int
        Names or numbers of the parts.

    Returns
    -------
    Skeleton

    Raises
    ------
    ValueError
        An unknown part, twice the same part, or parts whose union would close a loop or lie in two pieces.
    """
    first, second = find_part_number(skeleton, a), find_part_number(skeleton, b)
    if first == second:
        raise ValueError(f"parts: expected two different parts, got '{skeleton.names[first]}' twice")
    parents = skeleton.parents
    low, high = min(first, second), max(first, second)
    siblings = parents[low] == parents[high]
    if parents[high] != low and not siblings:
        raise ValueError(f"parts: '{skeleton.names[first]}' and '{skeleton.names[second]}' are neither linked nor on "
                         "the same part, as one they would close a loop")
    if not (np.sort(skeleton.part_of_face[template.face_pairs], axis=1) == [low, high]).all(axis=1).any():
        raise ValueError(f"parts: '{skeleton.names[first]}' and '{skeleton.names[second]}' do not touch")
    joints = skeleton.joints.copy()
    if siblings:
        joints[low] = (joints[low] + joints[high]) / 2
    # renumber: the higher part disappears, the parts after it move down by one
    new = np.arange(len(parents)) - (np.arange(len(parents)) > high)
    new[high] = new[low]
    keep = np.arange(len(parents)) != high
    above = np.where(parents < 0, -1, new[parents])
    names = tuple(skeleton.names[first if p == low else p] for p in np.flatnonzero(keep))
    return Skeleton(new[skeleton.part_of_face], above[keep], joints[keep], names).with_root_centred(template)


def rename_part(skeleton: Skeleton, part: int | str, name: str) -> Skeleton:
    """Rename one part.

    Raises
    ------
    ValueError
        An unknown part, or a name that is empty, a number, or taken.
    """
    p = find_part_number(skeleton, part)
    if not isinstance(name, str) or not name.strip() or name.isdecimal():
        raise ValueError(f"name: expected a name that is not a number, got {name!r}")
    if name in skeleton.names and skeleton.names[p] != name:
        raise ValueError(f"name: '{name}' is part {skeleton.names.index(name)} already")
    return replace(skeleton, names=tuple(name if j == p else old for j, old in enumerate(skeleton.names)))


def move_joint(skeleton: Skeleton, part: int | str, position: Sequence[float]) -> Skeleton:
    """Move the joint between a part and its parent.

    Parameters
    ----------
    skeleton : Skeleton
        The skeleton to edit.
    part : str or int
        Name or number of the part.
    position : (3,) float, metres
        New position on the template.

    Returns
    -------
    Skeleton

    Raises
    ------
    ValueError
        The root, which has no joint, or an invalid position.
    """
    p = find_part_number(skeleton, part)
    if p == 0:
        raise ValueError(f"part: '{skeleton.names[0]}' is the root, its joint is the middle of its vertices")
    point = np.asarray(position, dtype=np.float64)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise ValueError(f"position: expected three finite numbers, got {position}")
    joints = skeleton.joints.copy()
    joints[p] = point
    return replace(skeleton, joints=joints)


def apply_edits(skeleton: Skeleton, template: Mesh, edits: Sequence[dict[str, Any]]) -> Skeleton:
    """Apply a list of edits in order (see the head of this module).

    Parameters
    ----------
    skeleton : Skeleton
        The skeleton to edit.
    template : Mesh
        Its template.
    edits : list of dict
        The edits, as a file holds them.

    Returns
    -------
    Skeleton

    Raises
    ------
    ValueError
        An entry that cannot be read or applied, named by its number from 1 and its text.
    """
    if len(skeleton.part_of_face) != len(template.faces):
        raise ValueError(f"template: expected the {len(skeleton.part_of_face)} triangles of the skeleton, "
                         f"got {len(template.faces)}")
    for number, edit in enumerate(edits, 1):
        try:
            skeleton = _apply(skeleton, template, edit)
        except ValueError as error:
            raise ValueError(f"edits: entry {number}, {json.dumps(edit, default=str)}: {error}") from None
    return skeleton


def read_edits(path: str | Path) -> list[dict[str, Any]]:
    """Read the edits of a JSON file; StorageError where it is missing or holds no list."""
    stored = storage.read_json(path, "a list of edits")
    if not isinstance(stored, list):
        raise storage.StorageError(f"{path}: expected a list of edits in JSON, found something else")
    return stored


def _apply(skeleton: Skeleton, template: Mesh, edit: dict[str, Any]) -> Skeleton:
    """Apply one entry of a list of edits."""
    # every action with the extra keys that it takes
    known = {"merge": set(), "rename": set(), "move_joint": {"position"}}
    if not isinstance(edit, dict):
        raise ValueError(f"expected an object with one of {', '.join(known)}")
    asked = [action for action in known if action in edit]
    if len(asked) != 1:
        raise ValueError(f"expected one of {', '.join(known)}, found {asked or list(edit)}")
    (action,) = asked
    what = edit[action]
    unknown = set(edit) - known[action] - {action}
    if unknown:
        raise ValueError(f"{action} does not know {', '.join(sorted(unknown))}")
    # carry out the action; rename takes several parts at once
    if action == "merge":
        if not isinstance(what, list) or len(what) != 2:
            raise ValueError(f"merge: expected a list of two parts, got {what!r}")
        return merge_parts(skeleton, template, *what)
    if action == "move_joint":
        if "position" not in edit:
            raise ValueError("move_joint: expected a position")
        return move_joint(skeleton, what, edit["position"])
    if not isinstance(what, dict):
        raise ValueError(f"rename: expected {{old: new}}, got {what!r}")
    for old, new in what.items():
        skeleton = rename_part(skeleton, old, new)
    return skeleton
