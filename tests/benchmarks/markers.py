"""Markers: the whole surface from 56 of its points, what disturbs it, and the speed on real sequences.

    SCAPEKIT_DATA=... python tests/benchmarks/markers.py -m FOLD.npz -o markers.json
    SCAPEKIT_DATA=... python tests/benchmarks/markers.py -m FOLD.npz --c3d FOLDER --people MODEL.npz -o markers.json
    SCAPEKIT_DATA=... python tests/benchmarks/markers.py -m FOLD.npz --c3d FOLDER --layout FILE [--betas FILE.npz]

Every held-out SCAPE pose is one frame of its own: markers on random vertices, pose unknown, subject known. They
are also the stops of a motion (`marker_motion.py`) that is followed with markers missing, exchanged and astray.
Real files need a person: with `--people` a model with betas, by which the shape comes from the markers.
"""
from __future__ import annotations

import argparse
import dataclasses
import time
from pathlib import Path

import numpy as np
from marker_motion import HeldOutMotion, dropped, held_out_motion, strayed, swapped
from protocols import RealData, load_real, machine, scape_fold, write_report

from completion.mocap.files.markers import MarkerSequence, read_markers
from completion.mocap.marker_sets.layout import MarkerLayout
from completion.mocap.marker_sets.named import load_layout
from completion.mocap.pose.follow import AnimateConfig, animate
from completion.mocap.pose.stream import MarkerStream
from completion.mocap.subject.person import find_person
from completion.motion import Motion
from model import learn_scape
from model.body import BodyModel
from model.files import load_model
from model.learning.parts import choose_skeleton
from model.linear import Subject
from model.scape import ScapeModel
from scanprep.skeleton.tree import Skeleton

WAYS = (("stream, kalman", AnimateConfig()), ("sequence", AnimateConfig()))


def held_out_poses(data: RealData, model: ScapeModel, fold: int, count: int) -> list[dict[str, float]]:
    """Error over the whole surface, millimetres, for markers on random vertices of every held-out pose."""
    rng = np.random.default_rng(0)
    subject, rows = model.subject(None), []
    for i in scape_fold(fold)[1]:
        body = data.template.with_vertices(data.poses[i])
        layout = MarkerLayout(tuple(f"M{k}" for k in range(count)),
                              rng.choice(len(body.vertices), count, replace=False), 0.0)
        sequence = MarkerSequence(layout.place(body)[None], layout.labels, 100.0)
        motion = animate(subject, sequence, layout)
        apart = 1e3 * np.linalg.norm(motion.vertices(subject)[0] - body.vertices, axis=1)
        rows.append({"pose": int(i), "surface_mm": float(apart.mean()), "worst_mm": float(apart.max()),
                     "markers_mm": float(1e3 * np.nanmean(motion.residuals))})
        print(rows[-1], flush=True)
    return rows


def follow(way: str, subject: Subject, markers: MarkerSequence, layout: MarkerLayout, config: AnimateConfig
           ) -> tuple[Motion, dict[str, float]]:
    """The motion frame by frame or as a whole, and the frames a second of it."""
    start, cpu = time.perf_counter(), time.process_time()
    if way == "sequence":
        motion = animate(subject, markers, layout, config)
    else:
        stream = MarkerStream(subject, layout, markers.labels, markers.rate, config)
        frames = [stream.push(positions) for positions in markers.positions]
        motion = Motion(*(np.array([getattr(f, name) for f in frames]) for name in ("pose", "trans")), subject.betas,
                        markers.rate, np.array([f.residuals for f in frames]), markers.labels,
                        converged=np.array([f.converged for f in frames]),
                        trusted=np.array([f.trusted for f in frames]))
    count = len(markers.positions)
    return motion, {"per_s": count / (time.perf_counter() - start), "per_cpu_s": count / (time.process_time() - cpu)}


def disturbed(motion: HeldOutMotion, count: int) -> list[dict]:
    """Error over the whole surface, millimetres, with markers on random vertices that are not always there."""
    rng = np.random.default_rng(0)
    layout = MarkerLayout(tuple(f"M{k}" for k in range(count)),
                          rng.choice(motion.subject.n_vertices, count, replace=False), 0.0)
    clean = motion.markers(layout)
    kinds = {"all seen": clean, "20% missing, 0.5 s each": dropped(clean, 0.2, 0.5, rng),
             "40 pairs exchanged, 0.5 s each": swapped(clean, 40, 0.5, rng),
             "5% of observations 0.3 m astray": strayed(clean, 0.05, 0.3, rng)}
    rows = []
    for way, config in WAYS:
        for kind, markers in kinds.items():
            found, speed = follow(way, motion.subject, markers, layout, config)
            apart = motion.error(found.poses, found.trans)
            seen = np.isfinite(found.residuals)
            rows.append({"way": way, "markers": kind, "surface_mm": float(apart.mean()),
                         "p95_mm": float(np.percentile(apart, 95)), "worst_mm": float(apart.max()),
                         "distrusted": float((seen & ~found.trusted).sum() / seen.sum()), **speed})
            print(rows[-1], flush=True)
    return rows


def person(model: BodyModel, markers: MarkerSequence, layout: MarkerLayout, betas: Path | None
           ) -> tuple[Subject, MarkerLayout]:
    """Who carries the markers: of given betas, from the markers, or the template's own body; and their layout."""
    if betas:
        return model.subject(np.load(betas)["betas"]), layout
    if model.n_betas:
        found = find_person(model, markers, layout)
        return model.subject(found.betas), found.layout
    return model.subject(None), layout


def real_sequences(model: BodyModel, folder: Path, layout: MarkerLayout, betas: Path | None, limit: int | None
                   ) -> list[dict]:
    """Residuals and speed on real files, frame by frame and as a whole."""
    rows = []
    for path in sorted(folder.glob("*.c3d")):
        whole = read_markers(path)
        sequence = MarkerSequence(whole.positions[:limit], whole.labels, whole.rate)
        subject, placed = person(model, whole, layout, betas)
        for way, config in WAYS:
            motion, speed = follow(way, subject, sequence, placed, config)
            rows.append({"file": path.name, "frames": len(sequence.positions), "way": way,
                         "mean_mm": 1e3 * float(np.nanmean(motion.residuals)),
                         "p95_mm": 1e3 * float(np.nanpercentile(motion.residuals, 95)),
                         "settled": float(motion.converged.mean()), **speed})
            print(rows[-1], flush=True)
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
    parser.add_argument("--people", help="model with betas for the real sequences; else the model of the fold")
    parser.add_argument("--layout", default="cmu41", help="their layout: a file, or a name that comes along")
    parser.add_argument("--betas", type=Path, help=".npz with the betas of who carries them")
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
    report["motion"] = disturbed(held_out_motion(data, model, args.fold), args.count)
    if args.c3d:
        people = load_model(args.people) if args.people else model
        layout = MarkerLayout.load(args.layout) if Path(args.layout).is_file() else \
            load_layout(args.layout, people.template)
        report["real"] = real_sequences(people, args.c3d, layout, args.betas, args.limit)
    for name, value in report["mean"].items():
        print(f"{name:24s} {value:8.2f}")
    write_report(args.output, report)


if __name__ == "__main__":
    main()
