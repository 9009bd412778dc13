"""What is measured: names, the standards' terms, and what people measure."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Measure:
    """One measurement.

    `standard` is the term and the standard that it comes from; `low` and `high`, metres, bound what people measure.
    """

    name: str
    standard: str
    low: float
    high: float


def _sides(name: str, standard: str, low: float, high: float) -> tuple[Measure, Measure]:
    return Measure(f"{name}_left", standard, low, high), Measure(f"{name}_right", standard, low, high)


CATALOGUE: dict[str, Measure] = {measure.name: measure for measure in (
    Measure("stature", "stature (body height), ISO 7250-1", 1.2, 2.4),
    Measure("neck_height", "cervicale height, ISO 7250-1", 1.0, 2.1),
    Measure("shoulder_height", "shoulder (acromial) height, ISO 7250-1", 0.95, 2.05),
    Measure("waist_height", "waist height, ISO 8559-1", 0.7, 1.6),
    Measure("crotch_height", "crotch height, ISO 7250-1; inside leg height, ISO 8559-1", 0.45, 1.25),
    Measure("head_girth", "head circumference, ISO 7250-1", 0.45, 0.7),
    Measure("neck_girth", "neck girth, ISO 8559-1", 0.22, 0.7),
    Measure("chest_girth", "bust (chest) girth, ISO 8559-1", 0.6, 2.0),
    Measure("under_bust_girth", "under-bust girth, ISO 8559-1", 0.5, 1.9),
    Measure("waist_girth", "waist girth, ISO 8559-1", 0.4, 2.2),
    Measure("hip_girth", "hip girth, ISO 8559-1", 0.6, 2.2),
    *_sides("thigh_girth", "thigh girth, ISO 8559-1", 0.3, 1.2),
    *_sides("knee_girth", "knee girth, ISO 8559-1", 0.22, 0.8),
    *_sides("calf_girth", "calf girth, ISO 8559-1", 0.2, 0.8),
    *_sides("upper_arm_girth", "upper arm girth, ISO 8559-1", 0.15, 0.8),
    *_sides("wrist_girth", "wrist girth, ISO 8559-1", 0.1, 0.35),
    Measure("shoulder_width", "shoulder (biacromial) breadth, ISO 7250-1", 0.25, 0.6),
    Measure("chest_width", "chest breadth, standing, ISO 7250-1", 0.18, 0.7),
    Measure("chest_depth", "chest depth, standing, ISO 7250-1", 0.12, 0.6),
    Measure("hip_width", "hip breadth, standing, ISO 7250-1", 0.22, 0.8),
    Measure("back_length", "back waist length, ISO 8559-1", 0.25, 0.7),
    Measure("shoulder_length_back", "across back shoulder width (through the back neck point), ISO 8559-1", 0.28, 0.75),
    *_sides("arm_length", "arm length (shoulder, elbow, wrist), ISO 8559-1", 0.35, 0.9),
    *_sides("hand_length", "hand length, ISO 7250-1", 0.12, 0.28),
    *_sides("foot_length", "foot length, ISO 7250-1", 0.17, 0.38),
)}


def named(word: str) -> Sequence[str]:
    """The measurements that a user's word means: `waist` the waist girth, `thigh` both thighs' girths.

    Raises
    ------
    ValueError
        No measurement of that name.
    """
    plain = word.strip().lower().replace("-", "_").replace(" ", "_")
    for base in (plain, f"{plain}_girth", *(f"{plain.removesuffix(f'_{side}')}_girth_{side}"
                                            for side in ("left", "right"))):
        found = [name for name in CATALOGUE if name in (base, f"{base}_left", f"{base}_right")]
        if found:
            return found
    plain_names = dict.fromkeys(name.removesuffix("_left").removesuffix("_right") for name in CATALOGUE)
    raise ValueError(f"no measurement {word!r}; there are: {', '.join(plain_names)} (those of limbs also with _left "
                     "or _right)")
