"""Learning from 71 poses and 182 people: time, memory, SPRING-182/45, and the speed of the fast path.

    SCAPEKIT_DATA=... python tests/benchmarks/learning.py -o learning.json

The yardstick for held-out people is plain vertex PCA: 10.0 mm at 20 components, 7.4 at 40.
"""
from __future__ import annotations

import argparse
import dataclasses
import resource
import time

import numpy as np
from protocols import load_real, machine, spring_split, write_report

from model.fitting import FitConfig, ShapeFitter
from model.learning import LearnConfig, learn_scape
from model.scape import ScapeModel
from scanprep.skeleton.find import find_skeleton


def fast_path(model: ScapeModel, batch: int = 256) -> dict:
    """Meshes a second of a subject, its agreement with the sparse solve, and the time of both for one pose."""
    rng = np.random.default_rng(0)
    poses = rng.normal(0, 0.3, (batch, len(model.skeleton.parents), 3))
    exact = model.vertices(poses[:4])
    result = {"solve_ms": 1e3 * _best(lambda: model.vertices(poses[0])),
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


def main() -> None:
    """Learn, fit the held-out people, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", default="learning.json")
    parser.add_argument("--held", type=int, default=45, help="how many of the held-out people to fit")
    args = parser.parse_args()
    data = load_real()
    train, held = spring_split(len(data.shapes))
    config = LearnConfig()
    start, wall = time.process_time(), time.perf_counter()
    skeleton = find_skeleton(data.template, data.poses)
    found, found_cpu = time.perf_counter() - wall, time.process_time() - start
    model = learn_scape(data.template, data.poses, data.shapes[train], skeleton, config)
    report = {"protocol": "SPRING-182/45", "config": dataclasses.asdict(config), "machine": machine(),
              "skeleton_s": found, "skeleton_cpu_s": found_cpu, "learn_s": time.perf_counter() - wall - found,
              "learn_cpu_s": time.process_time() - start - found_cpu,
              "peak_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
              "explained": model.shape_space.explained[[9, 19, 39]].tolist(), "fast_path": fast_path(model),
              "held": min(args.held, len(held))}
    for count in (20, 40):
        begin = time.perf_counter()
        fitter = ShapeFitter(model, FitConfig(n_betas=count))
        fits = [fitter.fit(body) for body in data.shapes[held[:args.held]]]
        errors = 1e3 * np.array([fit.mean for fit in fits])
        report[f"held_out_{count}_mm"] = errors.mean()
        report[f"held_out_{count}_worst_mm"] = errors.max()
        report[f"fit_{count}_s"] = (time.perf_counter() - begin) / len(fits)
    for name, value in report.items():
        print(f"{name:24s} {value}")
    write_report(args.output, report)


if __name__ == "__main__":
    main()
