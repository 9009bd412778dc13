"""The names that other programs have for the parts of people."""
from __future__ import annotations

import re
from dataclasses import replace
from typing import Literal

from .rig import Rig

Names = Literal["mixamo", "vrm", "h-anim", "opensim"]

# trunk from the pelvis to the part with the arms, then neck and head, then limbs; {S} is Left or Right, {s} left or
# right, {l} l or r. H-Anim: joints of version 2; OpenSim: bodies of the usual models of the whole body.
_TRUNK = {"mixamo": ("Hips", "Spine", "Spine1", "Spine2"), "vrm": ("hips", "spine", "chest", "upperChest"),
          "h-anim": ("sacroiliac", "vl5", "vt12", "vt5"), "opensim": ("pelvis",)}
_CHEST = {"opensim": "torso"}        # always that of the part with the arms, how many there are below it
_PARTS = {
    "mixamo": {"neck": "Neck", "head": "Head", "shoulder": "{S}Shoulder", "upper_arm": "{S}Arm",
               "forearm": "{S}ForeArm", "hand": "{S}Hand", "thigh": "{S}UpLeg", "shin": "{S}Leg", "foot": "{S}Foot",
               "toes": "{S}ToeBase"},
    "vrm": {"neck": "neck", "head": "head", "shoulder": "{s}Shoulder", "upper_arm": "{s}UpperArm",
            "forearm": "{s}LowerArm", "hand": "{s}Hand", "thigh": "{s}UpperLeg", "shin": "{s}LowerLeg",
            "foot": "{s}Foot", "toes": "{s}Toes"},
    "h-anim": {"neck": "vc4", "head": "skullbase", "shoulder": "{l}_sternoclavicular", "upper_arm": "{l}_shoulder",
               "forearm": "{l}_elbow", "hand": "{l}_radiocarpal", "thigh": "{l}_hip", "shin": "{l}_knee",
               "foot": "{l}_talocrural"},
    "opensim": {"head": "head", "upper_arm": "humerus_{l}", "forearm": "ulna_{l}", "hand": "hand_{l}",
                "thigh": "femur_{l}", "shin": "tibia_{l}", "foot": "calcn_{l}"}}
_PREFIX = {"mixamo": "mixamorig:"}


def names_of(parts: tuple[str, ...], kind: Names) -> dict[str, str]:
    """What another program calls the parts of a person, of those that it has a name for.

    The trunk is named from the pelvis upwards, as many parts as there are.

    Raises
    ------
    ValueError
        None of the parts has the name of a person's.
    """
    rising = [name for name in ("pelvis", "abdomen", *(f"abdomen{k}" for k in range(1, len(parts))), "chest")
              if name in parts]
    rising = [name for name in parts if name == "trunk"] or rising
    found = dict(zip(rising, _TRUNK[kind], strict=False))
    if kind in _CHEST and rising[1:]:
        found[rising[-1]] = _CHEST[kind]
    for part in parts:
        plain, side = _kind_and_side(part, parts)
        if plain in _PARTS[kind] and (side or plain in ("neck", "head")):
            found[part] = _PARTS[kind][plain].format(S=(side or "").title(), s=side, l=(side or " ")[0])
    if not found:
        raise ValueError(f"names: expected a person's parts (pelvis, thigh_left, ...) for the names of {kind}, found "
                         f"{', '.join(parts[:4])}{', ...' if len(parts) > 4 else ''}; see scape prep skeleton")
    return {part: _PREFIX.get(kind, "") + name for part, name in found.items()}


def _kind_and_side(part: str, parts: tuple[str, ...]) -> tuple[str, str]:
    """What kind of part it is, and "left", "right" or ""; limbs of more segments than have names are numbered."""
    if part[:2] in ("l_", "r_"):                                             # of the synthetic people
        return part[2:], "left" if part[0] == "l" else "right"
    plain, _, side = part.rpartition("_")
    if side not in ("left", "right"):
        return part, ""
    limb = re.fullmatch("(arm|leg)([0-9]+)", plain)
    if limb is None:
        return plain, side
    n, k = sum(re.fullmatch(f"{limb[1]}[0-9]+_{side}", name) is not None for name in parts), int(limb[2])
    ends = {"arm": ("upper_arm", "forearm", "hand"), "leg": ("thigh", "shin", "foot")}[limb[1]]
    if limb[1] == "leg":                                                     # a thigh in pieces begins at the hip
        ends = ("", *ends[1:])
    first = {"arm": "shoulder", "leg": "thigh"}[limb[1]]
    return first if k == 1 else ends[k - n + 2] if k > n - 3 else plain, side


def renamed(rig: Rig, kind: Names) -> Rig:
    """The rig with another program's names; parts that have no counterpart there keep theirs."""
    found = names_of(rig.skeleton.names, kind)
    names = tuple(found.get(name, name) for name in rig.skeleton.names)
    return replace(rig, skeleton=replace(rig.skeleton, names=names))
