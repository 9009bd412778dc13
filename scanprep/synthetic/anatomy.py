"""From a body shape to its skeleton at rest and its implicit surface.

z is up, the person faces -y and stands on z = 0; the left side is +x. Anatomy is written for the left side
as (sideways, frontwards, up) and mirrored.
"""
from __future__ import annotations

import json
from dataclasses import dataclass, fields
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Any

import numpy as np

from ..ranges import Range, Settings, ranges

PARTS = ("pelvis", "abdomen", "chest", "head",
         "upper_arm_left", "forearm_left", "hand_left", "upper_arm_right", "forearm_right", "hand_right",
         "thigh_left", "shin_left", "foot_left", "thigh_right", "shin_right", "foot_right")
PARENTS = np.array([-1, 0, 1, 2, 2, 4, 5, 2, 7, 8, 0, 10, 11, 0, 13, 14])
MIRROR_PART = np.array([0, 1, 2, 3, 7, 8, 9, 4, 5, 6, 13, 14, 15, 10, 11, 12])
ARM_ANGLE, ELBOW_ANGLE, LEG_ANGLE, TOE_OUT = np.radians([36.0, 14.0, 4.5, 9.0])


def _tables() -> SimpleNamespace:
    """The tables of `anatomy.json`, where it says what their columns are: arrays, or as they stand."""
    stored = json.loads(Path(__file__).with_name("anatomy.json").read_text(encoding="utf-8"))
    rows: dict[str, Any] = {name: table["rows"] for name, table in stored.items() if name != "about"}
    for name, value in rows.items():
        if isinstance(value, list) and not name.endswith("muscles"):
            rows[name] = np.array(value)
    rows["leg_woman"] = rows["leg_man"] + rows["leg_woman_difference"]
    rows["trunk_fat_woman"] = rows["trunk_fat"] * rows["trunk_fat_woman"]
    return SimpleNamespace(**rows)


tables = _tables()


@dataclass(frozen=True)
class BodyShape(Settings):
    """What makes one person's build differ from another's.

    Except for sex and stature, 0 is the average of the sex and 1 a standard deviation above it.
    """

    sex: Annotated[float, Range(-1, 1)] = 1.0                    # -1 (woman) to 1 (man), continuous
    stature: Annotated[float, Range(1.45, 2.05)] = 1.75          # metres
    weight: Annotated[float, Range(-1.8, 3)] = 0.0               # fat all over the body
    muscle: Annotated[float, Range(-2, 3)] = 0.0                 # breadth of the muscles
    leg_length: Annotated[float, Range(-2.5, 2.5)] = 0.0         # against the stature, as of the arms
    arm_length: Annotated[float, Range(-2.5, 2.5)] = 0.0
    shoulder_width: Annotated[float, Range(-2.5, 2.5)] = 0.0     # of the skeleton, as of the hips
    hip_width: Annotated[float, Range(-2.5, 2.5)] = 0.0
    belly: Annotated[float, Range(-1.5, 3)] = 0.0                # fat at the front of the waist beyond that of weight
    chest: Annotated[float, Range(-2, 3)] = 0.0                  # depth of the rib cage; of the breasts in women
    neck: Annotated[float, Range(-2.5, 2.5)] = 0.0               # length
    head_size: Annotated[float, Range(-2.5, 2.5)] = 0.0
    limbs: Annotated[float, Range(-2, 2)] = 0.0                  # thickness of arms and legs beyond what weight gives
    extremities: Annotated[float, Range(-2.5, 2.5)] = 0.0        # length of hands and feet
    nose: Annotated[float, Range(-2, 2.5)] = 0.0                 # size

    def __post_init__(self) -> None:
        super().__post_init__()
        for field in fields(self):
            object.__setattr__(self, field.name, float(getattr(self, field.name)))

    def array(self) -> np.ndarray:
        """(15,) the values in the order of the fields."""
        return np.array([getattr(self, f.name) for f in fields(self)])

    @staticmethod
    def from_array(values: np.ndarray) -> BodyShape:
        """The inverse of `array`."""
        return BodyShape(*map(float, values))

    @staticmethod
    def random(rng: np.random.Generator, sex: float | None = None) -> BodyShape:
        """A plausible person: stature from the population, the rest normal within its range."""
        if sex is None:
            sex = 1.0 if rng.random() < 0.5 else -1.0
        man = (sex + 1) / 2
        stature = man * 1.765 + (1 - man) * 1.64 + rng.normal() * 0.068
        values = {"sex": sex, "stature": stature}
        scale = {"weight": 0.9, "muscle": 0.8, "belly": 0.7, "chest": 0.8, "limbs": 0.7}
        for field in fields(BodyShape)[2:]:
            values[field.name] = scale.get(field.name, 0.9) * rng.normal()
        allowed = {name: (found.low, found.high) for name, found in ranges(BodyShape).items()}
        return BodyShape(**{name: float(np.clip(v, *allowed[name])) for name, v in values.items()})


class Anatomy:
    """Joints and frames of one person at rest.

    `joints` (16, 3), metres, are the centres of rotation of the parts, of part 0 the middle between the hips, `ends`
    (16, 3) the far ends of their bones.
    """

    def __init__(self, shape: BodyShape) -> None:
        self.shape = s = shape
        self.man = w = (s.sex + 1) / 2
        self.fat = s.weight + 0.45 * w + 0.70 * (1 - w)       # the tables are of lean people
        self.scale = s.stature / (w * tables.stature["man"] + (1 - w) * tables.stature["woman"])
        self._levels()
        self._place_joints()

    def mix(self, man: np.ndarray | float, woman: np.ndarray | float) -> np.ndarray:
        """Between the man's and the woman's value, scaled with stature."""
        return self.scale * (self.man * np.asarray(man) + (1 - self.man) * np.asarray(woman))

    def _levels(self) -> None:
        s = self.shape
        level = {name: float(self.mix(tables.levels["man"][name], tables.levels["woman"][name]))
                 for name in tables.levels["man"]}
        width = {name: float(self.mix(tables.widths["man"][name], tables.widths["woman"][name]))
                 for name in tables.widths["man"]}
        self.head_scale = float(self.man + (1 - self.man) * 0.945) * self.scale**0.5 * (1 + 0.022 * s.head_size)
        leg = 1 + 0.03 * s.leg_length
        for name in ("ankle", "knee", "hip"):
            level[name] *= leg
        level["head"] = s.stature - 0.165 * self.head_scale
        neck = (level["head"] - level["neck"]) - (0.110 + 0.006 * s.neck) * self.scale
        level["neck"] += neck
        level["shoulder"] += neck
        self.arm = 1 + 0.03 * s.arm_length
        tip = 1 + 0.035 * s.extremities
        width["shoulder"] += self.scale * (0.007 * s.shoulder_width + 0.003 * s.muscle + 0.002 * s.weight)
        width["hip"] += self.scale * (0.004 * s.hip_width + 0.004 * max(self.fat, 0) + 0.0015 * max(s.muscle, 0))
        width["upper_arm"] *= self.arm
        width["forearm"] *= self.arm
        width["hand"] *= tip
        width["foot"] *= tip
        self.level, self.width = level, width

    def _place_joints(self) -> None:
        lv, wd, g = self.level, self.width, self.scale
        joints, ends = np.zeros((16, 3)), np.zeros((16, 3))
        span = lv["shoulder"] - lv["hip"]

        def put(side: float, front: float, up: float) -> np.ndarray:
            return np.array([side, -front, up])

        joints[0] = put(0, 0.0, lv["hip"])
        joints[1] = put(0, -0.03 * g, lv["hip"] + 0.20 * span)
        joints[2] = put(0, -0.035 * g, lv["hip"] + 0.50 * span)
        joints[3] = put(0, -0.022 * g, lv["neck"] + 0.045 * g)
        self.eye = put(0, 0.014 * g, self.shape.stature - 0.1125 * self.head_scale)
        ends[0], ends[1], ends[2] = joints[1], joints[2], put(0, -0.045 * g, lv["neck"])
        ends[3] = put(0, 0.0, self.shape.stature)
        joints[4] = put(wd["shoulder"], -0.030 * g, lv["shoulder"] - 0.012 * g)
        a, b = ARM_ANGLE, ELBOW_ANGLE
        down = put(np.sin(a), 0, -np.cos(a))
        self.upper_arm_frame = np.array([put(np.cos(a), 0, np.sin(a)), put(0, 1, 0), down])
        fore = np.cos(b) * down + np.sin(b) * put(0, 1, 0)
        self.forearm_frame = np.array([put(np.cos(a), 0, np.sin(a)), np.cos(b) * put(0, 1, 0) - np.sin(b) * down,
                                       fore])
        joints[5] = joints[4] + wd["upper_arm"] * down
        joints[6] = joints[5] + wd["forearm"] * fore
        ends[4], ends[5], ends[6] = joints[5], joints[6], joints[6] + wd["hand"] * fore
        c = LEG_ANGLE
        leg = put(np.sin(c), 0, -np.cos(c))
        self.leg_frame = np.array([put(np.cos(c), 0, np.sin(c)), put(0, 1, 0), leg])
        joints[10] = put(wd["hip"], 0, lv["hip"])
        joints[11] = joints[10] + (lv["hip"] - lv["knee"]) / np.cos(c) * leg
        joints[12] = joints[10] + (lv["hip"] - lv["ankle"]) / np.cos(c) * leg
        t = TOE_OUT
        self.foot_frame = np.array([put(np.cos(t), -np.sin(t), 0), put(0, 0, 1), put(np.sin(t), np.cos(t), 0)])
        ends[10], ends[11] = joints[11], joints[12]
        ends[12] = joints[12] + 0.75 * wd["foot"] * self.foot_frame[2]
        for left, right in ((4, 7), (5, 8), (6, 9), (10, 13), (11, 14), (12, 15)):
            joints[right], ends[right] = joints[left] * [-1, 1, 1], ends[left] * [-1, 1, 1]
        self.joints, self.ends = joints, ends

    def front(self, side: float, front: float, up: float) -> np.ndarray:
        """World point of (sideways, frontwards, up)."""
        return np.array([side, -front, up])

    def at(self, level: float) -> float:
        """Height in metres of a level of the trunk: 0 hip joints, 1 shoulder joints."""
        return self.level["hip"] + level * (self.level["shoulder"] - self.level["hip"])
