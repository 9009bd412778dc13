"""Which joint of somebody else's skeleton is which of ours, by its name and its place in the tree."""
from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

# What the joints of our parts are called elsewhere, in H-Anim, motion databases and animation programs, in small
# letters without separators; the first that a skeleton has is taken, and none twice. A knee may be a "leg" (below an
# "up leg") and a clavicle a "shoulder" (above an "arm"): so the order of the rows matters.
_MIDDLE = {
    "humanoid_root": ("sacroiliac", "pelvis", "hips", "humanoidroot", "hip", "root"),
    "skullbase": ("skullbase", "head", "skull", "neck1", "neck"),
    "vl5": ("vl5", "spine", "spine1", "spine01", "abdomen", "lowerback", "waist", "torso", "chest", "back")}
_SIDED = {
    "shoulder": ("upperarm", "uparm", "humerus", "arm", "shldr", "shoulder"),
    "sternoclavicular": ("sternoclavicular", "clavicle", "collar", "collarbone", "shoulder"),
    "elbow": ("elbow", "forearm", "lowerarm", "lowarm", "radius"),
    "wrist": ("wrist", "radiocarpal", "hand"),
    "knee": ("knee", "lowerleg", "lowleg", "shin", "shank", "calf", "tibia", "leg"),
    "hip": ("upleg", "thigh", "upperleg", "femur", "hip", "leg", "hipjoint"),
    "ankle": ("ankle", "talocrural", "foot")}
_SIDES = {"l": ("left", "l"), "r": ("right", "r")}
_BEFORE = re.compile(r"^(mixamorig|bip|jbipc?|def|character)\d*")
_AFTER = re.compile(r"(jnt|bone)$")


def find_roles(names: Sequence[str], given: Mapping[str, str] | None = None) -> dict[str, int]:
    """The joints that play the parts of the humanoid: {H-Anim name: number of the joint}.

    Case, separators and what stands before a colon do not matter. `given` names come instead of what the names
    suggest, an empty one for none.
    """
    plain: dict[str, int] = {}
    for j, name in enumerate(names):
        plain.setdefault(_plain(name), j)
    keys = {role: tuple(words) for role, words in _MIDDLE.items()}
    for word, words in _SIDED.items():
        for side, spelt in _SIDES.items():
            keys[f"{side}_{word}"] = tuple(
                form for each in words for s in spelt for form in (s + each, each + s))
    out: dict[str, int] = {}
    for role, name in (given or {}).items():
        if role not in keys or name not in (*names, ""):
            raise ValueError(f"names: expected the name of a joint for one of {', '.join(sorted(keys))}, "
                             f"got {name!r} for {role!r}")
        if name:
            out[role] = list(names).index(name)
    for role, forms in keys.items():
        if role not in (given or {}):
            free = [plain[form] for form in forms if form in plain and plain[form] not in out.values()]
            if free:
                out[role] = free[0]
    return out


def _plain(name: str) -> str:
    letters = re.sub(r"[^a-z0-9]", "", name.rsplit(":", 1)[-1].lower())
    return _AFTER.sub("", _BEFORE.sub("", letters))


def above(parents: np.ndarray, j: int) -> list[int]:
    """The joint, its parent, and so on up to the root."""
    chain = [j]
    while parents[chain[-1]] >= 0:
        chain.append(int(parents[chain[-1]]))
    return chain


def trunk(parents: np.ndarray, roles: Mapping[str, int]) -> tuple[int, int]:
    """The lowest joint of the trunk above the pelvis and the one that carries arms and head.

    Both are the pelvis where the tree has no joint between them.
    """
    pelvis = roles["humanoid_root"]
    chains = [above(parents, roles[role]) for role in ("l_shoulder", "r_shoulder") if role in roles]
    if len(chains) < 2:
        lowest = roles.get("vl5", pelvis)
        return lowest, lowest
    top = next(j for j in chains[0] if j in chains[1])
    way = above(parents, top)
    if pelvis not in way or top == pelvis:
        lowest = roles.get("vl5", top)
        return (lowest, top) if lowest in way else (top, top)
    return way[way.index(pelvis) - 1], top
