"""Whether measurements are those of one person: shares of the stature, girths to each other, left to right."""
from __future__ import annotations

import math
from collections.abc import Mapping

from .catalogue import CATALOGUE, plain

# Least and largest quotient of two measurements. People made from other shapes than the built-in ones, 30 of them, and
# 300 of the built-in ones stay inside by a third of the range or more, also heavy ones.
QUOTIENTS: dict[tuple[str, str], tuple[float, float]] = {
    ("neck_height", "stature"): (0.82, 0.91), ("shoulder_height", "stature"): (0.77, 0.88),
    ("waist_height", "stature"): (0.54, 0.68), ("crotch_height", "stature"): (0.41, 0.55),
    ("head_girth", "stature"): (0.27, 0.40), ("arm_length", "stature"): (0.24, 0.36),
    ("hand_length", "stature"): (0.085, 0.135), ("foot_length", "stature"): (0.115, 0.18),
    ("back_length", "stature"): (0.20, 0.33), ("neck_girth", "head_girth"): (0.40, 0.90),
    ("under_bust_girth", "chest_girth"): (0.70, 1.05), ("waist_girth", "chest_girth"): (0.55, 1.35),
    ("waist_girth", "hip_girth"): (0.50, 1.30), ("chest_girth", "hip_girth"): (0.55, 1.45),
    ("thigh_girth", "hip_girth"): (0.42, 0.72), ("calf_girth", "thigh_girth"): (0.45, 0.90),
    ("wrist_girth", "upper_arm_girth"): (0.28, 0.75)}
SIDES = 0.12                         # of their mean, by which left and right differ at most


def implausible_measures(values: Mapping[str, float], errors: Mapping[str, float] | None = None) -> list[str]:
    """Find what no person measures so: a tape that lies elsewhere, or sides that were mixed up.

    Parameters
    ----------
    values : dict of str to float
        Metres, and kilograms of the weight, by names of the catalogue.
    errors : dict of str to float, optional
        Expected errors. Sides may differ by twice that of both more.

    Returns
    -------
    list of str
        A sentence for each quotient that is out of range, and for each pair of sides that differ.

    Examples
    --------
    >>> implausible_measures({"stature": 1.75, "waist_height": 1.25, "waist_girth": 0.9, "hip_girth": 1.0})
    ['waist height is 71% of stature, people have 54 to 68%: look at both tapes on the page']
    """
    reasons = []
    for (name, other), (low, high) in QUOTIENTS.items():
        for word in (name, f"{name}_left", f"{name}_right"):
            whole = other if other in values else f"{other}{word.removeprefix(name)}"
            share = values[word] / values[whole] if word in values and whole in values else low
            if not low <= share <= high:
                reasons.append(f"{_words(word)} is {100 * share:.0f}% of {_words(whole)}, people have "
                               f"{100 * low:.0f} to {100 * high:.0f}%: look at both tapes on the page")
    for left in (name for name in values if name.endswith("_left")):
        right = f"{plain(left)}_right"
        unknown = 2 * math.hypot(*((errors or {}).get(side, 0.0) for side in (left, right)))
        if right in values and (abs(values[left] - values[right])
                                > SIDES * 0.5 * (values[left] + values[right]) + unknown):
            reasons.append(f"{_words(plain(left))} is {CATALOGUE[left].text(values[left])} left and "
                           f"{CATALOGUE[left].text(values[right])} right: look at both tapes on the page")
    return reasons


def _words(name: str) -> str:
    return name.replace("_", " ")
