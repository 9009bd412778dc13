"""Real marker files: the person from the markers, then the motion; one layout for all files.

    python tests/benchmarks/c3d.py FOLDER -m MODEL.npz -o c3d.json --pictures DIR

The model is of the SCAPE topology, or any on which the layout is known. For each file: seconds of one processor for
the subject and for the motion, and the distance of every seen marker from where the body puts it: the mean, the
95th percentile, the mean of the worst frame.
"""
from __future__ import annotations

import argparse
import dataclasses
import time
from pathlib import Path

import numpy as np
from protocols import machine, write_report

from completion.mocap.files.markers import MarkerSequence, read_markers
from completion.mocap.marker_sets.layout import MarkerLayout
from completion.mocap.marker_sets.named import load_layout
from completion.mocap.pose.follow import AnimateConfig, animate
from completion.mocap.subject.person import PersonConfig, PersonFit, find_person
from completion.motion import Motion
from model.body import BodyModel
from model.files import load_model

HELD_OUT = ("RBHD", "T10", "LUPA", "RFRM", "RTHI", "LSHN")      # of a later protocol; their places were not tuned


def follow(model: BodyModel, markers: MarkerSequence, layout: MarkerLayout, shape: PersonConfig,
           config: AnimateConfig) -> tuple[PersonFit, Motion, dict[str, float]]:
    """Subject, motion and figures of one file."""
    start = time.process_time()
    found = find_person(model, markers, layout, shape)
    person = time.process_time()
    motion = animate(model.subject(found.betas), markers, found.layout, config)
    end = time.process_time()
    off = 1e3 * motion.residuals
    held = [label in HELD_OUT for label in motion.labels]
    frames = np.nanmean(off, axis=1)
    return found, motion, {
        "mean_mm": float(np.nanmean(off)), "p95_mm": float(np.nanpercentile(off, 95)),
        "worst_frame_mm": float(frames.max()), "worst_frame": int(frames.argmax()),
        "largest_mm": float(np.nanmax(off)), "held_out_places_mm": float(np.nanmean(off[:, held])),
        "other_places_mm": float(np.nanmean(off[:, ~np.array(held)])),
        "subject_cpu_s": person - start, "frames_per_cpu_s": len(off) / (end - person),
        "settled": float(motion.converged.mean()), "trusted": float(motion.trusted[np.isfinite(off)].mean()),
        "beta_rms": float(np.sqrt((found.betas**2).mean())), "beta_largest": float(np.abs(found.betas).max())}


def picture(model: BodyModel, found: PersonFit, motion: Motion, markers: MarkerSequence, every: int, path: Path
            ) -> None:
    """Every so many frames with the markers as dots, from two sides."""
    from completion.motion_pictures import frame_panes
    from scanprep.pictures.scene import picture_panes
    from scanprep.pictures.sheets import save_png

    few = Motion(motion.poses[::every], motion.trans[::every], motion.betas, motion.rate / every,
                 motion.residuals[::every], motion.labels)
    some = markers.frames(slice(None, None, every))
    body, frames = model.subject(found.betas), np.arange(len(few.poses))
    panes = [pane for turn in (35.0, 215.0) for pane in frame_panes(few, body, some.positions, frames, turn)]
    save_png(path, picture_panes(panes, 300, len(frames)))


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("-m", "--model", required=True)
    parser.add_argument("-o", "--output", default="c3d.json")
    parser.add_argument("--layout", default="cmu41")
    parser.add_argument("--pictures", type=Path, help="folder for sheets of every hundredth frame")
    args = parser.parse_args()
    model = load_model(args.model)
    people = model.info.get("people_vertices")
    layout = load_layout(args.layout, model.template, None if people is None else np.array(people))
    shape, config = PersonConfig(), AnimateConfig()
    rows = []
    for path in sorted(args.folder.glob("*.c3d")):
        markers = read_markers(path)
        found, motion, row = follow(model, markers, layout, shape, config)
        rows.append({"file": path.name, "frames": len(markers.positions), **row})
        print(f"{path.name:16s} " + "  ".join(f"{name} {value:.3g}" for name, value in row.items()), flush=True)
        if args.pictures:
            args.pictures.mkdir(parents=True, exist_ok=True)
            picture(model, found, motion, markers, 100, args.pictures / f"{path.stem}.png")
    write_report(args.output, {
        "protocol": f"subject and motion from {args.layout}", "machine": machine(), "files": rows,
        "shape": dataclasses.asdict(shape), "animate": dataclasses.asdict(config)})


if __name__ == "__main__":
    main()
