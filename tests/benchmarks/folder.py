"""A folder of virtual scans registered by one worker and by several: how the time scales with the cores.

    SCAPEKIT_DATA=... python tests/benchmarks/folder.py FOLDER [--scans 20] [--workers 1 2]

Ten landmarks a scan, template mesh000, no skeleton. Run it with nothing else on the machine.
"""
from __future__ import annotations

import argparse
import time
from pathlib import Path

from protocols import load_real
from scans import HELD_POSES, TUNING_POSES, test_scan

from completion.__main__ import main as scape
from scanprep import write_landmarks, write_mesh


def write_folder(folder: Path, poses: tuple[int, ...]) -> None:
    """The template, and a scan with its landmarks for every pose."""
    data = load_real()
    names = {vertex: name for name, vertex in data.landmarks.items()}
    write_mesh(folder / "template.ply", data.template)
    write_landmarks(folder / "template.landmarks.json",
                    {name: data.template.vertices[v] for name, v in data.landmarks.items()})
    for index in poses:
        item = test_scan(data, "pose", index)
        vertices, points = item.landmarks(data, "10")
        write_mesh(folder / "scans" / f"{item.name}.ply", item.scan)
        write_landmarks(folder / "scans" / f"{item.name}.landmarks.json",
                        {names[int(v)]: point for v, point in zip(vertices, points, strict=True)})


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scans", type=int, default=20)
    parser.add_argument("--workers", type=int, nargs="*", default=[1, 2])
    asked = parser.parse_args()
    write_folder(asked.folder, (*HELD_POSES, *TUNING_POSES)[:asked.scans])
    for workers in asked.workers:
        start = time.perf_counter()
        scape(["prep", "run", str(asked.folder / "scans"), "--template", str(asked.folder / "template.ply"), "-o",
               str(asked.folder / f"set{workers}"), "--workers", str(workers), "--min-poses", "99"])
        print(f"{workers} workers: {time.perf_counter() - start:.0f} s", flush=True)
