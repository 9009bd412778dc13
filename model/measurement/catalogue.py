"""The catalogue of measurements: names, terms of the standards, and plausible ranges."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Measure:
    """One measurement.

    `standard` is the term and its standard, with its number where two sources agree. `low` and `high`, in the `unit`,
    metres or kilograms, bound the values of people.
    """

    name: str
    standard: str
    low: float
    high: float
    unit: Literal["m", "kg"] = "m"

    @property
    def exact(self) -> float:
        """The tolerance within which a value counts as reached: 0.2 mm, 20 grams."""
        return 2e-4 if self.unit == "m" else 0.02

    @property
    def shown(self) -> tuple[float, str, int]:
        """How to show a value: the factor to the shown unit, its name, and decimals."""
        return (1000.0, "mm", 0) if self.unit == "m" else (1.0, "kg", 1)

    def text(self, value: float) -> str:
        """Format a value with its usual unit.

        Examples
        --------
        >>> CATALOGUE["waist_girth"].text(0.8512), CATALOGUE["weight"].text(78)
        ('851 mm', '78.0 kg')
        """
        factor, unit, digits = self.shown
        return f"{factor * value:,.{digits}f} {unit}"


def _sides(name: str, standard: str, low: float, high: float) -> tuple[Measure, Measure]:
    return Measure(f"{name}_left", standard, low, high), Measure(f"{name}_right", standard, low, high)


CATALOGUE: dict[str, Measure] = {measure.name: measure for measure in (
    Measure("stature", "stature (body height), ISO 7250-1", 1.2, 2.4),
    Measure("neck_height", "cervicale height, ISO 7250-1", 1.0, 2.1),
    Measure("shoulder_height", "shoulder (acromial) height, ISO 7250-1", 0.95, 2.05),
    Measure("waist_height", "waist height, ISO 8559-1", 0.7, 1.6),
    Measure("crotch_height", "crotch height, ISO 7250-1; inside leg height, ISO 8559-1", 0.45, 1.25),
    Measure("weight", "body mass (weight), ISO 7250-1; here of the volume of a closed surface", 25, 300, "kg"),
    Measure("head_girth", "head circumference, ISO 7250-1", 0.45, 0.7),
    Measure("neck_girth", "neck girth, ISO 8559-1 5.3.2", 0.22, 0.7),
    Measure("chest_girth", "bust (chest) girth, ISO 8559-1 5.3.4", 0.6, 2.0),
    Measure("under_bust_girth", "under-bust girth, ISO 8559-1", 0.5, 1.9),
    Measure("waist_girth", "waist girth, ISO 8559-1 5.3.10", 0.4, 2.2),
    Measure("hip_girth", "hip girth, ISO 8559-1 5.3.13", 0.6, 2.2),
    *_sides("thigh_girth", "thigh girth, ISO 8559-1 5.3.20", 0.3, 1.2),
    *_sides("knee_girth", "knee girth, ISO 8559-1", 0.22, 0.8),
    *_sides("calf_girth", "calf girth, ISO 8559-1", 0.2, 0.8),
    *_sides("upper_arm_girth", "upper arm girth, ISO 8559-1 5.3.16", 0.15, 0.8),
    *_sides("wrist_girth", "wrist girth, ISO 8559-1 5.3.19", 0.1, 0.35),
    Measure("shoulder_width", "shoulder (biacromial) breadth, ISO 7250-1", 0.25, 0.6),
    Measure("chest_width", "chest breadth, standing, ISO 7250-1", 0.18, 0.7),
    Measure("chest_depth", "chest depth, standing, ISO 7250-1", 0.12, 0.6),
    Measure("hip_width", "hip breadth, standing, ISO 7250-1", 0.22, 0.8),
    Measure("back_length", "back waist length, ISO 8559-1 5.4.5", 0.25, 0.7),
    Measure("shoulder_length_back", "across back shoulder width (through the back neck point), ISO 8559-1", 0.28, 0.75),
    *_sides("arm_length", "arm length (shoulder, elbow, wrist), ISO 8559-1 5.7.8", 0.35, 0.9),
    *_sides("hand_length", "hand length, ISO 7250-1", 0.12, 0.28),
    *_sides("foot_length", "foot length, ISO 7250-1", 0.17, 0.38),
)}


def plain(name: str) -> str:
    """Return the name of a measurement without its side.

    Examples
    --------
    >>> plain("thigh_girth_left")
    'thigh_girth'
    """
    return name.removesuffix("_left").removesuffix("_right")


def find_measurements(word: str) -> Sequence[str]:
    """Find the measurements that a user's word means: `waist` is the waist girth, `thigh` both thigh girths.

    Raises
    ------
    ValueError
        No measurement of that name.
    """
    said = word.strip().lower().replace("-", "_").replace(" ", "_")
    for base in (said, f"{said}_girth", *(f"{said.removesuffix(f'_{side}')}_girth_{side}"
                                          for side in ("left", "right"))):
        matches = [name for name in CATALOGUE if name in (base, f"{base}_left", f"{base}_right")]
        if matches:
            return matches
    there = ", ".join(dict.fromkeys(map(plain, CATALOGUE)))
    raise ValueError(f"no measurement {word!r}; there are: {there} (those of limbs also with _left or _right)")
