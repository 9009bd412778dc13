"""SCAPE-5fold for linear blend skinning, without correctives, with linear and with quadratic ones.

    SCAPEKIT_DATA=... python tests/benchmarks/skinning_5fold.py -o skinning_5fold.json --skeletons FOLDER

Skeleton and model of every fold come from its training poses alone; `skeleton{fold}.json` in the folder are
taken where they are there.
"""
from __future__ import annotations

import argparse
import dataclasses
import time
from pathlib import Path

import numpy as np
from protocols import load_real, machine, scape_fold, write_report

from model.fitting import PoseFitter
from model.learning.skin import SkinConfig, learn_skinning
from scanprep.skeleton.find import find_skeleton
from scanprep.skeleton.tree import Skeleton


def run(fold: int, kinds: list[str], skeletons: Path | None) -> list[dict]:
    """The figures of one fold, one entry a kind of correctives."""
    data = load_real()
    train, held = scape_fold(fold, len(data.poses))
    stored = skeletons / f"skeleton{fold}.json" if skeletons else None
    skeleton = Skeleton.load(stored) if stored and stored.exists() else find_skeleton(data.template, data.poses[train])
    rows = []
    for kind in kinds:
        start = time.process_time()
        model = learn_skinning(data.template, data.poses[train], None, skeleton, SkinConfig(correctives=kind))
        learned = time.process_time()
        fitter = PoseFitter(model.subject())
        errors = np.array([1e3 * fitter.fit(body).mean for body in data.poses[held]])
        fitted = time.process_time()
        rows.append({"fold": fold, "correctives": kind, "parts": len(skeleton.parents), "held": held.tolist(),
                     "error_mm": errors.round(2).tolist(), "learn_cpu_s": learned - start,
                     "fit_cpu_s_per_pose": (fitted - learned) / len(held), **model.info})
        print(f"fold {fold}, {kind}: {errors.mean():.2f} mm, worst pose {held[errors.argmax()]} {errors.max():.1f} mm, "
              f"{model.info['terms']} terms, learned in {learned - start:.0f} s of one core", flush=True)
    return rows


def main() -> None:
    """Run the folds and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", default="skinning_5fold.json")
    parser.add_argument("--folds", type=int, nargs="*", default=range(5))
    parser.add_argument("--correctives", nargs="*", default=["none", "linear", "quadratic"])
    parser.add_argument("--skeletons", type=Path)
    args = parser.parse_args()
    rows = [row for fold in args.folds for row in run(fold, args.correctives, args.skeletons)]
    means = {}
    for kind in args.correctives:
        error = np.concatenate([row["error_mm"] for row in rows if row["correctives"] == kind])
        means[kind] = {"mean_mm": error.mean(), "worst_mm": error.max()}
        print(f"{kind}: {error.mean():.2f} mm over {len(error)} poses, worst {error.max():.1f} mm")
    write_report(args.output, {"protocol": "SCAPE-5fold", "config": dataclasses.asdict(SkinConfig()),
                               "machine": machine(), "rows": rows, "means": means})


if __name__ == "__main__":
    main()
