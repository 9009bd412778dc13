"""The vocabulary of the parts of people: our names, those of other programs, and the joints they hang on.

The name of a part ends with its side: `thigh_left`. Models of other programs, and files of older
versions (`l_thigh`), are understood by `find_roles` and `part_name`.
"""
from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ..geometry.sides import split_side


class Role(NamedTuple):
    """A joint of the humanoid: our name of the part it moves, the joint in words, and its names in other programs."""

    part: str
    joint: str
    words: tuple[str, ...]


# Keys are H-Anim's joints. Words are names in motion databases and animation programs, in lower case without
# separators. The first word that a skeleton has is taken, and no joint twice. A knee may be called "leg" (below an "up
# leg") and a clavicle "shoulder" (above an "arm"), so the order of the rows matters.
ROLES = {
    "humanoid_root": Role("pelvis", "pelvis", ("sacroiliac", "pelvis", "hips", "humanoidroot", "hip", "root", "trunk")),
    "skullbase": Role("head", "neck", ("skullbase", "head", "skull", "neck1", "neck")),
    "vl5": Role("abdomen", "waist", ("vl5", "spine", "spine1", "spine01", "abdomen", "lowerback", "waist", "torso",
                                     "chest", "back"))}
SIDED_ROLES = {
    "shoulder": Role("upper_arm", "shoulder", ("upperarm", "uparm", "humerus", "arm", "shldr", "shoulder")),
    "sternoclavicular": Role("shoulder", "collarbone", ("sternoclavicular", "clavicle", "collar", "collarbone",
                                                        "shoulder")),
    "elbow": Role("forearm", "elbow", ("elbow", "forearm", "lowerarm", "lowarm", "radius", "ulna")),
    "wrist": Role("hand", "wrist", ("wrist", "radiocarpal", "hand")),
    "knee": Role("shin", "knee", ("knee", "lowerleg", "lowleg", "shin", "shank", "calf", "tibia", "leg")),
    "hip": Role("thigh", "hip", ("upleg", "thigh", "upperleg", "femur", "hip", "leg", "hipjoint")),
    "ankle": Role("foot", "ankle", ("ankle", "talocrural", "talus", "foot", "calcn"))}
LIMBS = {"arm": ("sternoclavicular", "shoulder", "elbow", "wrist"), "leg": ("hip", "knee", "ankle")}
NEEDED = ("humanoid_root", "l_hip", "r_hip", "l_shoulder", "r_shoulder")


def part_name(name: str) -> str:
    """Return a part's name in our spelling: hand_left for l_hand, HandLeft, or hand.L."""
    plain, side = split_side(name)
    return f"{plain}_{side}".replace(" ", "_") if plain and side else name


def part_kind(name: str) -> str:
    """Return a part's name without side and number: thigh for thigh2_left and l_thigh."""
    return split_side(name)[0].rstrip("0123456789")


def in_words(name: str) -> str:
    """Return a part's name in words: "left forearm" for forearm_left and l_forearm."""
    plain, side = split_side(name)
    return f"{side} {plain}".strip().replace("_", " ")


def joint_in_words(name: str) -> str:
    """Return in words the joint that a part hangs on: "left elbow" for forearm_left."""
    joints = {role.part: role.joint for role in (ROLES["skullbase"], *SIDED_ROLES.values()) if role.part != "shoulder"}
    plain, side = split_side(name)
    joint = (joints | {"arm": "shoulder", "leg": "hip"}).get(plain)
    return f"{side} {joint}".strip() if joint else f"joint of the {in_words(name)}"


def find_roles(names: Sequence[str]) -> dict[str, int]:
    """Map H-Anim names to joints, {name: joint}; case, separators and a prefix before a colon do not matter."""
    plain: dict[str, int] = {}
    for j, name in enumerate(names):
        # bare letters, without prefixes and suffixes of programs such as mixamorig, bip01, def, _jnt
        letters = re.sub(r"[^a-z0-9]", "", name.rsplit(":", 1)[-1].lower())
        letters = re.sub(r"^(mixamorig|bip|jbipc?|def|character)\d*", "", letters)
        plain.setdefault(re.sub(r"(jnt|bone)$", "", letters), j)
    # limbs in numbered pieces: the joint is at the first
    for name, j in list(plain.items()):
        plain.setdefault(re.sub(r"0?1(left|right|[lr])$", r"\1", name), j)
    forms = {name: role.words for name, role in ROLES.items()}
    for name, role in SIDED_ROLES.items():
        for side, spelt in (("l", ("left", "l")), ("r", ("right", "r"))):
            forms[f"{side}_{name}"] = tuple(form for each in role.words for s in spelt for form in (s + each, each + s))
    out: dict[str, int] = {}
    for name, words in forms.items():
        free = [plain[form] for form in words if form in plain and plain[form] not in out.values()]
        if free:
            out[name] = free[0]
    return out


def limb_parts(names: Sequence[str], parents: np.ndarray, joints: np.ndarray, limb: str, side: str) -> list[int]:
    """Return the parts of an "arm" or "leg" of the "left" or "right", from the body outwards; empty where not named."""
    roles = find_numbered_roles(names, joints)
    named = [roles[f"{side[0]}_{role}"] for role in LIMBS[limb] if f"{side[0]}_{role}" in roles]
    return way(parents, named[0], named[-1]) if named else []


def find_numbered_roles(names: Sequence[str], joints: np.ndarray) -> dict[str, int]:
    """Map H-Anim names to joints as `find_roles` does, and also to numbered limbs (arm1_left, arm2_left, ...).

    `joints` (J, 3) are at rest. The elbow or knee of a numbered limb divides it into the most equal halves.
    """
    roles, names = find_roles(names), [part_name(name) for name in names]
    for side, spelt in (("l", "left"), ("r", "right")):
        for limb, wanted in (("arm", ("shoulder", "elbow", "wrist")), ("leg", ("hip", "knee", "ankle"))):
            chain = [names.index(f"{limb}{k}_{spelt}") for k in range(1, 20) if f"{limb}{k}_{spelt}" in names]
            if len(chain) > len(wanted):
                starts = range(1) if limb == "leg" else range(len(chain) - 2)
                pieces = _pieces(joints[chain], starts)
                roles |= {f"{side}_{role}": chain[k] for role, k in zip(wanted, pieces, strict=True)}
                if limb == "arm" and pieces[0]:
                    roles[f"{side}_sternoclavicular"] = chain[0]
            elif f"{limb}_{spelt}" in names:
                roles[f"{side}_{wanted[0]}"] = names.index(f"{limb}_{spelt}")
                roles.pop(f"{side}_knee", None)
    return roles


def missing_joints(names: Sequence[str], joints: np.ndarray) -> list[str]:
    """List the joints, in words, that a person's skeleton lacks; empty for a body that is no person.

    Parameters
    ----------
    names : sequence of str
        Names of the J parts.
    joints : (J, 3) float, metres
        Joints at rest.

    Returns
    -------
    list of str
    """
    roles = find_numbered_roles(names, joints)
    if not set(NEEDED) <= set(roles):
        return []
    missing = [] if "skullbase" in roles else ["neck"]
    for name in ("elbow", "wrist", "knee", "ankle"):
        sides = [side for side in ("left", "right") if f"{side[0]}_{name}" not in roles]
        missing += [f"{name}s"] if len(sides) == 2 else [f"{sides[0]} {name}"] if sides else []
    return missing


def _pieces(joints: np.ndarray, starts: range) -> tuple[int, int, int]:
    """Find the joints (of n, 3) where the upper piece, the lower piece and the end of a limb begin."""
    along = np.r_[0, np.cumsum(np.linalg.norm(np.diff(joints, axis=0), axis=1))]
    last = len(joints) - 1
    pairs = [(s, e) for s in starts for e in range(s + 1, last)]
    s, e = min(pairs, key=lambda pair: abs(np.log((along[pair[1]] - along[pair[0]]) / (along[last] - along[pair[1]]))))
    return s, e, last


def above(parents: np.ndarray, j: int) -> list[int]:
    """Return the joint, its parent, and so on up to the root."""
    chain = [j]
    while parents[chain[-1]] >= 0:
        chain.append(int(parents[chain[-1]]))
    return chain


def way(parents: np.ndarray, start: int, end: int) -> list[int]:
    """Return the parts from one to another along the tree, including both."""
    up, down = above(parents, start), above(parents, end)
    meet = next(j for j in up if j in down)
    return [*up[:up.index(meet)], *down[:down.index(meet) + 1][::-1]]


def trunk(parents: np.ndarray, roles: Mapping[str, int]) -> tuple[int, int]:
    """Return the lowest joint of the trunk above the pelvis, and the one that carries arms and head.

    Both are the pelvis where the tree has none between.
    """
    pelvis = roles["humanoid_root"]
    chains = [above(parents, roles[role]) for role in ("l_shoulder", "r_shoulder") if role in roles]
    if len(chains) < 2:
        lowest = roles.get("vl5", pelvis)
        return lowest, lowest
    top = next(j for j in chains[0] if j in chains[1])
    upwards = above(parents, top)
    if pelvis not in upwards or top == pelvis:
        lowest = roles.get("vl5", top)
        return (lowest, top) if lowest in upwards else (top, top)
    return upwards[upwards.index(pelvis) - 1], top
