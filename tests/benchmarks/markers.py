"""Markers: the whole surface from 56 of its points, and the speed on real sequences.

    SCAPEKIT_DATA=... python tests/benchmarks/markers.py -o markers.json
    SCAPEKIT_DATA=... python tests/benchmarks/markers.py --c3d FOLDER --layout LAYOUT.json -o markers.json

Every held-out SCAPE pose is one frame of its own: markers on random vertices, pose unknown, subject known.
"""
from __future__ import annotations

import argparse
import dataclasses
import time
from pathlib import Path

import numpy as np
from protocols import RealData, load_real, machine, scape_fold, write_report

from completion.animation.follow import AnimateConfig, animate
from completion.markers.files import MarkerSequence, read_markers
from completion.markers.layout import MarkerLayout
from model.files import load_model
from model.learning import learn_scape
from model.learning.parts import choose_skeleton
from model.scape import ScapeModel
from scanprep.skeleton.tree import Skeleton


def held_out_poses(data: RealData, model: ScapeModel, fold: int, count: int) -> list[dict[str, float]]:
    """Error over the whole surface, millimetres, for markers on random vertices of every held-out pose."""
    rng = np.random.default_rng(0)
    subject, rows = model.subject(None), []
    for i in scape_fold(fold)[1]:
        body = data.template.with_vertices(data.poses[i])
        layout = MarkerLayout(tuple(f"M{k}" for k in range(count)),
                              rng.choice(len(body.vertices), count, replace=False), 0.0)
        sequence = MarkerSequence(layout.place(body)[None], layout.labels, 100.0)
        motion = animate(subject, sequence, layout, AnimateConfig(smoothing=0))
        apart = 1e3 * np.linalg.norm(motion.vertices(subject)[0] - body.vertices, axis=1)
        rows.append({"pose": int(i), "surface_mm": float(apart.mean()), "worst_mm": float(apart.max()),
                     "markers_mm": float(1e3 * np.nanmean(motion.residuals))})
        print(rows[-1], flush=True)
    return rows


def real_sequences(model: ScapeModel, folder: Path, layout: MarkerLayout, limit: int | None) -> list[dict]:
    """Residuals and speed on real files, frame by frame and with smoothing."""
    subject, rows = model.subject(None), []
    for path in sorted(folder.glob("*.c3d")):
        whole = read_markers(path)
        sequence = MarkerSequence(whole.positions[:limit], whole.labels, whole.rate)
        row: dict = {"file": path.name, "frames": len(sequence.positions)}
        for name, smoothing in (("frames", 0), ("sequence", 1)):
            start, cpu = time.perf_counter(), time.process_time()
            motion = animate(subject, sequence, layout, AnimateConfig(smoothing=smoothing))
            row |= {f"{name}_per_s": len(sequence.positions) / (time.perf_counter() - start),
                    f"{name}_per_cpu_s": len(sequence.positions) / (time.process_time() - cpu),
                    f"{name}_mean_mm": 1e3 * float(np.nanmean(motion.residuals)),
                    f"{name}_p95_mm": 1e3 * float(np.nanpercentile(motion.residuals, 95)),
                    f"{name}_settled": float(motion.converged.mean())}
        rows.append(row)
        print(row, flush=True)
    return rows


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", default="markers.json")
    parser.add_argument("-m", "--model", help="of the training part of the fold; learned when not given")
    parser.add_argument("--skeleton", help="found from the training part of the fold; sought when not given")
    parser.add_argument("--fold", type=int, default=0)
    parser.add_argument("--count", type=int, default=56)
    parser.add_argument("--c3d", type=Path, help="folder of real sequences")
    parser.add_argument("--layout", type=Path, help="their layout on this topology")
    parser.add_argument("--limit", type=int, help="frames of each sequence")
    args = parser.parse_args()
    data = load_real()
    if args.model:
        model = load_model(args.model)
    else:
        train, _ = scape_fold(args.fold)
        skeleton = Skeleton.load(args.skeleton) if args.skeleton else \
            choose_skeleton(data.template, data.poses[train]).skeleton
        model = learn_scape(data.template, data.poses[train], None, skeleton)
    rows = held_out_poses(data, model, args.fold, args.count)
    report = {"protocol": f"{args.count} markers, SCAPE fold {args.fold}", "machine": machine(), "poses": rows,
              "config": dataclasses.asdict(AnimateConfig()),
              "mean": {name: float(np.mean([row[name] for row in rows])) for name in rows[0] if name != "pose"}}
    if args.c3d and args.layout:
        report["real"] = real_sequences(model, args.c3d, MarkerLayout.load(args.layout), args.limit)
    for name, value in report["mean"].items():
        print(f"{name:24s} {value:8.2f}")
    write_report(args.output, report)


if __name__ == "__main__":
    main()
