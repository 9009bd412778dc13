"""A folder of inputs on a Dask cluster of two workers, of which one is killed on the way.

    python tests/benchmarks/cluster.py FOLDER [--commands complete mosh track] [--count 1000] [-o cluster.json]

Scans are completed with the built-in people on fewer triangles, recordings of markers are short, so that a thousand
take minutes. There are `--different` inputs, under as many names as asked. Memory is that which is resident in the
process of the command, when a quarter, a half and all of the results are there, and its peak. `same` tells how many
files of the cluster are, bit for bit, those of this machine alone. `track` follows one recording of so many frames; it
is killed in the middle and started again. Linux only.
"""
from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from folder import POLL, resident_mb
from mosh_speed import walking
from protocols import machine, write_report

from completion import read_markers, write_markers
from model import load_model
from model.built_in import load_built_in_model
from model.resolution.change import change_resolution
from scanprep import decimate, write_landmarks, write_mesh
from scanprep.geometry.mesh import Mesh
from scanprep.synthetic.people import synthesise_walk
from scanprep.synthetic.scanner import ScannerConfig, scan

FACES, FRAMES, RATE = 2000, 30, 120.0            # of the model; of a recording of markers, and a second
CAMERA = ScannerConfig(views=1, resolution=0.02)
MARKS = 7                                        # landmarks on a scan

Row = dict[str, object]


def write_inputs(folder: Path, different: int, frames: int) -> None:
    """A coarse model, half scans with landmarks, recordings of markers, and frames of one camera."""
    rng, whole = np.random.default_rng(0), load_built_in_model()
    names = list(whole.info["landmarks"])[:MARKS]
    marks = np.array([whole.info["landmarks"][name] for name in names])
    coarse = change_resolution(whole, decimate(whole.template, FACES, keep=marks), rounds=0)
    coarse.save(folder / "model.npz")
    for number in range(different):
        poses, trans = synthesise_walk(FRAMES, RATE)
        t = rng.integers(FRAMES)
        body = Mesh(whole.vertices(poses[t], rng.normal(size=whole.n_betas) / 2, trans[t]), whole.template.faces)
        write_mesh(folder / "complete" / f"scan{number}.ply", scan(body, CAMERA, rng).views[0].mesh)
        write_landmarks(folder / "complete" / f"scan{number}.landmarks.json",
                        {name: body.vertices[v] for name, v in zip(names, marks, strict=True)})
        (folder / "mosh").mkdir(exist_ok=True)
        write_markers(folder / "mosh" / f"walk{number}.c3d", walking(FRAMES, False, rng))
    person = whole.subject(np.zeros(whole.n_betas))
    poses, trans = synthesise_walk(frames, 30.0)
    for t in range(frames):
        body = Mesh(np.asarray(person.vertices(poses[t], trans[t]), float), whole.template.faces)
        write_mesh(folder / "track" / f"frame{t:05d}.ply", scan(body, CAMERA, rng).views[0].mesh)


def repeat(once: Path, place: Path, count: int) -> Path:
    """A folder of so many inputs: those that there are, under other names."""
    place.mkdir(parents=True)
    stems = sorted({path.name.split(".")[0] for path in once.iterdir()})
    for number in range(count):
        stem = stems[number % len(stems)]
        for path in once.glob(f"{stem}.*"):
            shutil.copyfile(path, place / f"{stem}x{number:04d}{path.name.removeprefix(stem)}")
    return place


def arguments(command: str, inputs: Path, model: Path, output: Path, workers: str) -> list[str]:
    """The whole command line."""
    more = {"complete": ["-m", str(model)], "mosh": [], "track": ["--subject", "template"]}[command]
    work = [] if command == "track" else ["--workers", workers]
    return [sys.executable, "-m", "completion", command, str(inputs), "-o", str(output), *more, *work]


def follow(child: subprocess.Popen, done: Callable[[], int], count: int, halfway: Callable[[], None]) -> list[float]:
    """Memory of a process, MB, when a quarter, half and all is done, and its peak; at half something is done to it."""
    marks, peak, now = [0.25, 0.5, 1.0], 0.0, 0.0
    found: list[float] = []
    while child.poll() is None:
        peak, now = max(peak, resident_mb(child.pid)), resident_mb(child.pid, "VmRSS") or now
        if len(found) < 2 and done() >= marks[len(found)] * count:
            found.append(now)
            if len(found) == 2:
                halfway()
        time.sleep(POLL)
    return [*found, *[now] * (3 - len(found)), peak]


def contents(folder: Path) -> dict[str, bytes]:
    """What files of results hold, by their path; without pages and reports, which tell the time that was taken."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*"))
            if path.is_file() and not path.name.startswith("report.") and path.name != "subjects.csv"
            and ".scapekit" not in path.parts}


def on_cluster(command: str, folder: Path, count: int, different: int) -> Row:
    """One command on all inputs, and on each different one alone."""
    from distributed import LocalCluster

    inputs, output = repeat(folder / command, folder / f"{command}_{count}", count), folder / f"{command}_out"
    start = time.perf_counter()
    with LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster:
        child = subprocess.Popen(arguments(command, inputs, folder / "model.npz", output, cluster.scheduler_address),
                                 stdout=subprocess.DEVNULL)
        victim = next(iter(cluster.workers.values()))

        def done() -> int:
            made = output.iterdir() if output.is_dir() else ()
            return sum(path.is_dir() and path.name != ".scapekit" for path in made)

        memory = follow(child, done, count, lambda: os.kill(victim.pid, signal.SIGKILL))
    seconds = time.perf_counter() - start
    alone = folder / f"{command}_alone"
    subprocess.run(arguments(command, repeat(folder / command, folder / f"{command}_few", different),
                             folder / "model.npz", alone, "1"), stdout=subprocess.DEVNULL, check=False)
    few = contents(alone)
    same = [name for name, data in few.items() if (output / name).is_file() and (output / name).read_bytes() == data]
    return {"command": command, "count": count, "made": done(), "exit": child.returncode, "wall_s": seconds,
            "memory_mb": memory, "page_mb": (output / "report.html").stat().st_size / 1e6,
            "compared": len(few), "same": len(same), "differ": sorted(set(few) - set(same))[:5]}


def long_recording(folder: Path, count: int) -> Row:
    """One recording of so many frames, killed in the middle and gone on with, and once more without that."""
    made: list[dict[str, bytes]] = []
    memory: list[float] = []
    start = time.perf_counter()
    for output, kill in ((folder / "track_killed", True), (folder / "track_out", False)):
        call = arguments("track", folder / "track", folder / "model.npz", output, "1")

        def done(output: Path = output) -> int:
            return 5 * len(list((output / ".scapekit").rglob("frames*")))

        child = subprocess.Popen(call, stdout=subprocess.DEVNULL)
        memory = follow(child, done, count, child.kill if kill else lambda: None)
        if kill:
            child = subprocess.Popen(call, stdout=subprocess.DEVNULL)
            child.wait()
        made.append(contents(output))
    differ = [name for name, data in made[1].items() if made[0].get(name) != data]
    return {"command": "track", "count": count, "exit": child.returncode, "wall_s": time.perf_counter() - start,
            "memory_mb": memory, "page_mb": (folder / "track_out" / "report.html").stat().st_size / 1e6,
            "compared": len(made[1]), "same": len(made[1]) - len(differ), "differ": differ[:5]}


def main() -> None:
    """Run and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--commands", nargs="*", default=["complete", "mosh", "track"])
    parser.add_argument("--count", type=int, default=1000, help="inputs, and frames of the recording")
    parser.add_argument("--different", type=int, default=4, help="how many inputs differ")
    parser.add_argument("-o", "--output", help="write all figures here")
    asked = parser.parse_args()
    shutil.rmtree(asked.folder, ignore_errors=True)
    asked.folder.mkdir(parents=True)
    write_inputs(asked.folder, asked.different, asked.count)
    assert load_model(asked.folder / "model.npz").n_betas and read_markers(next((asked.folder / "mosh").iterdir()))
    rows = []
    for command in asked.commands:
        rows.append(long_recording(asked.folder, asked.count) if command == "track" else
                    on_cluster(command, asked.folder, asked.count, asked.different))
        print("  ".join(f"{name} {value}" for name, value in rows[-1].items()), flush=True)
    if asked.output:
        write_report(asked.output, {"protocol": "folders of inputs on a cluster of two workers",
                                    "machine": machine(), "rows": rows})


if __name__ == "__main__":
    main()
