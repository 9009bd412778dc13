"""Percentiles of measurements among the people of the ANSUR II survey.

The table holds mean, standard deviation and quantiles of 22 measures and age for women and men, and their correlation.
`tests/people/ansur2.py` made it from the rows of the survey, which are not included.
"""
from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.special import ndtr, ndtri

from ..shape_statistics import WORDS, Sex
from .catalogue import plain

TABLE = Path(__file__).with_name("ansur2.json")
# Measures that are taken here as in the survey. For every seventh man of SPRING they are 0.1 to 0.7 standard deviations
# from the survey on average. The others are 0.8 to 3.1 off, since they are taken elsewhere: ends of hands, arms and
# shoulders, crotch, level of the waist, neck. Heads wear hair or caps, and hips stand with feet apart.
ALIKE = ("stature", "neck_height", "shoulder_height", "chest_girth", "waist_girth", "hip_girth", "thigh_girth",
         "calf_girth", "wrist_girth", "chest_depth", "foot_length", "weight")


@dataclass(frozen=True, eq=False)
class Survey:
    """What was measured of one sex.

    Attributes
    ----------
    people : int
        How many were measured.
    names : tuple of str
        Measures, as in `CATALOGUE` without the side; "knee_height" and "age" beside them.
    mean, sd : (m,) float
        Metres; kilograms; years.
    shares : (q,) float
        Of the people, from 0 to 1.
    quantiles : (m, q) float
        What that share of the people do not exceed.
    correlation : (m, m) float
        Of normal scores.
    """

    people: int
    names: tuple[str, ...]
    mean: np.ndarray
    sd: np.ndarray
    shares: np.ndarray
    quantiles: np.ndarray
    correlation: np.ndarray


@lru_cache(maxsize=2)
def survey(sex: Sex) -> Survey:
    """Read the table of a sex, which `tests/people/ansur2.py` made.

    Raises
    ------
    ValueError
        Another word than "female" or "male".
    """
    if sex not in WORDS:
        raise ValueError(f"sex: expected 'female' or 'male', got {sex!r}")
    table = json.loads(TABLE.read_text(encoding="utf-8"))
    own = table[sex]
    return Survey(own["people"], tuple(table["measures"]), np.array(own["mean"]), np.array(own["sd"]),
                  np.array(table["shares"]), np.array(own["quantiles"]), np.array(own["correlation"]))


def percentiles(values: Mapping[str, float], sex: Sex) -> dict[str, float]:
    """Compute the percentile of each measure among the people of a sex, where the survey measures as we do.

    Between two quantiles the normal score is linear in the value, and it is extrapolated beyond the outermost ones. The
    survey measured soldiers of 17 to 58 years, who are leaner and younger than the population.

    Parameters
    ----------
    values : name to float
        Metres, and kilograms of the weight, by names of `CATALOGUE`.
    sex : {"female", "male"}
        With whom to compare.

    Returns
    -------
    dict of name to float
        Percentiles of the measures in `ALIKE`, from 0.1 to 99.9, as nothing is known further out.

    Examples
    --------
    >>> {name: round(share) for name, share in percentiles({"stature": 1.756, "waist_girth": 0.94}, "male").items()}
    {'stature': 51, 'waist_girth': 51}
    """
    table = survey(sex)
    scores, found = ndtri(table.shares), dict[str, float]()
    for name, value in values.items():
        if plain(name) not in ALIKE or not np.isfinite(value):
            continue
        x = table.quantiles[table.names.index(plain(name))]
        if value < x[0] or value > x[-1]:
            a, b = (0, 1) if value < x[0] else (-2, -1)
            score = scores[b] + (value - x[b]) * (scores[b] - scores[a]) / (x[b] - x[a])
        else:
            score = float(np.interp(value, x, scores))
        found[name] = float(np.clip(100 * ndtr(score), 0.1, 99.9))
    return found


def ordinal(percentile: float) -> str:
    """Format a percentile: 52nd, above 99th, below 1st.

    Examples
    --------
    >>> ordinal(51.7), ordinal(12.2), ordinal(99.7)
    ('52nd', '12th', 'above 99th')
    """
    if percentile > 99:
        return "above 99th"
    if percentile < 1:
        return "below 1st"
    whole = round(percentile)
    ending = "th" if whole % 100 in (11, 12, 13) else {1: "st", 2: "nd", 3: "rd"}.get(whole % 10, "th")
    return f"{whole}{ending}"
