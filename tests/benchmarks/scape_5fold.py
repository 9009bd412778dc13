"""SCAPE-5fold: error on held-out poses of the real man, beside the time it takes.

    SCAPEKIT_DATA=... python tests/benchmarks/scape_5fold.py -o scape_5fold.json

Skeleton and model of every fold come from its training poses alone. Rigid parts with the same skeleton
(Q = I) are the baseline.
"""
from __future__ import annotations

import argparse
import dataclasses
import time

import numpy as np
from protocols import load_real, machine, scape_fold, write_report

from model.fitting import PoseFitter
from model.learning import LearnConfig, learn_scape
from model.pose_space import PoseSpace
from model.scape import ScapeModel
from scanprep.skeleton.find import find_skeleton


def held_out_errors(model: ScapeModel, bodies: np.ndarray) -> np.ndarray:
    """Mean vertex distance in millimetres of every body, after fitting pose and place."""
    fitter = PoseFitter(model.subject())
    return np.array([1e3 * fitter.fit(body).mean for body in bodies])


def run_fold(fold: int, config: LearnConfig) -> dict:
    """Everything about one fold."""
    data = load_real()
    train, held = scape_fold(fold, len(data.poses))
    clock = [time.perf_counter()]
    skeleton = find_skeleton(data.template, data.poses[train])
    clock.append(time.perf_counter())
    model = learn_scape(data.template, data.poses[train], None, skeleton, config)
    clock.append(time.perf_counter())
    errors = held_out_errors(model, data.poses[held])
    clock.append(time.perf_counter())
    rigid = held_out_errors(dataclasses.replace(model, pose_space=PoseSpace.identity(skeleton)), data.poses[held])
    seconds = np.diff(clock)
    return {"fold": fold, "parts": len(skeleton.parents), "ridge": model.info["ridge"],
            "features": model.info["features"], "held": held.tolist(), "error_mm": errors.round(2).tolist(),
            "rigid_mm": rigid.round(2).tolist(), "skeleton_s": seconds[0], "learn_s": seconds[1],
            "fit_s_per_pose": seconds[2] / len(held)}


def main() -> None:
    """Run the folds and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", default="scape_5fold.json")
    parser.add_argument("--folds", type=int, nargs="*", default=range(5))
    args = parser.parse_args()
    config = LearnConfig()
    folds = []
    for fold in args.folds:
        folds.append(run_fold(fold, config))
        f = folds[-1]
        print(f"fold {fold}: {f['parts']} parts, SCAPE {np.mean(f['error_mm']):.2f} mm "
              f"(worst {max(f['error_mm']):.1f}), rigid {np.mean(f['rigid_mm']):.2f} mm, "
              f"learned in {f['learn_s']:.0f} s, {f['fit_s_per_pose']:.2f} s a fit", flush=True)
    error, rigid = (np.concatenate([f[key] for f in folds]) for key in ("error_mm", "rigid_mm"))
    print(f"held-out vertex error, mean over {len(error)} poses: SCAPE {error.mean():.2f} mm, "
          f"worst pose {error.max():.1f} mm; rigid parts {rigid.mean():.2f} mm")
    write_report(args.output, {
        "protocol": "SCAPE-5fold", "config": dataclasses.asdict(config), "machine": machine(), "folds": folds,
        "mean_mm": error.mean(), "worst_mm": error.max(), "rigid_mean_mm": rigid.mean()})


if __name__ == "__main__":
    main()
