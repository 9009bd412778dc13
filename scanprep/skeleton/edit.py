"""Edit a skeleton by hand: merge and split parts, rename them, move joints, one by one or from a file.

A file of edits is JSON, a list carried out from the first to the last:

    [{"merge": ["chest", "shoulder_left"]},
     {"split": "chest", "names": ["chest", "abdomen"]},
     {"rename": {"part3": "neck"}},
     {"move_joint": "neck", "position": [0.0, 0.02, 1.43]},
     {"move_joint": "hand_left", "ring": [8120, 8131, 8140]}]

Parts are given by name or by number; numbers are those of the skeleton at that entry. Positions are in metres on the
template. A ring is a list of its vertices; the joint moves to its centre. `names` of a split may be left out.
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
from .joints import place_joints, ring_centre
from .labels import keep_connected, label_patches
from .motions import PosedSurface
from .parts import PartSearch, SkeletonConfig
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
    if not len(border_between(template, skeleton.part_of_face, low, high)[0]):
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


def split_part(skeleton: Skeleton, template: Mesh, part: int | str, poses: np.ndarray | None = None,
               names: Sequence[str] | None = None) -> Skeleton:
    """Split one part into two: where it bends most in the poses, or in the middle of its length without poses.

    The half next to the parent (in the root: the larger) keeps number and name. The new part follows it. Children go
    with the half with which they share the longer border.

    Parameters
    ----------
    skeleton : Skeleton
        The skeleton to edit.
    template : Mesh
        Its template.
    part : str or int
        Name or number of the part.
    poses : (M, N, 3) float, metres, optional
        Registered poses of the template.
    names : two str, optional
        Names of the half that stays and of the new one.

    Returns
    -------
    Skeleton

    Raises
    ------
    ValueError
        An unknown part, one that the poses do not bend, or names that are taken.
    """
    p = find_part_number(skeleton, part)
    label = skeleton.part_of_face
    cut = (cut_across(template, label == p, skeleton.joints[list(skeleton.joints_of_part[p])]) if poses is None
           else cut_where_it_bends(template, poses, label == p))
    if cut is None:
        raise ValueError(f"part: '{skeleton.names[p]}' cannot be cut in two"
                         + ("" if poses is None else ", it does not bend in these poses"))
    P = len(skeleton.parents)
    halved = np.where(cut, P, label)

    def nearer(other: int) -> int:
        lengths = [border_between(template, halved, other, half)[1].sum() for half in (p, P)]
        return p if lengths[0] >= lengths[1] else P

    # which half stays: the one at the parent, in the root the larger one
    areas = [template.face_areas[halved == half].sum() for half in (p, P)]
    stays = nearer(int(skeleton.parents[p])) if p else (0 if areas[0] >= areas[1] else P)
    if stays == P:                                                      # swap: the half that stays is p
        halved = np.where(label == p, np.where(cut, p, P), label)
    place = np.r_[np.arange(p + 1), np.arange(p + 2, P + 1), p + 1]     # old number -> new; the new half follows p
    parents = np.full(P + 1, -1)
    for j in range(1, P):
        parents[place[j]] = place[nearer(j) if skeleton.parents[j] == p else skeleton.parents[j]]
    parents[p + 1] = p
    joints = np.empty((P + 1, 3))
    joints[place] = np.r_[skeleton.joints, np.zeros((1, 3))]
    # names: the given ones, else the old one and the first free number behind it
    name = skeleton.names[p]
    free = next(new for k in range(2, P + 3) if (new := f"{name}_{k}") not in skeleton.names)
    chosen = (name, free) if names is None else tuple(names)
    if len(chosen) != 2:
        raise ValueError(f"names: expected two, got {list(chosen)}")
    joints[p + 1] = _joint_between(template, place[halved], p, p + 1, poses)
    listed = (*skeleton.names[:p], *chosen, *skeleton.names[p + 1:])
    return Skeleton(place[halved], parents, joints, listed).with_root_centred(template)


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


def move_joint(skeleton: Skeleton, template: Mesh, part: int | str, position: Sequence[float] | None = None,
               ring: Sequence[int] | None = None) -> Skeleton:
    """Move the joint between a part and its parent.

    Parameters
    ----------
    skeleton : Skeleton
        The skeleton to edit.
    template : Mesh
        Its template.
    part : str or int
        Name or number of the part.
    position : (3,) float, metres, optional
        New position on the template.
    ring : (n,) int, optional
        Instead of a position: vertices of the template, at whose centre the joint is placed.

    Returns
    -------
    Skeleton

    Raises
    ------
    ValueError
        The root, which has no joint; both or none of `position` and `ring`; an invalid position or vertex.
    """
    p = find_part_number(skeleton, part)
    if p == 0:
        raise ValueError(f"part: '{skeleton.names[0]}' is the root, its joint is the middle of its vertices")
    if (position is None) == (ring is None):
        raise ValueError("position, ring: expected one of the two")
    joints = skeleton.joints.copy()
    if ring is not None:
        vertices = np.asarray(ring)
        n = len(template.vertices)
        whole = vertices.ndim == 1 and len(vertices) >= 3 and np.issubdtype(vertices.dtype, np.integer)
        if not whole or vertices.min() < 0 or vertices.max() >= n:
            raise ValueError(f"ring: expected at least three vertices of 0..{n - 1}, got {list(ring)}")
        joints[p] = ring_centre(template, vertices)
    else:
        point = np.asarray(position, dtype=np.float64)
        if point.shape != (3,) or not np.isfinite(point).all():
            raise ValueError(f"position: expected three finite numbers, got {position}")
        joints[p] = point
    return replace(skeleton, joints=joints)


def apply_edits(skeleton: Skeleton, template: Mesh, edits: Sequence[dict[str, Any]],
                poses: np.ndarray | None = None) -> Skeleton:
    """Apply a list of edits in order (see the head of this module).

    Parameters
    ----------
    skeleton : Skeleton
        The skeleton to edit.
    template : Mesh
        Its template.
    edits : list of dict
        The edits, as a file holds them.
    poses : (M, N, 3) float, metres, optional
        Poses in which a split part bends most at the cut.

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
            skeleton = _apply(skeleton, template, edit, poses)
        except ValueError as error:
            raise ValueError(f"edits: entry {number}, {json.dumps(edit, default=str)}: {error}") from None
    return skeleton


def read_edits(path: str | Path) -> list[dict[str, Any]]:
    """Read the edits of a JSON file; StorageError where it is missing or holds no list."""
    stored = storage.read_json(path, "a list of edits")
    if not isinstance(stored, list):
        raise storage.StorageError(f"{path}: expected a list of edits in JSON, found something else")
    return stored


def _apply(skeleton: Skeleton, template: Mesh, edit: dict[str, Any], poses: np.ndarray | None) -> Skeleton:
    """Apply one entry of a list of edits."""
    # every action with the extra keys that it takes
    known = {"merge": set(), "split": {"names"}, "rename": set(), "move_joint": {"position", "ring"}}
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
    if action == "split":
        return split_part(skeleton, template, what, poses, edit.get("names"))
    if action == "move_joint":
        return move_joint(skeleton, template, what, edit.get("position"), edit.get("ring"))
    if not isinstance(what, dict):
        raise ValueError(f"rename: expected {{old: new}}, got {what!r}")
    for old, new in what.items():
        skeleton = rename_part(skeleton, old, new)
    return skeleton


def border_between(template: Mesh, label: np.ndarray, a: int, b: int) -> tuple[np.ndarray, np.ndarray]:
    """Find the edges (n, 2) between parts a and b, as vertices, and their lengths (n,), metres."""
    shared = template.edge_use == 2
    both = np.sort(label[template.face_pairs], axis=1)
    border = (both == [min(a, b), max(a, b)]).all(axis=1)
    return template.edges[shared][border], template.edge_lengths[shared][border]


def cut_across(template: Mesh, inside_part: np.ndarray, joints: np.ndarray) -> np.ndarray | None:
    """Find the triangles (F,) bool to cut off a part (F,) bool: the farther half along its length.

    The length runs along its joints (n, 3). With one joint it runs from there to the centroid, with none along the main
    axis. Returns None where no cut leaves two connected halves.
    """
    inside = np.flatnonzero(inside_part)
    pairs = np.searchsorted(inside, template.face_pairs[inside_part[template.face_pairs].all(axis=1)])
    areas, centres = template.face_areas[inside], template.corners.mean(axis=1)[inside]
    middle = areas @ centres / areas.sum()
    # axes to try: along the joints first, then the principal axes, longest first
    axes = np.linalg.eigh(np.cov(centres.T, aweights=areas))[1].T[::-1]
    if len(joints):
        axes = np.vstack([np.linalg.svd(joints - joints.mean(axis=0))[2][0] if len(joints) > 1
                          else middle - joints[0], axes])
    for axis in axes:
        far = ((centres - middle) @ axis > 0).astype(np.int64)
        if not 0 < far.sum() < len(far):
            continue
        far = keep_connected(np.zeros((len(far), 2)), pairs, areas, far)  # detached pieces go back
        if label_patches(pairs, far).max() == 1:
            cut = np.zeros_like(inside_part)
            cut[inside[far == 1]] = True
            return cut
    return None


def cut_where_it_bends(template: Mesh, poses: np.ndarray, inside_part: np.ndarray) -> np.ndarray | None:
    """Find the triangles (F,) bool to cut off a part (F,) bool so that both halves move rigidly; None if impossible."""
    search = PartSearch(PosedSurface(template, poses), SkeletonConfig())
    halved, apart = search.split(np.where(inside_part, 0, 1), 0)
    return halved == halved.max() if apart > 0 else None


def _joint_between(template: Mesh, label: np.ndarray, a: int, b: int, poses: np.ndarray | None) -> np.ndarray:
    """Place the joint (3,) between two parts: by the poses if given, else at the centre of the border."""
    if poses is None:
        return ring_centre(template, np.unique(border_between(template, label, a, b)[0]))
    surface = PosedSurface(template, poses)
    return place_joints(surface, label, surface.core_motions(label), np.array([[a, b]]))[0][0]
