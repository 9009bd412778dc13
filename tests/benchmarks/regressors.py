"""Regressors of Q on held-out poses, on a coarse copy of the bodies: five folds, two skeletons.

    SCAPEKIT_DATA=... python tests/benchmarks/regressors.py --skeletons FOLDER -o regressors.json

Skeletons are those that `scape_5fold.py` keeps beside its output (`*.chosen0.json`, `*.rigid0.json`, ...). Errors on
2,500 vertices are within 0.3 mm of those on all.
"""
from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from protocols import load_real, machine, scape_fold, write_report

from model import LearnConfig
from model.blending import BlendedTemplate, rigid_weights
from model.fitting.vertices import PoseFitter
from model.learning.parts import coarse_copy, coarse_skeleton
from model.learning.scape import ProgressShares, learn_pose
from scanprep.skeleton.tree import Skeleton

SETTINGS = {
    "linear": LearnConfig(),
    "quadratic": LearnConfig(features="quadratic"),
    "support vectors": LearnConfig(regressor="svr"),
    "linear, no refinement": LearnConfig(refinements=0),
    "linear, as published": LearnConfig.from_paper(),
}


def run(config: LearnConfig, parts: BlendedTemplate, training: np.ndarray, held: np.ndarray) -> dict:
    """Mean error in millimetres on held-out poses, and what it took."""
    start = time.process_time()
    learned = learn_pose(parts, training, config, ProgressShares(None))
    seconds = time.process_time() - start
    fitter = PoseFitter(parts.subject(learned.space))
    errors = [1e3 * fitter.fit(body).mean for body in held]
    return {"error_mm": float(np.mean(errors)), "worst_mm": float(max(errors)),
            "features": learned.space.features.count, "left_out_mm": 1e3 * learned.design.left_out_error,
            "pruning": learned.design.pruning, "ridge": learned.design.ridge, "learn_cpu_s": seconds}


def main() -> None:
    """Run all settings on all folds and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("regressors.json"))
    parser.add_argument("--skeletons", type=Path, required=True)
    parser.add_argument("--folds", type=int, nargs="*", default=range(5))
    parser.add_argument("--vertices", type=int, default=2500)
    args = parser.parse_args()
    data = load_real()
    vertices, coarse = coarse_copy(data.template, args.vertices)
    rows = []
    for path in sorted(args.skeletons.glob("*.json")):
        finder, fold = path.stem.split(".")[-1][:-1], path.stem[-1]
        if finder not in ("chosen", "rigid") or int(fold) not in args.folds:
            continue
        train, held = scape_fold(int(fold), len(data.poses))
        skeleton = coarse_skeleton(Skeleton.load(path), data.template, coarse)
        parts = BlendedTemplate(coarse, skeleton, rigid_weights(skeleton))
        for name, config in SETTINGS.items():
            bodies = data.poses[:, vertices]
            row = {"fold": int(fold), "skeleton": finder, "parts": len(skeleton.parents), "setting": name,
                   **run(config, parts, bodies[train], bodies[held])}
            rows.append(row)
            print(row, flush=True)
            write_report(args.output, {"protocol": f"SCAPE-5fold on {len(vertices)} vertices", "machine": machine(),
                                       "rows": rows})


if __name__ == "__main__":
    main()
