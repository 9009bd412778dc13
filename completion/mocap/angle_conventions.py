"""Conventions of joint angles: ISB, ISB with the pelvis by ASIS and PSIS, and Plug-in Gait for pelvis and legs.

Wu et al. 2002 (pelvis). Plug-in Gait is that of Davis et al. 1991, Kadaba et al. 1990 and Vicon's documentation.
"""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from model.body import BodyModel
from model.linear import Subject
from scanprep.ranges import Settings

from .joint_angles import ISB, Definitions, SegmentAxes, person_segments, rest_joints
from .marker_sets.layout import MarkerLayout
from .marker_sets.named import choose_layout
from .pose.pelvis import find_worn

Convention = Literal["isb", "isb-asis", "plug-in-gait"]
_PELVIS, _FEET = ("LASI", "RASI", "LPSI", "RPSI"), ("LHEE", "LTOE", "RHEE", "RTOE")
# the pelvis tilts forward and its right side rises; rotations of the ankle come before its inversion
_PLUG_IN_GAIT: Definitions = {names: rule for names, rule in ISB.items() if "ankle_angle" not in names} | {
    ("pelvis_tilt", "pelvis_list", "pelvis_rotation"): ("ground", "pelvis", "zxy", (-1, -1, 1)),
    ("ankle_angle", "ankle_rotation", "ankle_inversion"): ("shank", "foot", "zyx", (1, 1, 1))}


@dataclass(frozen=True)
class AngleConfig(Settings):
    """Settings of the joint angles in tables and over gait cycles.

    Attributes
    ----------
    convention : str
        "isb", with the pelvis upright as at rest; "isb-asis", with the pelvis by ASIS and PSIS; or "plug-in-gait",
        with that pelvis, feet from heel to toe, and the signs and sequences of Plug-in Gait for pelvis and legs.

    Examples
    --------
    >>> AngleConfig().convention
    'isb'
    """

    convention: Convention = "isb"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.convention not in get_args(Convention):
            raise ValueError(f"convention: expected one of {', '.join(get_args(Convention))}, got {self.convention!r}")


def find_landmarks(config: AngleConfig, model: BodyModel, layout: MarkerLayout) -> MarkerLayout | None:
    """Find the landmarks of a convention: markers that the person wears, others as the set plugingait39 has them.

    None for a convention without landmarks; ValueError where they are neither in the layout nor known on the model.
    """
    if config.convention == "isb":
        return None
    needed = _PELVIS if config.convention == "isb-asis" else (*_PELVIS, *_FEET)
    worn = find_worn(layout, (*needed, "SACR"))
    own = replace(layout.select([*worn.values()]), labels=tuple(worn), loose=(), wands=())
    # the sacral marker is midway between both PSIS
    missing = [label for label in needed if label not in worn and not ("SACR" in worn and "PSI" in label)]
    if not missing:
        return own
    try:
        return own.merge(choose_layout(model, "plugingait39", ())[0].select(missing))
    except ValueError:
        raise ValueError(f"convention: {config.convention!r} needs {', '.join(needed)}: expected these markers in the "
                         "layout, or a body on which the set plugingait39 is known; missing "
                         f"{', '.join(missing)}. Add them to the layout, or use 'isb'") from None


def define_segments(config: AngleConfig, model: BodyModel, subject: Subject, layout: MarkerLayout
                    ) -> SegmentAxes | None:
    """Find the segments of a person by a convention, from landmarks on the person at rest; None for the usual ISB.

    Raises
    ------
    ValueError
        No such landmarks, as `find_landmarks`; a body whose parts lack the names of a person's.
    """
    landmarks = find_landmarks(config, model, layout)
    if landmarks is None:
        return None
    rest = rest_joints(subject)
    places = landmarks.place(subject.template.with_vertices(subject.vertices(np.zeros_like(rest))))
    return turn_segments(config, person_segments(subject), rest, dict(zip(landmarks.labels, places, strict=True)))


def turn_segments(config: AngleConfig, segments: SegmentAxes, rest: np.ndarray, at: Mapping[str, np.ndarray]
                  ) -> SegmentAxes:
    """Give ISB segments the axes of a convention, from joints (J, 3) and landmarks `at` (3,) at rest, metres."""
    axes = {"pelvis": pelvis_axes(at)}
    if config.convention == "plug-in-gait":
        # a foot points from heel to toe, its z as level as it is at rest
        for side in {name[-1] for name in segments.parts if name.startswith("foot")}:
            x = at[f"{side.upper()}TOE"] - at[f"{side.upper()}HEE"]
            axes[f"foot_{side}"] = _span_axes(x, np.cross(x, segments.axes[:, 1]))
    # these axes in those that move with the joints
    moved = segments.move(np.tile(np.eye(3), (1, len(rest), 1, 1)), rest[None])
    turns = {name: moved[name][0].T @ new for name, new in axes.items()}
    return replace(segments, definitions=_PLUG_IN_GAIT if config.convention == "plug-in-gait" else ISB, turns=turns)


def pelvis_axes(at: Mapping[str, np.ndarray]) -> np.ndarray:
    """Build the axes (3, 3), columns forward, up and right, of a pelvis from LASI, RASI, LPSI and RPSI (3,), metres.

    z is along the ASIS line to the right; x is in the plane of both ASIS and the middle of both PSIS, or SACR without
    them.

    Examples
    --------
    >>> at = {"LASI": [1, 0, -1], "RASI": [1, 0, 1], "LPSI": [0, 0, -1], "RPSI": [0, 0, 1]}
    >>> bool(np.allclose(pelvis_axes({label: np.array(place) for label, place in at.items()}), np.eye(3)))
    True
    """
    right = at["RASI"] - at["LASI"]
    behind = 0.5 * (at["LPSI"] + at["RPSI"]) if {"LPSI", "RPSI"} <= at.keys() else at["SACR"]
    forward = 0.5 * (at["RASI"] + at["LASI"]) - behind
    z = right / np.linalg.norm(right)
    return _span_axes(forward - (forward @ z) * z, z)


def _span_axes(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Build axes (3, 3), columns: unit vectors along x and z, which are square to each other, and y between them."""
    x, z = x / np.linalg.norm(x), z / np.linalg.norm(z)
    return np.stack([x, np.cross(z, x), z], axis=1)
