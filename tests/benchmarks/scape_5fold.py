"""SCAPE-5fold: error on held-out poses of the real man, for every kind of model and regressor, beside the time.

    SCAPEKIT_DATA=... python tests/benchmarks/scape_5fold.py -o scape_5fold.json [--keep FOLD_0.npz]

Skeleton and model of every fold come from its training poses alone; all kinds share the fold's skeleton, which is
the one that `scape learn` finds (`--skeleton chosen`) or that of the search for rigid parts alone (`rigid`). Done folds
and kinds are kept in the output and not run again, so that the script can be stopped and started.
"""
from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from protocols import load_real, machine, scape_fold, write_report

from model import BodyModel, LearnConfig, SkinConfig, learn_blendscape, learn_scape, learn_skinning
from model.fitting.vertices import PoseFitter
from model.learning.parts import choose_skeleton
from model.pose_space import PoseSpace
from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.find import find_skeleton
from scanprep.skeleton.tree import Skeleton

Learn = Callable[[Mesh, np.ndarray, Skeleton], BodyModel]


def scape(**settings: object) -> Learn:
    """Learning with some settings that differ from the defaults."""
    config = replace(LearnConfig(), **settings)
    return lambda template, poses, skeleton: learn_scape(template, poses, None, skeleton, config)


def rigid(template: Mesh, poses: np.ndarray, skeleton: Skeleton) -> BodyModel:
    """Parts that only turn, Q = I."""
    model = learn_scape(template, poses, None, skeleton, replace(LearnConfig(), refinements=0))
    return replace(model, pose_space=PoseSpace.identity(skeleton))


def published(template: Mesh, poses: np.ndarray, skeleton: Skeleton, pruning: float | None = None) -> BodyModel:
    """Learning as the paper has it; its 0.1 read as a standard deviation, or as a variance in square radians."""
    config = LearnConfig.from_paper()
    config = config if pruning is None else replace(config, prunings=(pruning,))
    return learn_scape(template, poses, None, skeleton, config)


def skinning(correctives: bool) -> Learn:
    """Linear blend skinning, with or without pose-corrective shapes."""
    config = SkinConfig(correctives=correctives)
    return lambda template, poses, skeleton: learn_skinning(template, poses, None, skeleton, config)


KINDS: dict[str, Learn] = {
    "rigid parts": rigid,
    "LBS": skinning(False),
    "LBS + linear correctives": skinning(True),
    "SCAPE, published": published,
    "SCAPE, published, 0.1 square radians": partial(published, pruning=0.1),
    "SCAPE, linear": scape(),
    "SCAPE, quadratic": scape(features="quadratic"),
    "SCAPE, support vectors": scape(regressor="svr"),
    "BlendSCAPE": lambda template, poses, skeleton: learn_blendscape(template, poses, None, skeleton),
}


def run(learn: Learn, template: Mesh, training: np.ndarray, held: np.ndarray, skeleton: Skeleton,
        keep: Path | None) -> dict:
    """Error of every held-out body in millimetres after fitting pose and place, and what it took."""
    start = time.perf_counter()
    model = learn(template, training, skeleton)
    learned = time.perf_counter()
    if keep:
        model.save(keep)
    fitter = PoseFitter(model.subject())
    errors = [1e3 * fitter.fit(body).mean for body in held]
    return {"error_mm": np.round(errors, 2).tolist(), "features": model.features.count,
            "terms": model.terms.count if hasattr(model, "terms") else model.features.count, "learn_s": learned - start,
            "fit_s_per_pose": (time.perf_counter() - learned) / len(held),
            "chosen": {k: v for k, v in model.info.items() if isinstance(v, float | int | str) and k != "digest"}}


def main() -> None:
    """Run the folds and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("scape_5fold.json"))
    parser.add_argument("--folds", type=int, nargs="*", default=range(5))
    parser.add_argument("--kinds", nargs="*", default=list(KINDS), choices=list(KINDS))
    parser.add_argument("--keep", type=Path, help="where to keep the model of fold 0 that is SCAPE, linear")
    parser.add_argument("--skeleton", choices=["chosen", "rigid"], default="chosen")
    args = parser.parse_args()
    data = load_real()
    report = json.loads(args.output.read_text()) if args.output.exists() else {"folds": {}}
    for fold in args.folds:
        train, held = scape_fold(fold, len(data.poses))
        kept = args.output.with_suffix(f".{args.skeleton}{fold}.json")
        done = report["folds"].setdefault(f"{args.skeleton} {fold}", {"held": held.tolist(), "kinds": {}})
        if not kept.exists():
            start = time.perf_counter()
            if args.skeleton == "rigid":
                find_skeleton(data.template, data.poses[train]).save(kept)
            else:
                found = choose_skeleton(data.template, data.poses[train])
                found.skeleton.save(kept)
                done["left_out_mm_by_parts"] = {str(n): 1e3 * error for n, error in found.errors.items()}
            done["skeleton_s"] = time.perf_counter() - start
        skeleton = Skeleton.load(kept)
        done["parts"] = len(skeleton.parents)
        for kind in args.kinds:
            if kind not in done["kinds"]:
                keep = args.keep if (fold, kind) == (0, "SCAPE, linear") else None
                done["kinds"][kind] = run(KINDS[kind], data.template, data.poses[train], data.poses[held], skeleton,
                                          keep)
                report.update(protocol="SCAPE-5fold", machine=machine())
                write_report(args.output, report)
            result = done["kinds"][kind]
            print(f"fold {fold}, {len(skeleton.parents)} parts, {kind}: {np.mean(result['error_mm']):.2f} mm "
                  f"(worst {max(result['error_mm']):.1f}), {result['terms']} terms, learned in "
                  f"{result['learn_s']:.0f} s, {result['fit_s_per_pose']:.2f} s a fit", flush=True)


if __name__ == "__main__":
    main()
