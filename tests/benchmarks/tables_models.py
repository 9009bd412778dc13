"""Tables of BENCHMARKS.md on models: held-out poses, regressors, learning, mixes of people and poses."""
from __future__ import annotations

from typing import Any

import numpy as np
from tables_scans import Rows, table

LAYER_COLUMNS = ("layer, forward", "layer, one person", "layer, gradients", "skinned, forward", "skinned, gradients",
                 "NumPy, one person", "NumPy, one person, float64")


def poses(report: dict) -> str:
    """Held-out poses of the real man, a row for every kind of model."""
    out = []
    for finder in ("chosen", "rigid"):
        folds = {name.split()[1]: fold for name, fold in sorted(report["folds"].items()) if name.startswith(finder)}
        if not folds:
            continue
        kinds = list(dict.fromkeys(kind for fold in folds.values() for kind in fold["kinds"]))
        rows: Rows = []
        for kind in kinds:
            mine = [fold["kinds"].get(kind) for fold in folds.values()]
            done = [m for m in mine if m]
            errors = np.concatenate([m["error_mm"] for m in done])
            rows.append((kind, *(float(np.mean(m["error_mm"])) if m else "" for m in mine), float(errors.mean()),
                         float(errors.max()), float(np.mean([m["terms"] for m in done])),
                         float(np.mean([m["learn_s"] for m in done])),
                         float(np.mean([m["fit_s_per_pose"] for m in done]))))
        parts = ", ".join(str(fold["parts"]) for fold in folds.values())
        lead = "As many parts as predict left-out poses" if finder == "chosen" else "The search for rigid parts alone"
        out.append(f"{lead} ({parts} parts):\n\n" + table(
            ("mean error (mm)", *(f"fold {name}" for name in folds), "all", "worst pose", "terms", "learning (s)",
             "fit (s a pose)"), rows))
    return "\n\n".join(out)


def regressors(report: dict) -> str:
    """Settings of the regression, averaged over the folds."""
    rows: Rows = []
    for finder in ("chosen", "rigid"):
        for setting in dict.fromkeys(r["setting"] for r in report["rows"]):
            mine = [r for r in report["rows"] if r["setting"] == setting and r["skeleton"] == finder]
            if mine:
                rows.append((finder, setting, len(mine),
                             *(float(np.mean([r[n] for r in mine])) for n in ("error_mm", "left_out_mm", "features")),
                             float(max(r["worst_mm"] for r in mine)), float(np.mean([r["learn_cpu_s"] for r in mine]))))
    return table(("skeleton", "regression", "folds", "held out (mm)", "left out, training (mm)", "features",
                  "worst pose (mm)", "learning (s CPU)"), rows)


def learning(report: dict) -> str:
    """Learning, held-out people and the fast path."""
    rows: Rows = [(f"time: {step} (s)", value) for step, value in report["steps_s"].items()]
    rows += [(f"processor: {step} (s)", value) for step, value in report.get("steps_cpu_s", {}).items()]
    rows += [("all of it (s)", report["learn_s"]), ("all of it, processor (s)", report["learn_cpu_s"]),
             ("largest memory, all processes (GiB)", report["peak_gib"])]
    if "command" in report:
        rows += [(f"scape learn: {name}", value) for name, value in flat(report["command"])]
    rows += [(name, report[key]) for name, key in (("model file, 80 components (MiB)", "file_mib"),
                                                   ("loading it (s)", "load_s"),
                                                   ("memory of the loaded model (MiB)", "loaded_mib")) if key in report]
    rows += [(f"fast path: {name}", value) for name, value in flat(report["fast_path"])]
    people = [tuple(row[n] for n in ("components", "people", "mean_mm", "worst_person_mm",
                                     "vertex_pca_mm", "fit_s")) for row in report["people"]]
    return table(("", ""), rows) + "\n\n" + table(
        ("components", "held-out people", "mean error (mm)", "worst person (mm)",
         "plain vertex PCA (mm)", "fit (s)"), people)


def mixed(report: dict) -> str:
    """A random mix against the separated designs."""
    rows: Rows = []
    for run in report["runs"]:
        for design, r in run.items():
            if isinstance(r, dict) and "new_people" in r:
                rows.append((run["seed"], design, r["new_people"]["mean_mm"], r["new_people_20_betas"]["mean_mm"],
                             r["new_people"]["worst_mm"], r["learn_s"]))
    return table(("seed", "design", "new people in new poses (mm)", "at 20 betas (mm)", "worst (mm)", "learning (s)"),
                 rows)


def flat(value: dict, before: str = "") -> list[tuple[str, Any]]:
    """Leaves of nested dictionaries with their path."""
    out: list[tuple[str, Any]] = []
    for name, inner in value.items():
        path = f"{before}{name}"
        out += flat(inner, path + ", ") if isinstance(inner, dict) else [(path, inner)]
    return out


def population(report: dict) -> str:
    """Measures of drawn people against the survey's, a row for each; then those of people made from three measures."""
    sexes = [sex for sex in ("female", "male") if sex in report]
    rows: Rows = []
    for name in report[sexes[0]]["measures"]:
        row: list[Any] = [name.replace("_", " ")]
        for sex in sexes:
            m = report[sex]["measures"][name]
            anew = report[sex].get("made_anew", {}).get(name, np.nan)
            unit = 1 if name == "weight" else 1000
            row += [unit * m["survey_mean"], unit * (m["mean"] - m["survey_mean"]), m["sd"] / m["survey_sd"],
                    *(unit * (m["quantiles"][k] - m["survey_quantiles"][k]) for k in (0, 2)), unit * anew]
        rows.append(tuple(row))
    head = [f"{sex}: {word}" for sex in sexes for word in (
        "survey's mean", "off", "SD ratio", "5th percentile off", "95th off", "made from stature, weight, waist: off")]
    told: Rows = [(sex, report[sex]["drawn"], report[sex]["correlation_off_mean"], report[sex]["correlation_off_max"],
                   *report[sex]["bmi"], f"{report[sex]['impossible']} of {report[sex]['looked_at']}") for sex in sexes]
    return "\n\n".join((
        "Millimetres, kilograms of the weight.\n\n" + table(("measure", *head), rows),
        table(("sex", "drawn", "correlations off, mean", "at most", "BMI", "its SD", "skin crosses, or turns over"),
              told)))


def strangers(report: dict) -> str:
    """Whole scans and half views of men that no model saw, by each model."""
    rows: Rows = []
    for name in dict.fromkeys(r["model"] for r in report["rows"]):
        mine = [r for r in report["rows"] if r["model"] == name]
        rows.append((name, len(mine), *(figure for key in ("whole_mm", "unseen_mm", "seen_predicted_mm") for figure in (
            float(np.mean([r[key] for r in mine])), max(r[key] for r in mine))), max(r["largest_beta"] for r in mine),
            float(np.mean([r["cpu_seconds"] for r in mine]))))
    return table(("model", "men", "whole scan (mm)", "worst man", "half view, unseen (mm)", "worst man",
                  "half view, seen (mm)", "worst man", "largest beta", "time (s CPU)"), rows)


def body_layer(report: dict) -> str:
    """Bodies a second by batch, and how far the layer is from the exact body."""
    rows: Rows = []
    for name, found in report["models"].items():
        for batch, row in found["meshes a second"].items():
            rows.append((name, batch, *(row[key] for key in LAYER_COLUMNS)))
    for batch, row in report.get("anny", {}).items():
        if isinstance(row, dict):
            rows.append((f"anny, {row['vertices']} vertices, {row['bones']} bones", batch, row["forward"],
                         *[""] * (len(LAYER_COLUMNS) - 1)))
    errors: Rows = [(name, *(1000 * value for value in found["error, m"].values()))
                    for name, found in report["models"].items()]
    kinds = list(next(iter(report["models"].values()))["error, m"])
    return table(("bodies a second of processor time", "batch", *LAYER_COLUMNS), rows) + "\n\n" + table(
        ("largest error of a vertex (mm)", *kinds), errors)
