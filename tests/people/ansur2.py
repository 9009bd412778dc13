"""The table of ANSUR II that the project keeps, made from the rows of the survey.

    python tests/people/ansur2.py FOLDER_OF_CSV -o model/measurement/ansur2.json

For each sex: how many were measured; of each measure mean, standard deviation and quantiles; and the correlation of
normal scores (ranks turned into a standard normal), which says with the quantiles how measures go together. Metres,
kilograms, years. Of the rows nothing else is kept. Odd rows can be left out, to be predicted.
"""
from __future__ import annotations

import argparse
import csv
import json
from pathlib import Path

import numpy as np
from scipy.stats import norm, rankdata

SOURCE = ("ANSUR II, the anthropometric survey of US Army personnel, 2012: Gordon et al., NATICK/TR-15/007, approved "
          "for public release, distribution unlimited; soldiers, 17 to 58 years")
COLUMNS = {                          # our measure: the survey's column
    "stature": "stature", "neck_height": "cervicaleheight", "shoulder_height": "acromialheight",
    "waist_height": "waistheightomphalion", "crotch_height": "crotchheight", "head_girth": "headcircumference",
    "neck_girth": "neckcircumference", "chest_girth": "chestcircumference", "waist_girth": "waistcircumference",
    "hip_girth": "buttockcircumference", "thigh_girth": "thighcircumference", "calf_girth": "calfcircumference",
    "wrist_girth": "wristcircumference", "shoulder_width": "biacromialbreadth", "chest_depth": "chestdepth",
    "hip_width": "hipbreadth", "back_length": "waistbacklength", "arm_length": "sleeveoutseam",
    "hand_length": "handlength", "foot_length": "footlength", "knee_height": "kneeheightmidpatella",
    "weight": "weightkg", "age": "Age"}
UNITS = {"weight": 0.1, "age": 1.0}                           # all others are in millimetres
SHARES = (0.005, 0.01, 0.025, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.975, 0.99, 0.995)


def rows(folder: Path, sex: str) -> np.ndarray:
    """(n, measures) of all who were measured."""
    with (folder / f"ansur2_{sex}.csv").open(encoding="latin-1") as file:
        return np.array([[UNITS.get(ours, 1e-3) * float(row[column]) for ours, column in COLUMNS.items()]
                         for row in csv.DictReader(file)])


def summary(people: np.ndarray) -> dict[str, object]:
    """What is kept of measures (n, measures)."""
    scores = norm.ppf((rankdata(people, axis=0) - 0.5) / len(people))
    return {"people": len(people), "mean": people.mean(axis=0).round(5).tolist(),
            "sd": people.std(axis=0, ddof=1).round(5).tolist(),
            "quantiles": np.quantile(people, SHARES, axis=0).T.round(4).tolist(),
            "correlation": np.corrcoef(scores.T).round(4).tolist()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--even", action="store_true", help="from every other row, so that the others can be predicted")
    args = parser.parse_args()
    table: dict[str, object] = {"source": SOURCE, "measures": list(COLUMNS), "shares": list(SHARES)}
    for sex in ("female", "male"):
        table[sex] = summary(rows(args.folder, sex)[::2 if args.even else 1])
    args.output.write_text(json.dumps(table).replace('], [', '],\n[').replace('"female"', '\n"female"').replace(
        '"male"', '\n"male"') + "\n")


if __name__ == "__main__":
    main()
