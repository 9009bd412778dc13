"""Names of people's bones in other programs."""
from __future__ import annotations

from dataclasses import replace
from typing import Literal

from scanprep.skeleton.roles import NEEDED, find_numbered_roles, trunk, way
from scanprep.skeleton.tree import Skeleton

from ..rig import Rig

Names = Literal["mixamo", "unity", "unreal", "vrm", "h-anim", "opensim"]

# Trunk: from the pelvis to the part with the arms. Limbs: {S} is Left or Right, {s} left or right, {l} l or r.
# H-Anim names are joints of version 2; OpenSim names are bodies of its usual full-body models.
_TRUNK = {"mixamo": ("Hips", "Spine", "Spine1", "Spine2"), "unity": ("Hips", "Spine", "Chest", "UpperChest"),
          "unreal": ("pelvis", "spine_01", "spine_02", "spine_03"), "vrm": ("hips", "spine", "chest", "upperChest"),
          "h-anim": ("sacroiliac", "vl5", "vt12", "vt5"), "opensim": ("pelvis",)}
_LIMBS = ("sternoclavicular", "shoulder", "elbow", "wrist", "hip", "knee", "ankle")
_SIDED = {
    "mixamo": ("{S}Shoulder", "{S}Arm", "{S}ForeArm", "{S}Hand", "{S}UpLeg", "{S}Leg", "{S}Foot"),
    "unity": ("{S}Shoulder", "{S}UpperArm", "{S}LowerArm", "{S}Hand", "{S}UpperLeg", "{S}LowerLeg", "{S}Foot"),
    "unreal": ("clavicle_{l}", "upperarm_{l}", "lowerarm_{l}", "hand_{l}", "thigh_{l}", "calf_{l}", "foot_{l}"),
    "vrm": ("{s}Shoulder", "{s}UpperArm", "{s}LowerArm", "{s}Hand", "{s}UpperLeg", "{s}LowerLeg", "{s}Foot"),
    "h-anim": tuple("{l}_" + name for name in (*_LIMBS[:3], "radiocarpal", *_LIMBS[4:6], "talocrural")),
    "opensim": (None, "humerus_{l}", "ulna_{l}", "hand_{l}", "femur_{l}", "tibia_{l}", "calcn_{l}")}


def names_of(skeleton: Skeleton, kind: Names) -> dict[str, str]:
    """Find another program's names for the parts of a person; parts without a counterpart are left out.

    The trunk is named from the pelvis upwards. Of a limb in numbered pieces, those that begin at hip, knee and ankle,
    or at shoulder, elbow and wrist, have names (`find_numbered_roles`).

    Raises
    ------
    ValueError
        None of the parts has the name of a person's.
    """
    parts = skeleton.names
    roles = find_numbered_roles(parts, skeleton.joints)
    # the trunk: from the pelvis to the part with the arms; beyond it neck and head
    rising = [name for name in ("trunk", "pelvis", "abdomen", *(f"abdomen{k}" for k in range(1, len(parts))), "chest")
              if name in parts]
    necks = [parts.index("neck")] if "neck" in parts else []
    if not rising and set(NEEDED) <= roles.keys():
        low, top = trunk(skeleton.parents, roles)
        rising = [parts[j] for j in dict.fromkeys([roles["humanoid_root"], *way(skeleton.parents, low, top)])]
        necks = way(skeleton.parents, top, roles["skullbase"])[1:-1] if "skullbase" in roles else []
    names = dict(zip(rising, _TRUNK[kind], strict=False))
    chest = {"opensim": "torso"}  # OpenSim has one trunk body: the part with the arms
    if kind in chest and rising[1:]:
        names[rising[-1]] = chest[kind]
    neck = {"mixamo": "Neck", "unity": "Neck", "unreal": "neck_01", "vrm": "neck", "h-anim": "vc4"}
    if necks and kind in neck:
        names[parts[necks[0]]] = neck[kind]
    if "skullbase" in roles and parts[roles["skullbase"]] not in names:
        head = {"mixamo": "Head", "unity": "Head", "unreal": "head", "vrm": "head", "h-anim": "skullbase",
                "opensim": "head"}
        names[parts[roles["skullbase"]]] = head[kind]
    for side in ("left", "right"):
        for joint, name in zip(_LIMBS, _SIDED[kind], strict=True):
            if name and f"{side[0]}_{joint}" in roles:
                names[parts[roles[f"{side[0]}_{joint}"]]] = name.format(S=side.title(), s=side, l=side[0])
    if not names:
        raise ValueError(f"names: expected a person's parts (pelvis, thigh_left, ...) for the names of {kind}, found "
                         f"{', '.join(parts[:4])}{', ...' if len(parts) > 4 else ''}; see scape prep skeleton")
    prefix = {"mixamo": "mixamorig:"}
    return {part: prefix.get(kind, "") + name for part, name in names.items()}


def rename_bones(rig: Rig, kind: Names) -> Rig:
    """Rename the bones as another program does; parts without a counterpart keep their names."""
    known = names_of(rig.skeleton, kind)
    names = tuple(known.get(name, name) for name in rig.skeleton.names)
    return replace(rig, skeleton=replace(rig.skeleton, names=names))
