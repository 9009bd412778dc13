"""The built-in people against ANSUR II: bodies drawn from each sex, and people of the survey made from three measures.

    python tests/benchmarks/population.py -o population.json [--drawn 2500] [--crossed 500] [--rows FOLDER_OF_CSV]

Of bodies drawn: mean, standard deviation and percentiles of every measure beside the survey's, correlations, body mass
index; how many have skin that runs through itself or triangles turned over (*impossible*, looked for in some of them).
With the rows of the survey, which the project does not hold: every 20th odd row, stature, weight and waist given to
`body_with_measurements`, and how far its other measures are from those that were taken. The table of moments was made
from all rows, which are thousands, so these are hardly part of it.
"""
from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np
from protocols import machine, write_report

from model import body_with_measurements, find_tapes, load_built_in_model
from model.measurement.measure import measure
from model.measurement.survey import survey
from scanprep.synthetic import topology
from scanprep.synthetic.anatomy import Sex
from scanprep.synthetic.landmarks import landmarks
from scanprep.synthetic.population import population

sys.path.append(str(Path(__file__).parents[1] / "people"))

from ansur2 import rows as survey_rows
from contact import crossing, turned_over

SEXES: tuple[Sex, Sex] = ("female", "male")
SHARES = (0.05, 0.5, 0.95)
GIVEN = ("stature", "weight", "waist_girth")


def drawn(sex: Sex, count: int, crossed: int) -> dict[str, object]:
    """Measures of so many bodies of a sex beside those of the survey, and how many of some are impossible."""
    people, (mean, covariance), table = population(), population().moments[sex], survey(sex)
    faces, n = topology.load_topology().mesh.faces, len(people.weights)
    tapes, rng = find_tapes(topology.load_topology().mesh, landmarks()), np.random.default_rng(0)
    names = [name for name in table.names if name not in ("age", "knee_height")]
    words = [name if name in tapes.found else f"{name}_left" for name in names]
    rest, values, impossible = people.rows(mean)[:n], [], 0
    for k, z in enumerate(rng.standard_normal((count, len(mean)))):
        body = people.rows(mean + np.linalg.cholesky(covariance) @ z)[:n]
        found = measure(body, tapes, tapes.axes, only=words).values
        values.append([found.get(word, np.nan) for word in words])
        impossible += k < crossed and bool((crossing(body, faces) | turned_over(body, rest, faces)).any())
    ours = np.array(values)
    at = [table.names.index(name) for name in names]
    whole = np.isfinite(ours).all(axis=1)
    off = np.abs(np.corrcoef(ours[whole].T) - table.correlation[np.ix_(at, at)])[np.triu_indices(len(at), 1)]
    quantiles = [[float(np.interp(share, table.shares, table.quantiles[i])) for share in SHARES] for i in at]
    bmi = ours[:, names.index("weight")] / ours[:, names.index("stature")]**2
    return {"measures": {name: {
        "mean": float(np.nanmean(x)), "survey_mean": float(table.mean[i]), "sd": float(np.nanstd(x)),
        "survey_sd": float(table.sd[i]), "quantiles": np.nanquantile(x, SHARES).tolist(), "survey_quantiles": q,
        "not_measured": int(np.isnan(x).sum())} for name, x, i, q in zip(names, ours.T, at, quantiles, strict=True)},
        "correlation_off_mean": float(off.mean()), "correlation_off_max": float(off.max()),
        "bmi": [float(np.nanmean(bmi)), float(np.nanstd(bmi))], "drawn": count, "impossible": impossible,
        "looked_at": min(count, crossed)}


def made_anew(folder: Path, sex: Sex) -> dict[str, float]:
    """Mean absolute difference of measures, metres and kilograms, of bodies made from three measures of real people."""
    model, table = load_built_in_model(), survey(sex)
    tapes = find_tapes(model.template, model.info["landmarks"])
    names = [name for name in table.names if name not in ("age", "knee_height")]
    off = []
    for row in survey_rows(folder, sex)[1::40]:
        real = dict(zip(table.names, row, strict=True))
        body = body_with_measurements(model, tapes, {name: real[name] for name in GIVEN}, sex)
        found = measure(model.template.with_vertices(body.vertices), tapes).values
        off.append([found[name if name in found else f"{name}_left"] - real[name] for name in names])
    return dict(zip(names, np.abs(off).mean(axis=0).tolist(), strict=True)) | {"people": len(off)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--drawn", type=int, default=2500)
    parser.add_argument("--crossed", type=int, default=500)
    parser.add_argument("--rows", type=Path)
    args = parser.parse_args()
    report: dict[str, object] = {"machine": machine()}
    for sex in SEXES:
        found = drawn(sex, args.drawn, args.crossed)
        report[sex] = found | ({"made_anew": made_anew(args.rows, sex)} if args.rows else {})
        print(sex, json.dumps(report[sex]), flush=True)
    write_report(args.output, report)


if __name__ == "__main__":
    main()
