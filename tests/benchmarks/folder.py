"""A folder of virtual scans through `scape prep run`: time, processor and memory by the number of scans and workers.

    SCAPEKIT_DATA=... python tests/benchmarks/folder.py FOLDER [--scans 20] [--workers 1 2] [--different 4]
        [--faces 3000] [-o FILE]

Ten landmarks a scan, template mesh000, with fewer triangles if asked, every scan a person of its own, so no skeleton;
some 100,000 triangles. With `--different` there are only so many scans, each several times under other names, and
registered each time: thus a folder of a thousand needs no thousand scans. Memory is the largest that was resident, of
the process that was started and of any of its workers. Run it with nothing else on the machine. Linux only.
"""
from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from protocols import load_real, machine, write_report
from scans import HELD_POSES, TUNING_POSES, test_scan

from scanprep import decimate, write_landmarks, write_mesh

POLL = 0.2                           # seconds between looks at memory


class Run(NamedTuple):
    """One run of the command."""

    scans: int
    triangles: int                   # of a scan, on average
    workers: int
    wall_s: float
    cpu_s: float
    scans_per_hour: float
    parent_mb: float
    worker_mb: float
    page_mb: float
    cpu_s_each: float                # parts of the template included


def write_scans(folder: Path, poses: tuple[int, ...], faces: int) -> int:
    """The template of at most so many triangles, and a scan with landmarks for every pose; a scan's mean triangles."""
    data = load_real()
    names = {vertex: name for name, vertex in data.landmarks.items()}
    write_mesh(folder / "template.ply", decimate(data.template, faces, keep=np.array(list(data.landmarks.values()))))
    write_landmarks(folder / "template.landmarks.json",
                    {name: data.template.vertices[v] for name, v in data.landmarks.items()})
    triangles = 0
    for index in poses:
        item = test_scan(data, "pose", index)
        vertices, points = item.landmarks(data, "10")
        triangles += len(item.scan.faces)
        write_mesh(folder / "once" / f"{item.name}.ply", item.scan)
        write_landmarks(folder / "once" / f"{item.name}.landmarks.json",
                        {names[int(v)]: point for v, point in zip(vertices, points, strict=True)})
    return triangles // len(poses)


def repeated(folder: Path, count: int) -> Path:
    """A folder of so many scans: links to those that there are, under other names."""
    once = sorted((folder / "once").glob("*.ply"))
    scans = folder / f"scans{count}"
    shutil.rmtree(scans, ignore_errors=True)
    scans.mkdir()
    for number in range(count):
        path = once[number % len(once)]
        for ending in (".ply", ".landmarks.json"):
            (scans / f"{path.stem}_{number // len(once):03d}{ending}").symlink_to(path.with_name(path.stem + ending))
    return scans


def measured(folder: Path, count: int, triangles: int, workers: int) -> Run:
    """The command on so many scans, in a process of its own."""
    output = folder / f"set{count}_{workers}"
    shutil.rmtree(output, ignore_errors=True)
    start = time.perf_counter()
    child = subprocess.Popen([sys.executable, "-m", "completion", "prep", "run", str(repeated(folder, count)),
                              "--template", str(folder / "template.ply"), "-o", str(output), "--workers", str(workers)],
                             stdout=subprocess.DEVNULL)
    most: dict[int, float] = {}
    while os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None:
        for pid in (child.pid, *descendants(child.pid)):
            most[pid] = max(most.get(pid, 0.0), resident_mb(pid))
        time.sleep(POLL)
    _, status, used = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        raise SystemExit(f"scape prep run failed on {count} scans")
    wall, cpu = time.perf_counter() - start, used.ru_utime + used.ru_stime
    return Run(count, triangles, workers, wall, cpu, 3600 * count / wall, most.pop(child.pid),
               max(most.values(), default=0.0), (output / "report.html").stat().st_size / 1e6, cpu / count)


def descendants(pid: int) -> list[int]:
    """The processes that a process began, and theirs."""
    try:
        tasks = list(Path(f"/proc/{pid}/task").iterdir())
        own = [int(child) for task in tasks for child in (task / "children").read_text().split()]
    except OSError:                  # it has just ended
        return []
    return [found for child in own for found in (child, *descendants(child))]


def resident_mb(pid: int, field: str = "VmHWM") -> float:
    """The most memory that a process has had, or has now (VmRSS), megabytes; 0 for one that is gone."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return 0.0
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith(field + ":")), 0.0)


def main() -> None:
    """Run and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scans", type=int, nargs="*", default=[20], help="in the folder, one run for each number")
    parser.add_argument("--workers", type=int, nargs="*", default=[1, 2])
    parser.add_argument("--different", type=int, default=20, help="how many different ones there are, at most 20")
    parser.add_argument("--faces", type=int, default=50_000, help="of the template, which has fewer if it had fewer")
    parser.add_argument("-o", "--output", help="write all figures here")
    asked = parser.parse_args()
    triangles = write_scans(asked.folder, (*HELD_POSES, *TUNING_POSES)[:min(asked.different, max(asked.scans))],
                            asked.faces)
    runs = []
    for workers in asked.workers:
        for count in asked.scans:
            runs.append(measured(asked.folder, count, triangles, workers))
            print(" ".join(f"{key}={value:.4g}" for key, value in runs[-1]._asdict().items()), flush=True)
    if asked.output:
        write_report(asked.output, {"protocol": "scape prep run over folders", "machine": machine(),
                                  "rows": [run._asdict() for run in runs]})


if __name__ == "__main__":
    main()
