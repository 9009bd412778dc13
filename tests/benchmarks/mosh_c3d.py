"""Real marker files by MoSh: person and motion without six markers, which are then looked for on the body.

    python tests/benchmarks/mosh_c3d.py FOLDER -m MODEL.npz -o mosh_c3d.json --pictures DIR

The six are in no stage; they are compared with where the layout file has them on the found body. For each file: the
mean distance of observed markers from the simulated ones with fixed shape and, with `--soft`, with a changing one; the
held-out markers, each by itself; seconds of one processor. `steady` is what is left of a held-out distance when the
mean displacement of each marker, in the frame of its part, is taken away: what body and pose are off, without where
somebody happened to put the marker.

Tuned on these four files: the places of loose markers in the layout `cmu41` and of feet and hands, from markers that
are not held out; the weights of the poses of every frame. The held-out ones got the mirror image of their partners, and
T10 went 23 mm up to the level of the sternum's tip, after pictures and figures with the held-out markers had been seen.
The weights of the person come from simulated men.
"""
from __future__ import annotations

import argparse
import dataclasses
import time
from pathlib import Path

import numpy as np
from c3d import HELD_OUT
from protocols import machine, write_report

from completion.mocap.files.markers import MarkerSequence, read_markers
from completion.mocap.marker_sets.layout import MarkerLayout
from completion.mocap.marker_sets.named import named_layout
from completion.mocap.mosh.mosh import MoshConfig
from completion.mocap.pose.follow import animate
from completion.mocap.pose.marked_body import MarkedBody
from completion.mocap.soft_tissue.soft_tissue import follow_soft_tissue
from completion.mocap.subject.person import PersonFit, find_person
from completion.motion import Motion
from model.body import BodyModel
from model.files import load_model


def held_out(model: BodyModel, motion: Motion, markers: MarkerSequence, layout: MarkerLayout) -> dict[str, object]:
    """Distances of the markers that were in no stage from where the layout has them on the body, millimetres."""
    labels = [label for label in layout.matched(markers.labels) if layout.aliases.get(label, label) in HELD_OUT]
    places = layout.select(labels)
    body = MarkedBody(model.subject(motion.betas), places, 0.3, 0.3)
    off = markers.select(labels).positions - body.positions(body.body.join(motion.poses, motion.trans))
    part = model.skeleton.part_of_vertex(model.template)[places.nearest]
    R = model.skeleton.part_rotations(motion.poses)[:, part]
    local = (np.swapaxes(R, -1, -2) @ off[..., None])[..., 0]
    steady = np.linalg.norm(local - np.nanmean(local, axis=0), axis=2)
    far = 1e3 * np.linalg.norm(off, axis=2)
    return {"held_out_mm": float(np.nanmean(far)), "held_out_steady_mm": 1e3 * float(np.nanmean(steady)),
            "each_mm": dict(zip(labels, np.nanmean(far, axis=0).round(1).tolist(), strict=True))}


def follow(model: BodyModel, markers: MarkerSequence, layout: MarkerLayout, config: MoshConfig
           ) -> tuple[PersonFit, Motion, dict]:
    """Person, motion and figures of one file."""
    start = time.process_time()
    person = find_person(model, markers, layout.without(HELD_OUT), config.person)
    found = time.process_time()
    motion = animate(model.subject(person.betas), markers, person.layout, config.poses)
    followed = time.process_time()
    off = 1e3 * motion.residuals
    frames = np.nanmean(off, axis=1)
    row = {"frames": len(off), "observed_mm": float(np.nanmean(off)), "p95_mm": float(np.nanpercentile(off, 95)),
           "worst_frame_mm": float(frames.max()), "worst_frame": int(frames.argmax()),
           **held_out(model, motion, markers, layout), "person_cpu_s": found - start,
           "frames_per_cpu_s": len(off) / (followed - found), "settled": float(motion.converged.mean()),
           "person_converged": person.converged, "beta_rms": float(np.sqrt((person.betas**2).mean())),
           "beta_largest": float(np.abs(person.betas).max()), "moved_mm": 1e3 * float(np.median(person.moved))}
    if config.soft_tissue:
        before = time.process_time()
        soft = follow_soft_tissue(model, motion, markers, person.layout, config.soft)
        row |= {"soft_observed_mm": 1e3 * float(np.nanmean(soft.motion.residuals)),
                "soft_frames_per_cpu_s": len(off) / (time.process_time() - before)}
    return person, motion, row


def picture(model: BodyModel, motion: Motion, markers: MarkerSequence, every: int, path: Path, columns: int = 10
            ) -> None:
    """Every so many frames with the markers as dots."""
    from completion.motion_pictures import picture_frames
    from scanprep.pictures.sheets import save_png

    subject, rows, step = model.subject(motion.betas), [], every * columns
    for start in range(0, len(motion.poses), step):
        some = slice(start, start + step, every)
        few = Motion(motion.poses[some], motion.trans[some], motion.betas, motion.rate / every,
                     motion.residuals[some], motion.labels)
        rows.append(picture_frames(few, subject, markers.positions[some], columns, 300))
    width = max(row.shape[1] for row in rows)
    white = 255 if rows[0].dtype == np.uint8 else 1
    save_png(path, np.concatenate([np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0)), constant_values=white)
                                   for row in rows]))


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("-m", "--model", required=True)
    parser.add_argument("-o", "--output", default="mosh_c3d.json")
    parser.add_argument("--layout", default="cmu41")
    parser.add_argument("--preset", choices=("default", "published"), default="default")
    parser.add_argument("--soft", action="store_true", help="also with a changing shape")
    parser.add_argument("--pictures", type=Path, help="folder for sheets of every fiftieth frame")
    args = parser.parse_args()
    model, presets = load_model(args.model), {"default": MoshConfig(), "published": MoshConfig.published()}
    config = dataclasses.replace(presets[args.preset], soft_tissue=args.soft)
    people = model.info.get("people_vertices")
    layout = named_layout(args.layout, model.template, None if people is None else np.array(people))
    rows: list[dict] = []
    for path in sorted(args.folder.glob("*.c3d")):
        markers = read_markers(path)
        _, motion, row = follow(model, markers, layout, config)
        rows.append({"file": path.name, **row})
        print("  ".join(f"{name} {value:.3g}" if isinstance(value, float) else f"{name} {value}"
                        for name, value in rows[-1].items()), flush=True)
        if args.pictures:
            args.pictures.mkdir(parents=True, exist_ok=True)
            picture(model, motion, markers, 50, args.pictures / f"{path.stem}.png")
    wanted = ("observed_mm", "soft_observed_mm", "held_out_mm", "held_out_steady_mm")
    names = [name for name in wanted if name in rows[0]]
    share = np.array([row["frames"] for row in rows]) / sum(row["frames"] for row in rows)
    mean = {name: {"of_files": float(np.mean([row[name] for row in rows])),
                   "of_frames": float(share @ [row[name] for row in rows])} for name in names}
    for name, both in mean.items():
        print(f"{name:24s} {both['of_files']:8.2f} {both['of_frames']:8.2f}")
    write_report(args.output, {"protocol": f"{args.layout} without {', '.join(HELD_OUT)}, preset {args.preset}",
                               "machine": machine(), "files": rows, "mean": mean, "config": dataclasses.asdict(config)})


if __name__ == "__main__":
    main()
