"""Write BENCHMARKS.md from the JSON that the benchmarks wrote.

    python tests/benchmarks/summary.py tests/benchmarks/results

Every benchmark has its own section: the command, the machine, accuracy beside time, what it is compared with.
"""
from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from summary_completion import COMPLETION
from summary_mocap import MOCAP
from summary_scans import (
    Rows,
    coregistration,
    correspondences,
    decimated_set,
    decimation,
    fronts,
    holes,
    merging,
    peers,
    predicted_landmarks,
    registration,
    rolled_limbs,
    signatures,
    skeletons,
    table,
)
from summary_statues import STATUES

HERE = Path(__file__).parent


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
    rows += [("all of it (s)", report["learn_s"]), ("largest memory (GiB)", report["peak_gib"])]
    rows += [(name, report[key]) for name, key in (("model file, 80 components (MiB)", "file_mib"),
                                                   ("loading it (s)", "load_s"),
                                                   ("memory of the loaded model (MiB)", "loaded_mib")) if key in report]
    rows += [(f"fast path: {name}", value) for name, value in flat(report["fast_path"])]
    people = [tuple(row[n] for n in ("components", "people", "mean_mm", "worst_person_mm", "pose_held_mm",
                                     "vertex_pca_mm", "fit_s")) for row in report["people"]]
    return table(("", ""), rows) + "\n\n" + table(
        ("components", "held-out people", "mean error (mm)", "worst person (mm)", "pose held (mm)",
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


def generic(report: dict) -> str:
    """All rows of a report as they are."""
    rows = report["rows"]
    names = tuple(rows[0])
    return table(names, [tuple(r[n] for n in names) for r in rows])


SECTIONS: dict[str, tuple[str, str, Callable[[dict], str], str]] = {
    "scape_5fold": ("Held-out poses (SCAPE-5fold)", "python tests/benchmarks/scape_5fold.py", poses,
                    "Skeleton and model from the training poses of the fold alone, with an earlier search for parts. "
                    "With today's (20 parts) fold 0 has 6.02 mm with SCAPE and 6.44 with skinning and linear "
                    "correctives. Seen on held-out poses while "
                    "deciding: `refinements` and `steps` on fold 0 and on coarse copies of folds 0 and 1; the width of "
                    "blending on fold 1; that more parts help at all, and the radial features, on folds 1 and 3, after "
                    "which the number of parts of each fold was left to its training poses. A pose fit has three "
                    "numbers a part, so some of the gain of more parts is freedom of the fit. The folds ran beside "
                    "each other and other work on two cores: read the times as upper bounds. Where we lose: deep "
                    "squats and seated poses, and some folds to skinning with correctives."),
    "regressors": ("Regressors of the pose deformation", "python tests/benchmarks/regressors.py", regressors,
                   "On copies of about 2,500 vertices. `left out` is what leaving training poses out predicts, without "
                   "fitting them again."),
    "learning": ("Learning from 71 poses and 182 people (SPRING-182/45)", "python tests/benchmarks/learning.py",
                 learning, "Vertex PCA has no pose to adjust. With the pose held, only betas and place are "
                 "fitted. Learning ran beside other work on two cores: its wall times are upper bounds. With "
                 "nothing else running and the same skeleton given, `learn_scape` took 202 s: 81 for the pose space, "
                 "119 for the people, 1 for the components. The memory of the loaded model was measured afterwards on "
                 "the same file."),
    "mixed": ("Learning from a random mix of synthetic people", "python tests/benchmarks/mixed.py", mixed,
              "30 people in 3 poses each against one person in many poses and others in one, as many meshes, at 2,000 "
              "triangles with the true skeleton. Merged from one run of seed 1 and one of seeds 2 and 3; settings "
              "were tuned on other seeds. Where we lose: time, and the worst person of seed 1."),
    "registration_10": ("Registration, ten landmarks", "python tests/benchmarks/registration.py --set held --marks 10",
                        registration, "Virtual four-view scans, template mesh000, held-out poses and men. Where we "
                        "lose: sharply bent limbs, whose skin slides; the surface is right long before the "
                        "correspondence is. The elastic energy itself ends some 10 mm from the truth even when it "
                        "begins there. Wall times beside other work. Limbs rolled otherwise were measured on the "
                        "scans with a doubt (poses 7, 32, 37, 67): pose 37 had 14.0 mm before, the others stay; rows"
                        " without a doubt are of before, as nothing changed for them (pose 2 again: the same). Tried"
                        " for the place along the skin: links between nodes anywhere in the same part of the body "
                        "that rotate and grow alike, as stiff as those between neighbours: tuning poses 43, 59, 63 "
                        "from 11.2 to 11.0 mm, men 44 and 88 from 16.4 to 16.3: not kept. The skin of thighs rotates"
                        " by 15.6 and 14.4 degrees (RMS) against its part in the reference, and by 14.7 and 14.8 "
                        "where we put it, so stiffer parts are no cure. Of the 14.6 mm of six tuning men 12.9 are "
                        "the same displacement on all six (left thigh 21 mm along the bone, right thigh 11); with "
                        "the mean of the other five taken off, 8.7 remain."),
    "registration_published": ("The registration that SCAPE used, ten landmarks",
                               "python tests/benchmarks/registration.py --set held --marks 10 --poses 22,2,32 --men 2 "
                               "--published", registration, "Rigid links between neighbours, matches point to point "
                               "[Hahnel]; beside `registration_10`: 8.23, 6.29, 7.46 and 13.4 mm. Times beside other "
                               "work."),
    "registration_4": ("Registration, four landmarks", "python tests/benchmarks/registration.py --set held --marks 4",
                       registration, "Hands and toes. Correspondences from the four landmarks, beside them, lead the "
                       "deep squat of pose 7 to 110 mm: not kept. Other rolls of limbs were tried on poses 32, 52 "
                       "and 67, and none was better."),
    "registration_0": ("Registration without landmarks", "python tests/benchmarks/registration.py --set held --marks 0",
                       registration, "Led by `register_unmarked`, as `scape prep run` does without landmark files; the "
                       "time includes it. Scans that were not all covered were registered again with the ends of "
                       "their limbs as landmarks (pose 52: 35.7 mm before). On tuning poses: pose 24 from 32.3 to "
                       "13.7 mm, pose 69 from 39.5 to 15.2; with ends of the body judged by their own bending pose "
                       "24 has 10.6, pose 48 what it had. Tried there: an end is taken where scan and strain alone are "
                       "less, which a rolled head and hand won by a hair; heads tilted, not only rolled, found "
                       "nothing more on poses 24 and 48. Limbs rolled otherwise, measured on poses 32, 37, 52 and 67 "
                       "as above: pose 52 had 11.6 mm and a doubted forearm before; nothing was better on the others, "
                       "the slid hands of pose 37 among them. Pose 7 means nothing and is not tried."),
    "rolled_limbs": ("Limbs rolled on purpose", "python tests/benchmarks/rolled_limbs.py --set held", rolled_limbs,
                     "Skin of a limb rolled about its bone on the true surface of a held-out pose. Counted is a "
                     "doubt that the pose itself did not raise. Where we lose: half a right angle. Figures of before"
                     " (210 of 210, 57 of 70) moved skin of the parts that a limb hangs on instead of those that "
                     "hang on it."),
    "registration_front": ("Registration, one view from the front",
                           "python tests/benchmarks/registration.py --set held --marks 10 --front", registration,
                           "Ten landmarks, of which some lie where there are no data."),
    "predicted_landmarks": ("Landmarks predicted after four clicks",
                            "python tests/benchmarks/predicted_landmarks.py", predicted_landmarks,
                            "What `scape pick` offers when hands and toes were clicked, without error, on a virtual "
                            "scan; the template is mesh000. Beside other work. PREDICTED_NOTE"),
    "fronts": ("The front of a body in pictures", "python tests/benchmarks/fronts.py", fronts,
               "Against the direction square to hips, shoulders and waist. Where we lose: bodies that sit, squat or "
               "kneel, whose feet are not below them."),
    "signatures": ("Where the skin belongs", "python tests/benchmarks/signatures.py", signatures,
                   "Mean curvature of the template and of the true posed surface at the places of its vertices; the "
                   "poses are those for tuning. Ours lie some 10 mm from the reference, and by this measure nearer to "
                   "where they belong: it cannot tell which is right to a few millimetres, nor can it say that ours "
                   "is."),
    "peers": ("Other registration tools on the same scans",
              "python tests/benchmarks/peers.py --bcpd PROGRAM", peers,
              "Four poses and one man, beside other work (times are upper bounds); pose 22 in a run before the others. "
              "What each tool was given stands in the head of the script. Coherent point drift takes no "
              "landmarks and begins from the template placed by them. Its parameters and those of functional maps were "
              "tried on one other scan, a handful each: their authors may do better. Where we lose: time, to "
              "accelerated drift."),
    "correspondences_7": ("Correlated correspondence, seven seeds",
                          "python tests/benchmarks/correspondences.py --set held --seeds 7", correspondences,
                          "Distances along the true body. Where we lose: pose 7, a deep squat, and single front views "
                          "(medians of 19 to 45 mm on four tuning poses). The figures are "
                          "of the 170 points out of 240 with the least strain; the others are worse."),
    "correspondences_0": ("Correlated correspondence without seeds",
                          "python tests/benchmarks/correspondences.py --set held --seeds 0 --first 3", correspondences,
                          "In pose 7, where hands and feet are not the farthest ends, body and scan are matched upside "
                          "down."),
    "coregistration": ("Co-registration", "python tests/benchmarks/coregistration.py --held --landmarks 7 --rounds 2 "
                       "--clickless 10", coregistration, "Virtual scans of 20 poses of one man, ten of them held "
                       "out from all tuning, on copies of 5,000 triangles. Skeleton and model come from the "
                       "registrations of all 20 alone, so the ten of the last row have taught the model that finds "
                       "them again. `failed`: more than 25 mm off on average."),
    "skeleton": ("Skeletons", "python tests/benchmarks/skeleton.py", skeletons,
                 "Real poses have no truth: agreement is the adjusted Rand index of triangles. What a part must be "
                 "worth was chosen on these poses, their five seeds and one synthetic person. py-dem-bones is told the "
                 "number of parts and finds no joints. Where we lose: to it in time."),
    "decimation": ("Decimation of 400,000 triangles to 50,000", "python tests/benchmarks/decimation.py", decimation,
                   "A body subdivided twice, with relief. Where we lose: fast-simplification and pyfqmr are several "
                   "times quicker; at 2,000 triangles the former leaves holes. Beside other work on two cores."),
    "decimated_set": ("Decimation of a registered set", "python tests/benchmarks/decimation.py", decimated_set,
                      "Learned on every second pose, measured on the others and on men. `slide`: how far a vertex "
                      "moves along the skin, carried back to the template. The anchor of `solved` was chosen on some "
                      "of the poses that it is measured on."),
    "merging": ("Merging four views", "python tests/benchmarks/cleaning.py --held --merge 2 --holes 0", merging,
                "Virtual views with 2 mm noise of two held-out poses and two held-out men. `trusted`: share of bodies "
                "whose alignment says of every view that it can be relied on; the others are not merged."),
    "holes": ("Six holes of a body", "python tests/benchmarks/cleaning.py --held --merge 0 --holes 2", holes,
              "Crown, armpits, crotch and soles of real and synthetic bodies; one of the seven, pose000, was tuned on. "
              "The second size was added after the first had been seen. `auto` is `fair` where no lines of sight "
              "are known. Where we lose: armpits (up to 22 mm from patch to truth); Poisson columns of the patch are "
              "missing as it remeshes everything."),
    **COMPLETION,
    **MOCAP,
    **STATUES,
}

BESIDE = {"half_people": "half_people_poisson"}      # a run with another library, in the same table


def main() -> None:
    """Collect and write."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else HERE / "results"
    parts = ["# Benchmarks\n\nGenerated by `python tests/benchmarks/summary.py` from the JSON files in `results`. "
             "Run by hand on real scans that cannot be shipped; errors are mean vertex distances unless said "
             "otherwise.\n"]
    for name, (title, command, section, note) in SECTIONS.items():
        path = folder / f"{name}.json"
        if not path.exists():
            continue
        report = json.loads(path.read_text())
        if name in BESIDE:
            report["beside"] = json.loads((folder / f"{BESIDE[name]}.json").read_text())
        machine = report.get("machine") or report.get("versions") or {}
        facts = ", ".join(f"{key} {value}" for key, value in machine.items())
        parts.append(f"\n## {title}\n\n`{command}` on {facts}.\n\n{section(report)}\n\n{note}\n")
    (HERE / "BENCHMARKS.md").write_text("".join(parts))


if __name__ == "__main__":
    main()
