"""Learning from 71 poses and 182 people: time and memory of each step, SPRING-182/45, the speed of the fast path.

    SCAPEKIT_DATA=... python tests/benchmarks/learning.py -o learning.json

The yardstick for held-out people is plain vertex PCA, measured on the same people. Errors with the pose held at the
parts' own best (Procrustes) rotations are given for information.
"""
from __future__ import annotations

import argparse
import dataclasses
import logging
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from protocols import load_real, machine, spring_split, write_report

from model import BodyModel, LearnConfig, learn_blendscape, learn_scape, load_model
from model.evaluation.errors import shape_errors
from model.learning.parts import choose_skeleton


class Steps(logging.Handler):
    """Seconds of every step that the library logs."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self.seconds: dict[str, float] = {}

    def emit(self, record: logging.LogRecord) -> None:
        step, seconds = record.args                                           # type: ignore[misc]
        self.seconds[str(step)] = float(seconds)                              # type: ignore[arg-type]


def fast_path(model: BodyModel, batch: int = 256) -> dict:
    """Meshes a second of a subject, its agreement with the sparse solve, and the time of both for one pose."""
    rng = np.random.default_rng(0)
    poses = rng.normal(0, 0.3, (batch, len(model.skeleton.parents), 3))
    exact = model.vertices(poses[:4])
    result = {"features": model.n_features, "terms": model.terms.count if hasattr(model, "terms") else model.n_features,
              "solve_ms": 1e3 * _best(lambda: model.vertices(poses[0])),
              "build_s": _best(lambda: model.subject(), 3)}
    for dtype in (np.float64, np.float32):
        subject = model.subject(dtype=dtype)
        name = np.dtype(dtype).name
        result[f"{name}_meshes_per_s"] = batch / _best(lambda s=subject: s.vertices(poses))
        result[f"{name}_one_pose_ms"] = 1e3 * _best(lambda s=subject: s.vertices(poses[0]))
        result[f"{name}_disagreement_m"] = float(np.abs(subject.vertices(poses[:4]) - exact).max())
    return result


def _best(call, repeats: int = 7) -> float:
    """The shortest time of several calls, in seconds."""
    times = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return min(times[1:])


def loaded_mib(path: Path) -> float:
    """Memory that loading a model takes, in a process of its own."""
    code = ("import os, sys, model.scape, model.files; "
            "held = lambda: int(open('/proc/self/statm').read().split()[1]) * os.sysconf('SC_PAGE_SIZE') / 2**20; "
            "before = held(); kept = model.files.load_model(sys.argv[1]); print(held() - before)")
    return float(subprocess.run([sys.executable, "-c", code, str(path)], check=True, capture_output=True).stdout)


def held_out_people(model: BodyModel, people: np.ndarray, train: np.ndarray, counts: list[int]) -> list[dict]:
    """Errors in millimetres for every number of components, beside plain vertex PCA."""
    start = time.perf_counter()
    found = shape_errors(model, people, counts, train)
    seconds = (time.perf_counter() - start) / (len(people) * len(counts))
    assert found.vertex_pca is not None
    return [{"components": int(n), "people": len(people), "mean_mm": 1e3 * free.overall,
             "worst_person_mm": 1e3 * float(free.mean.max()), "pose_held_mm": 1e3 * held.overall,
             "vertex_pca_mm": 1e3 * pca.overall, "fit_s": seconds}
            for n, free, held, pca in zip(found.counts, found.errors, found.pose_held, found.vertex_pca, strict=True)]


def main() -> None:
    """Learn, fit the held-out people, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("learning.json"))
    parser.add_argument("--kind", choices=["scape", "blendscape"], default="scape")
    parser.add_argument("--held", type=int, default=45, help="how many of the held-out people to fit")
    parser.add_argument("--keep", type=Path, help="where to keep the model")
    args = parser.parse_args()
    data = load_real()
    train, held = spring_split(len(data.shapes))
    config = LearnConfig(components=80)
    report = {"protocol": "SPRING-182/45", "kind": args.kind, "config": dataclasses.asdict(config),
              "machine": machine()}
    steps, start, cpu = Steps(), time.perf_counter(), time.process_time()
    logging.getLogger("model").addHandler(steps)
    logging.getLogger("model").setLevel(logging.INFO)
    skeleton = choose_skeleton(data.template, data.poses).skeleton
    steps.seconds["skeleton"] = time.perf_counter() - start
    learn = learn_scape if args.kind == "scape" else learn_blendscape
    model: BodyModel = learn(data.template, data.poses, data.shapes[train], skeleton, config)   # type: ignore[operator]
    report |= {"parts": len(skeleton.parents), "steps_s": steps.seconds, "learn_s": time.perf_counter() - start,
               "learn_cpu_s": time.process_time() - cpu,
               "peak_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
               "explained": model.explained[[9, 19, 39, 79]].tolist()}
    if args.keep:
        model.save(args.keep)
        report["file_mib"] = args.keep.stat().st_size / 2**20
        begun = time.perf_counter()
        load_model(args.keep)
        report["load_s"] = time.perf_counter() - begun
        report["loaded_mib"] = loaded_mib(args.keep)
    report["fast_path"] = fast_path(model)
    write_report(args.output, report)
    report["people"] = held_out_people(model, data.shapes[held[:args.held]], data.shapes[train], [20, 40, 80])
    for name, value in report.items():
        print(f"{name:24s} {value}")
    write_report(args.output, report)


if __name__ == "__main__":
    main()
