"""The names that other programs have for the parts of people."""
from __future__ import annotations

from dataclasses import replace
from typing import Literal

from scanprep.skeleton.roles import find_numbered_roles
from scanprep.skeleton.tree import Skeleton

from ..rig import Rig

Names = Literal["mixamo", "vrm", "h-anim", "opensim"]

# The trunk from the pelvis to the part with the arms, neck, head, limbs; {S} is Left or Right, {s} left or right, {l} l
# or r. H-Anim: joints of version 2; OpenSim: bodies of the usual models of the whole body.
_TRUNK = {"mixamo": ("Hips", "Spine", "Spine1", "Spine2"), "vrm": ("hips", "spine", "chest", "upperChest"),
          "h-anim": ("sacroiliac", "vl5", "vt12", "vt5"), "opensim": ("pelvis",)}
_LIMBS = ("sternoclavicular", "shoulder", "elbow", "wrist", "hip", "knee", "ankle")
_SIDED = {
    "mixamo": ("{S}Shoulder", "{S}Arm", "{S}ForeArm", "{S}Hand", "{S}UpLeg", "{S}Leg", "{S}Foot"),
    "vrm": ("{s}Shoulder", "{s}UpperArm", "{s}LowerArm", "{s}Hand", "{s}UpperLeg", "{s}LowerLeg", "{s}Foot"),
    "h-anim": tuple("{l}_" + name for name in (*_LIMBS[:3], "radiocarpal", *_LIMBS[4:6], "talocrural")),
    "opensim": (None, "humerus_{l}", "ulna_{l}", "hand_{l}", "femur_{l}", "tibia_{l}", "calcn_{l}")}


def names_of(skeleton: Skeleton, kind: Names) -> dict[str, str]:
    """What another program calls the parts of a person, of those that it has a name for.

    The trunk is named from the pelvis upwards, as many parts as there are; of a limb whose pieces are numbered those
    that begin at hip, knee and ankle, or shoulder, elbow and wrist, have names (`find_numbered_roles`).

    Raises
    ------
    ValueError
        None of the parts has the name of a person's.
    """
    parts = skeleton.names
    rising = [name for name in ("trunk", "pelvis", "abdomen", *(f"abdomen{k}" for k in range(1, len(parts))), "chest")
              if name in parts]
    found = dict(zip(rising, _TRUNK[kind], strict=False))
    chest = {"opensim": "torso"}  # always that of the part with the arms, how many there are below it
    if kind in chest and rising[1:]:
        found[rising[-1]] = chest[kind]
    roles = find_numbered_roles(parts, skeleton.joints)
    neck = {"mixamo": "Neck", "vrm": "neck", "h-anim": "vc4"}
    if "neck" in parts and kind in neck:
        found["neck"] = neck[kind]
    if "head" in parts:
        head = {"mixamo": "Head", "vrm": "head", "h-anim": "skullbase", "opensim": "head"}
        found["head"] = head[kind]
    for side in ("left", "right"):
        for joint, name in zip(_LIMBS, _SIDED[kind], strict=True):
            if name and f"{side[0]}_{joint}" in roles:
                found[parts[roles[f"{side[0]}_{joint}"]]] = name.format(S=side.title(), s=side, l=side[0])
    if not found:
        raise ValueError(f"names: expected a person's parts (pelvis, thigh_left, ...) for the names of {kind}, found "
                         f"{', '.join(parts[:4])}{', ...' if len(parts) > 4 else ''}; see scape prep skeleton")
    prefix = {"mixamo": "mixamorig:"}
    return {part: prefix.get(kind, "") + name for part, name in found.items()}


def rename_bones(rig: Rig, kind: Names) -> Rig:
    """The rig with another program's names; parts that have no counterpart there keep theirs."""
    found = names_of(rig.skeleton, kind)
    names = tuple(found.get(name, name) for name in rig.skeleton.names)
    return replace(rig, skeleton=replace(rig.skeleton, names=names))
