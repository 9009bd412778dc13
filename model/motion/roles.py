"""Which joints of a skeleton are hips, knees, shoulders, ...: by their names, and where these count, by lengths."""
from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

# What the joints of our parts are called elsewhere, in H-Anim, motion databases and animation programs, in small
# letters without separators; the first that a skeleton has is taken, and none twice. A knee may be a "leg" (below an
# "up leg") and a clavicle a "shoulder" (above an "arm"): so the order of the rows matters.
ROLES = {
    "humanoid_root": ("sacroiliac", "pelvis", "hips", "humanoidroot", "hip", "root", "trunk"),
    "skullbase": ("skullbase", "head", "skull", "neck1", "neck"),
    "vl5": ("vl5", "spine", "spine1", "spine01", "abdomen", "lowerback", "waist", "torso", "chest", "back")}
SIDED_ROLES = {
    "shoulder": ("upperarm", "uparm", "humerus", "arm", "shldr", "shoulder"),
    "sternoclavicular": ("sternoclavicular", "clavicle", "collar", "collarbone", "shoulder"),
    "elbow": ("elbow", "forearm", "lowerarm", "lowarm", "radius", "ulna"),
    "wrist": ("wrist", "radiocarpal", "hand"),
    "knee": ("knee", "lowerleg", "lowleg", "shin", "shank", "calf", "tibia", "leg"),
    "hip": ("upleg", "thigh", "upperleg", "femur", "hip", "leg", "hipjoint"),
    "ankle": ("ankle", "talocrural", "talus", "foot", "calcn")}
NEEDED = ("humanoid_root", "l_hip", "r_hip", "l_shoulder", "r_shoulder")


def find_roles(names: Sequence[str]) -> dict[str, int]:
    """The joints that play the parts of the humanoid, {H-Anim name: joint}; case, separators and what stands before a
    colon do not matter.
    """
    plain: dict[str, int] = {}
    for j, name in enumerate(names):
        letters = re.sub(r"[^a-z0-9]", "", name.rsplit(":", 1)[-1].lower())
        letters = re.sub(r"^(mixamorig|bip|jbipc?|def|character)\d*", "", letters)
        plain.setdefault(re.sub(r"(jnt|bone)$", "", letters), j)
    forms = dict(ROLES)
    for word, words in SIDED_ROLES.items():
        for side, spelt in (("l", ("left", "l")), ("r", ("right", "r"))):
            forms[f"{side}_{word}"] = tuple(form for each in words for s in spelt for form in (s + each, each + s))
    out: dict[str, int] = {}
    for role, words in forms.items():
        free = [plain[form] for form in words if form in plain and plain[form] not in out.values()]
        if free:
            out[role] = free[0]
    return out


def numbered_roles(names: Sequence[str], joints: np.ndarray) -> dict[str, int]:
    """`find_roles`, also of limbs that are numbered outwards (arm1_left, arm2_left, ...), with joints (J, 3) at rest.

    Of such a limb the elbow or knee is where it leaves two pieces that are most alike.
    """
    roles, names = find_roles(names), list(names)
    for side, spelt in (("l", "left"), ("r", "right")):
        for limb, wanted in (("arm", ("shoulder", "elbow", "wrist")), ("leg", ("hip", "knee", "ankle"))):
            chain = [names.index(f"{limb}{k}_{spelt}") for k in range(1, 20) if f"{limb}{k}_{spelt}" in names]
            if len(chain) > len(wanted):
                starts = range(1) if limb == "leg" else range(len(chain) - 2)
                found = _pieces(joints[chain], starts)
                roles |= {f"{side}_{role}": chain[k] for role, k in zip(wanted, found, strict=True)}
                if limb == "arm" and found[0]:
                    roles[f"{side}_sternoclavicular"] = chain[0]
            elif f"{limb}_{spelt}" in names:
                roles[f"{side}_{wanted[0]}"] = names.index(f"{limb}_{spelt}")
                roles.pop(f"{side}_knee", None)
    return roles


def _pieces(joints: np.ndarray, starts: range) -> tuple[int, int, int]:
    """Which joints (n, 3) of a limb begin its upper piece, its lower piece and its end."""
    along = np.r_[0, np.cumsum(np.linalg.norm(np.diff(joints, axis=0), axis=1))]
    last = len(joints) - 1
    pairs = [(s, e) for s in starts for e in range(s + 1, last)]
    s, e = min(pairs, key=lambda pair: abs(np.log((along[pair[1]] - along[pair[0]]) / (along[last] - along[pair[1]]))))
    return s, e, last


def above(parents: np.ndarray, j: int) -> list[int]:
    """The joint, its parent, and so on up to the root."""
    chain = [j]
    while parents[chain[-1]] >= 0:
        chain.append(int(parents[chain[-1]]))
    return chain


def way(parents: np.ndarray, start: int, end: int) -> list[int]:
    """The parts from one to another along the tree, both with them."""
    up, down = above(parents, start), above(parents, end)
    meet = next(j for j in up if j in down)
    return [*up[:up.index(meet)], *down[:down.index(meet) + 1][::-1]]


def trunk(parents: np.ndarray, roles: Mapping[str, int]) -> tuple[int, int]:
    """The lowest joint of the trunk above the pelvis, and the one that carries arms and head; the pelvis for both where
    the tree has none between.
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
