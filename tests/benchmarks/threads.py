"""What threads of the linear algebra cost and save: seconds of the clock and of the processor for whole commands.

    python tests/benchmarks/threads.py -o threads.json
    python tests/benchmarks/threads.py --tree ../older --busy 0 2 -o before.json

Every command runs in a process of its own, on synthetic people made beforehand: `prep register` of one scan, `learn` of
a small set, `complete` of a half view, `mosh` of 720 frames, `track` of 24. Once with no variable set, which is what
scapekit decides by itself, and once for each number of OMP_NUM_THREADS. `--busy` names how many processes compute all
the time beside it, one run for each number; `--tree` measures another version of the sources. `same` says that what was
written is byte for byte what the first run wrote, figures of time and pages apart. A shared machine is noisy: seconds
of the processor say most, and every command runs `--rounds` times, the settings in turn; the least of each is told.
"""
from __future__ import annotations

import argparse
import contextlib
import hashlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import numpy as np
from protocols import half_view, machine, write_report

from completion.mocap.files.markers import MarkerSequence, write_markers
from completion.mocap.marker_sets.named import load_layout
from model.body import BodyModel
from model.built_in import load_built_in_model
from model.files import BUILT_IN
from scanprep.geometry.files import PointCloud, write_mesh, write_points
from scanprep.geometry.landmarks import write_landmarks
from scanprep.synthetic.people import BodyShape, SyntheticPerson, synthesise_walk

VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
TIMED = ("report.json", ".report.json", ".html", "times.csv", ".png", ".webp")      # what changes from run to run
BUSY = "while True: pass"


def make_cases(folder: Path, model: BodyModel, model_file: Path) -> dict[str, list[str]]:
    """What the commands read, and their arguments."""
    rng = np.random.default_rng(0)
    person = SyntheticPerson(BodyShape.random(rng, sex="female"))
    marks = {name: int(v) for name, v in model.info["landmarks"].items()}
    kept = np.array(model.info["people_vertices"])
    scan = model.template.with_vertices(person.mesh.vertices[kept])
    write_mesh(folder / "template.ply", model.template)
    write_landmarks(folder / "template.landmarks.json", marks)
    write_mesh(folder / "scan.ply", scan)
    write_landmarks(folder / "scan.landmarks.json", {name: scan.vertices[v] for name, v in marks.items()})
    seen = half_view(scan, 0, marks, rng)
    write_points(folder / "half.ply", PointCloud(seen.points))
    model.skeleton.save(folder / "skeleton.json")
    names = {v: name for name, v in marks.items()}
    write_landmarks(folder / "half.landmarks.json",
                    {names[int(v)]: p for v, p in zip(*seen.landmarks, strict=True)})
    subject = model.subject(0.5 * rng.normal(size=model.n_betas))
    layout = load_layout("cmu41", model.template, kept)
    bodies = subject.vertices(*synthesise_walk(720, 120.0))
    places = np.array([layout.place(model.template.with_vertices(v)) for v in bodies])
    places += rng.normal(0, 0.001, places.shape)
    write_markers(folder / "walk.c3d", MarkerSequence(places, layout.labels, 120.0))
    for k, v in enumerate(bodies[:96:4]):
        points, _, _ = model.template.with_vertices(v).sample(5000, rng)
        write_points(folder / "frames" / f"{k:03d}.ply", PointCloud(points))
    poses = subject.vertices(rng.normal(0, 0.25, (16, len(model.skeleton.parents), 3)))
    for k, v in enumerate(poses):
        write_mesh(folder / "poses" / f"{k:02d}.ply", model.template.with_vertices(v))
    for k in range(12):
        write_mesh(folder / "shapes" / f"{k:02d}.ply", model.template.with_vertices(
            model.vertices(np.zeros_like(model.pose_mean), rng.normal(size=model.n_betas))))
    body = ["-m", str(model_file)]
    return {
        "register": ["prep", "register", "scan.ply", "--template", "template.ply", "--landmarks", "scan.landmarks.json",
                     "-o", "OUT/registered.ply"],
        "learn": ["learn", "--poses", "poses", "--shapes", "shapes", "--skeleton", "skeleton.json",
                  "-o", "OUT/model.npz"],
        "complete": ["complete", "half.ply", "--landmarks", "half.landmarks.json", "-o", "OUT/done", *body],
        "mosh": ["mosh", "walk.c3d", "--layout", "cmu41", "-o", "OUT/done", *body],
        "track": ["track", "frames", "-o", "OUT/done", *body]}


def run(arguments: list[str], folder: Path, tree: Path, busy: int, threads: str) -> dict[str, float | str]:
    """One command in a process of its own; its seconds and a digest of what it wrote."""
    environment = {k: v for k, v in os.environ.items() if k not in VARIABLES} | {"PYTHONPATH": str(tree)}
    if threads != "own":
        environment["OMP_NUM_THREADS"] = threads
    with tempfile.TemporaryDirectory(dir=folder) as out, beside(busy):
        start = time.perf_counter()
        child = subprocess.Popen([sys.executable, "-m", "completion", *(a.replace("OUT", out) for a in arguments)],
                                 cwd=folder, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        assert child.stderr is not None
        said = child.stderr.read().decode(errors="replace")
        _, status, used = os.wait4(child.pid, 0)
        wall, child.returncode = time.perf_counter() - start, os.waitstatus_to_exitcode(status)
        if child.returncode:
            raise SystemExit(f"scape {' '.join(arguments)} failed: {said}")
        return {"wall_s": wall, "cpu_s": used.ru_utime + used.ru_stime, "digest": digest(Path(out))}


def digest(folder: Path) -> str:
    """Of all files that should not change from run to run; hidden folders keep seconds too."""
    told = hashlib.sha256()
    for path in sorted(p for p in folder.rglob("*") if p.is_file() and not p.name.endswith(TIMED)):
        if any(part.startswith(".") for part in path.relative_to(folder).parts):
            continue
        told.update(str(path.relative_to(folder)).encode() + path.read_bytes())
    return told.hexdigest()[:16]


@contextlib.contextmanager
def beside(count: int) -> Iterator[None]:
    """Other processes that compute all the time."""
    others = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(count)]
    try:
        yield
    finally:
        for other in others:
            other.kill()
            other.wait()


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", default="threads.json")
    parser.add_argument("--tree", type=Path, default=Path(__file__).resolve().parents[2], help="sources to measure")
    parser.add_argument("--threads", nargs="*", default=["own", "1", "2"], help="'own', or OMP_NUM_THREADS")
    parser.add_argument("--cases", nargs="*", help="some of register, learn, complete, mosh, track; else all")
    parser.add_argument("--busy", type=int, nargs="*", default=[0, 1], help="processes that compute beside")
    parser.add_argument("--rounds", type=int, default=1)
    args = parser.parse_args()
    model = load_built_in_model()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        cases = make_cases(folder, model, Path(BUILT_IN))
        rows = []
        settings = list(product(args.busy, args.threads))
        for name in args.cases or cases:
            runs = [{setting: run(cases[name], folder, args.tree.resolve(), *setting) for setting in settings}
                    for _ in range(args.rounds)]
            first = runs[0][settings[0]]["digest"]
            for busy, threads in settings:
                those = [r[busy, threads] for r in runs]
                row = {"command": name, "busy": busy, "threads": threads,
                       **{clock: min(r[clock] for r in those) for clock in ("wall_s", "cpu_s")},
                       "same": all(r["digest"] == first for r in those)}
                rows.append(row)
                print(f"{name:9} beside {busy}, {threads:>4} threads: {row['wall_s']:7.1f} s wall "
                      f"{row['cpu_s']:7.1f} s processor{'' if row['same'] else '  OTHER BYTES'}", flush=True)
    write_report(args.output, {"protocol": "whole commands by threads of the linear algebra", "machine": machine(),
                               "rounds": args.rounds, "commands": rows})


if __name__ == "__main__":
    main()
