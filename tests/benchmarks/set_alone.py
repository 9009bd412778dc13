"""A set without landmarks registers itself: first scan by scan, then through a model of the scans that are good.

    SCAPEKIT_DATA=... python tests/benchmarks/set_alone.py FOLDER [--of poses|animal] [--every 1] [--workers 2]
        [-o FILE]

`poses` are the virtual scans of SCAPE poses with the template mesh000, one subject, no landmark; `animal` needs no
data: fourteen scans of an animal made for the tests, of which no built-in model knows anything. FOLDER keeps the scans
and the set, so that a run that was stopped goes on. Errors are millimetres from true vertices.

What we lose at: a pose that no good scan resembles is not known to the set's own model either; hands stay rolled.
"""
from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np
from protocols import load_real, machine, write_report
from scans import test_scan

from scanprep import read_mesh, write_mesh
from scanprep.batch.pool import Workers
from scanprep.dataset import RegisteredSet
from scanprep.geometry.mesh import Mesh
from scanprep.pipeline.page import judge_set
from scanprep.pipeline.prepare import PrepareConfig, prepare
from scanprep.pipeline.scan import mesh_file
from scanprep.pipeline.scans import find_scans
from scanprep.synthetic.scanner import ScannerConfig, scan

ANIMALS = 14


def write_poses(folder: Path, every: int) -> tuple[Mesh, dict[str, np.ndarray]]:
    """The scans of all poses but the template's, or of some, and their true vertices (N, 3), metres."""
    data = load_real()
    truth = {f"pose{k:03d}": data.poses[k] for k in range(1, len(data.poses), every)}
    for k, name in zip(range(1, len(data.poses), every), truth, strict=True):
        if not (folder / f"{name}.ply").exists():
            write_mesh(folder / f"{name}.ply", test_scan(data, "pose", k).scan)
    return data.template, truth


def write_animals(folder: Path, every: int) -> tuple[Mesh, dict[str, np.ndarray]]:
    """The same of an animal in random poses."""
    sys.path.insert(0, str(Path(__file__).parents[1]))
    from animal_bodies import Animal, random_pose

    animal, rng = Animal(), np.random.default_rng(5)
    truth = {f"animal{k:02d}": animal.posed(random_pose(rng)) for k in range(ANIMALS)}
    truth = dict(list(truth.items())[::every])
    for k, (name, vertices) in enumerate(truth.items()):
        seen = scan(animal.mesh.with_vertices(vertices), ScannerConfig(), np.random.default_rng(k))
        write_mesh(folder / f"{name}.ply", seen.merged)
    return animal.mesh, truth


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--of", choices=("poses", "animal"), default="poses")
    parser.add_argument("--every", type=int, default=1, help="take each so manieth scan")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("-o", "--output", help="write all figures here")
    args = parser.parse_args()
    scans, place = args.folder / "scans", args.folder / "set"
    scans.mkdir(parents=True, exist_ok=True)
    template, truth = {"poses": write_poses, "animal": write_animals}[args.of](scans, args.every)
    start = time.perf_counter()
    done = prepare(find_scans(scans, "none", "one"), template, {}, place, PrepareConfig(workers=Workers(args.workers)),
                   lambda now, total: print(f"{now} of {total}, {time.perf_counter() - start:.0f} s", flush=True))
    wall = time.perf_counter() - start
    verdicts = {verdict.name: verdict for verdict in judge_set(place)}
    files = {entry.name: entry.file for entry in RegisteredSet.load(place).entries}
    rows = []
    for name, vertices in truth.items():
        first, last = mesh_file(name), files.get(name, "")
        row: dict[str, object] = {"scan": name, "verdict": str(verdicts[name].judgement),
                                  "again": last not in ("", first)}
        for key, file in (("first_mm", first), ("mean_mm", last)):
            there = bool(file) and (place / file).is_file()
            row[key] = 1e3 * float(np.linalg.norm(
                read_mesh(place / file).vertices - vertices, axis=1).mean()) if there else None
        rows.append(row)
        print(row)
    means = np.array([row["mean_mm"] if row["mean_mm"] is not None else np.inf for row in rows], dtype=float)
    firsts = np.array([row["first_mm"] if row["first_mm"] is not None else np.inf for row in rows], dtype=float)
    good = np.array([str(row["verdict"]) == "good" for row in rows])
    summary = {"scans": len(rows), "below_15mm": int((means < 15).sum()), "below_20mm": int((means < 20).sum()),
               "median_mm": float(np.median(means)), "worst_mm": float(means.max()),
               "first_below_20mm": int((firsts < 20).sum()), "first_failed": int(np.isinf(firsts).sum()),
               "again": sum(bool(row["again"]) for row in rows), "good": int(good.sum()),
               "good_beyond_30mm": int((good & (means > 30)).sum()), "wall_s": wall,
               "wall_of_scans_s": float(sum(f.seconds for f in done.figures))}
    print(summary)
    if args.output:
        write_report(args.output, {"of": args.of, "every": args.every, "workers": args.workers, "machine": machine(),
                                 "summary": summary, "rows": rows})


if __name__ == "__main__":
    main()
