"""Learning from 71 poses and 182 people: time and memory of each step, SPRING-182/45, the speed of the fast path.

    SCAPEKIT_DATA=... python tests/benchmarks/learning.py -o learning.json

Learned twice: by the library, and by `scape learn`, which keeps its steps in files. Processor seconds are those of all
processes; the people's are told with the shape components, as their processes end.

The yardstick for held-out people is plain vertex PCA, measured on the same people.
"""
from __future__ import annotations

import argparse
import dataclasses
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
from protocols import RealData, data_folder, load_real, machine, spring_split, write_report

from model import BodyModel, LearnConfig, learn_blendscape, learn_scape, load_model
from model.evaluation.errors import shape_errors
from model.learning.parts import choose_skeleton


class Clock:
    """Wall and processor seconds of named steps, those of ended child processes included: a `Step` for the library."""

    def __init__(self) -> None:
        self.wall: dict[str, float] = {}
        self.cpu: dict[str, float] = {}

    def __call__(self, name: str, inputs: object, make):
        begun, used = time.perf_counter(), processor_seconds()
        value = make()
        title = "one person after the other" if "/person " in name else name
        if "/" not in name or "/person " in name:
            self.wall[title] = self.wall.get(title, 0.0) + time.perf_counter() - begun
            self.cpu[title] = self.cpu.get(title, 0.0) + processor_seconds() - used
        return value


def processor_seconds() -> float:
    """Of this process and of its children that have ended."""
    return sum(os.times()[:4])


class PeakMemory:
    """The largest memory of this process and all below it together, sampled; pages that they share count once (Linux).
    """

    def __init__(self) -> None:
        self.gib = 0.0
        threading.Thread(target=self._watch, daemon=True).start()

    def _watch(self) -> None:
        while True:
            self.gib = max(self.gib, sum(map(memory_gib, family(os.getpid()))))
            time.sleep(0.5)


def family(pid: int) -> list[int]:
    """A process and all below it."""
    try:
        below = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except OSError:                                                             # ended meanwhile
        below = []
    return [pid, *(one for child in below for one in family(int(child)))]


def memory_gib(pid: int) -> float:
    """Of one process, its share of what it shares with others included."""
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except OSError:
        return 0.0
    return sum(int(line.split()[1]) for line in lines if line.startswith("Pss:")) / 2**20


def by_command(data: RealData, train: np.ndarray, kind: str, model: BodyModel) -> dict:
    """What `scape learn` takes for the same, meshes read and pictures drawn, and how far its model is from this one."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "people").mkdir()
        meshes = sorted((data_folder() / "spring_shapes").glob("*.ply"))
        for i in train:
            (folder / "people" / meshes[i].name).symlink_to(meshes[i].resolve())
        (folder / "learn.toml").write_text("[scape]\ncomponents = 80\n")
        begun, own = time.perf_counter(), memory_gib(os.getpid())
        words = ["--poses", data_folder() / "scape_poses", "--shapes", folder / "people", "--kind", kind,
                 "--config", folder / "learn.toml", "-o", folder / "model.npz"]
        running = subprocess.Popen([sys.executable, "-m", "completion", "learn", *map(str, words)],
                                   cwd=Path(__file__).parents[2])
        memory = PeakMemory()
        _, status, used = os.wait4(running.pid, 0)
        if status:
            raise SystemExit("scape learn failed")
        wall = time.perf_counter() - begun
        metrics = json.loads((folder / "model.npz.report.json").read_text())["metrics"]
        learned = load_model(folder / "model.npz")
        pose, betas = np.full((len(model.skeleton.parents), 3), 0.1), np.ones(10)
        return {"wall_s": wall, "cpu_s": used.ru_utime + used.ru_stime, "peak_gib": memory.gib - own,
                "steps_s": {m["metric"][6:]: m["value"] for m in metrics if m["metric"].startswith("time: ")},
                "disagreement_m": float(np.abs(learned.vertices(pose, betas) - model.vertices(pose, betas)).max())}


def fast_path(model: BodyModel, batch: int = 256) -> dict:
    """Meshes a second of a subject, its agreement with the sparse solve, and the time of both for one pose."""
    rng = np.random.default_rng(0)
    poses = rng.normal(0, 0.3, (batch, len(model.skeleton.parents), 3))
    exact = model.vertices(poses[:4])
    features = model.features.count
    result = {"features": features, "terms": model.terms.count if hasattr(model, "terms") else features,
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
             "worst_person_mm": 1e3 * float(free.mean.max()), "vertex_pca_mm": 1e3 * pca.overall, "fit_s": seconds}
            for n, free, pca in zip(found.counts, found.errors, found.vertex_pca, strict=True)]


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
    clock, memory, start, cpu = Clock(), PeakMemory(), time.perf_counter(), processor_seconds()
    skeleton = clock("skeleton", None, lambda: choose_skeleton(data.template, data.poses).skeleton)
    learn = learn_scape if args.kind == "scape" else learn_blendscape
    model: BodyModel = learn(data.template, data.poses, data.shapes[train], skeleton, config,  # type: ignore[operator]
                             step=clock)
    report |= {"parts": len(skeleton.parents), "steps_s": clock.wall, "steps_cpu_s": clock.cpu,
               "learn_s": time.perf_counter() - start, "learn_cpu_s": processor_seconds() - cpu, "peak_gib": memory.gib,
               "explained": model.explained[[9, 19, 39, 79]].tolist()}
    if args.keep:
        model.save(args.keep)
        report["file_mib"] = args.keep.stat().st_size / 2**20
        begun = time.perf_counter()
        load_model(args.keep)
        report["load_s"] = time.perf_counter() - begun
        report["loaded_mib"] = loaded_mib(args.keep)
    report["command"] = by_command(data, train, args.kind, model)
    report["fast_path"] = fast_path(model)
    write_report(args.output, report)
    report["people"] = held_out_people(model, data.shapes[held[:args.held]], data.shapes[train], [20, 40, 80])
    for name, value in report.items():
        print(f"{name:24s} {value}")
    write_report(args.output, report)


if __name__ == "__main__":
    main()
