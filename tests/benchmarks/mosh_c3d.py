"""Real marker files by MoSh: person and motion without six markers, which are then looked for on the body.

    python tests/benchmarks/mosh_c3d.py FOLDER -m MODEL.npz -o mosh_c3d.json --pictures DIR

The six are in no stage; they are compared with where the layout file has them on the found body. For each file: the
mean distance of observed markers from the simulated ones with fixed shape and, with `--soft`, with a changing one; the
held-out markers, each by itself; seconds of one processor. `calibrated` finds the place of each held-out marker on the
finished body, fixed in the frame of a triangle, from 12 frames spread over the poses, and is the error in all other
frames: what body and pose are off, without where somebody happened to put the marker.

Tuned on these four files: the places of loose markers in the layout `cmu41` and of feet and hands, from markers that
are not held out; the weights of the poses of every frame. The held-out ones got the mirror image of their partners, and
T10 went 23 mm up to the level of the sternum's tip, after pictures and figures with the held-out markers had been seen.
On the built-in people `cmu41` has the markers where this layout has them on real men, brought there by registration
(trunk, head) and by men's motion with these markers (limbs); hips and T10 stayed. The weights of the person are rounded
variances of what is left of all markers of these files, and were checked on simulated men (mosh_people.py).

Each half of a file is also taken as a recording of its own: how far the two bodies are apart, standing in the rest pose
and with the pose of one fitted to the other, and how much their stature differs.
"""
from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from c3d import HELD_OUT
from mosh_people import apart, at_rest
from protocols import machine, write_report

from completion.mocap.files.markers import MarkerSequence, read_markers
from completion.mocap.marker_sets.layout import MarkerLayout
from completion.mocap.marker_sets.named import load_layout
from completion.mocap.mosh.mosh import MoshConfig
from completion.mocap.pose.follow import animate
from completion.mocap.pose.marked_body import supports
from completion.mocap.soft_tissue.follow import follow_soft_tissue
from completion.mocap.soft_tissue.soft_tissue import SoftTissue
from completion.mocap.subject.attachment import LatentMarkers, latent_markers
from completion.mocap.subject.person import PersonFit, find_person, spread_frames
from completion.motion import Motion
from model.body import BodyModel
from model.files import load_model
from model.fitting.energy import rise_above_skin
from model.fitting.vertices import fit_pose
from model.measurement.find import find_tapes
from model.measurement.measure import measure

CALIBRATED = 12                      # frames that tell where a held-out marker sits
MEASURES = ("stature", "chest_girth", "waist_girth", "hip_girth")


def held_out(model: BodyModel, motion: Motion, soft: SoftTissue | None, markers: MarkerSequence, layout: MarkerLayout
             ) -> dict[str, object]:
    """How far the body is from the markers that were in no stage, millimetres: plain, and calibrated."""
    assert motion.betas is not None, "markers were held out of a person"
    wanted = {layout.aliases.get(label, label) for label in HELD_OUT}
    labels = tuple(label for label in layout.match_labels(markers.labels, 0)
                   if layout.aliases.get(label, label) in wanted)
    seen, subject = markers.select(labels).positions, model.subject(motion.betas)
    known = [label for label in markers.labels if label not in labels]
    # simulated markers of the layout's places on the fixed shape
    places = layout.select(labels)
    ids, weights = supports(model.template, places)
    lift = np.asarray(places.distances)
    points = model.points(ids, weights, len(motion.betas)).operator(motion.betas)
    plain = np.linalg.norm(rise_above_skin(points.evaluate(motion.poses, motion.trans), lift) - seen, axis=2)
    frames = spread_frames(markers.select(known).positions, CALIBRATED)

    def fixed(ids: np.ndarray) -> np.ndarray:
        return subject.points(ids).evaluate(motion.poses, motion.trans)

    near = calibrated(model, fixed, motion.vertices(subject, frames), seen, frames)
    row: dict[str, object] = {
        "held_out_mm": mean_mm(plain), "calibrated_mm": mean_mm(near),
        "each_mm": dict(zip(labels, (1e3 * np.nanmean(plain, axis=0)).round(1).tolist(), strict=True)),
        "each_calibrated_mm": dict(zip(labels, (1e3 * np.nanmean(near, axis=0)).round(1).tolist(), strict=True))}
    if soft is None:
        return row
    soft_points = soft.points(model, ids, weights)
    soft_plain = np.linalg.norm(rise_above_skin(soft_points, lift) - seen, axis=2)
    near = calibrated(model, lambda ids: soft.points(model, ids[:, None], np.ones((len(ids), 1))),
                      soft.vertices(model, frames), seen, frames)
    return row | {"soft_held_out_mm": mean_mm(soft_plain), "soft_calibrated_mm": mean_mm(near),
                  "soft_each_calibrated_mm": dict(zip(labels, (1e3 * np.nanmean(near, axis=0)).round(1).tolist(),
                                                      strict=True))}


def calibrated(model: BodyModel, places: Callable[[np.ndarray], np.ndarray], bodies: np.ndarray, seen: np.ndarray,
               frames: np.ndarray) -> np.ndarray:
    """How far markers seen (T, H, 3) are from fixed places on the body, metres, NaN in the frames that tell the places.

    Each hangs on the triangle, of those nearest to it in these frames (n,), in whose frame it moves least; `bodies`
    (n, N, 3) are the meshes there, `places` tells where vertices are in all frames.
    """
    out = np.full(seen.shape[:2], np.nan)
    alone = LatentMarkers("triangle", np.arange(3)[:, None], np.ones((3, 1)), np.arange(3)[None])
    for h in range(seen.shape[1]):
        there = ~np.isnan(seen[frames, h, 0])
        meshes, points = bodies[there], seen[frames[there], h]
        hung = {hanging.corners.tobytes(): hanging for hanging in (
            latent_markers(model.template.with_vertices(v), p[None]) for v, p in zip(meshes, points, strict=True))}
        best = np.inf
        for hanging in hung.values():
            local = np.array([hanging.coefficients(v, p[None]) for v, p in zip(meshes, points, strict=True)])
            if local.var(axis=0).sum() < best:
                best, where, corners = local.var(axis=0).sum(), local.mean(axis=0), hanging.corners[0]
        if np.isfinite(best):
            out[:, h] = np.linalg.norm(alone.places(places(corners), where)[:, 0] - seen[:, h], axis=1)
    out[frames] = np.nan
    return out


def mean_mm(distances: np.ndarray) -> float:
    return 1e3 * float(np.nanmean(distances))


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
           "person_cpu_s": found - start,
           "frames_per_cpu_s": len(off) / (followed - found), "settled": float(motion.converged.mean()),
           "person_converged": person.converged, "beta_rms": float(np.sqrt((person.betas**2).mean())),
           "beta_largest": float(np.abs(person.betas).max()), "moved_mm": 1e3 * float(np.median(person.moved))}
    soft = None
    if config.soft_tissue:
        before = time.process_time()
        soft = follow_soft_tissue(model, motion, markers, person.layout, config.soft)
        row |= {"soft_observed_mm": 1e3 * float(np.nanmean(soft.motion.residuals)),
                "soft_frames_per_cpu_s": len(off) / (time.process_time() - before)}
    return person, motion, row | held_out(model, motion, soft, markers, layout)


def two_halves(model: BodyModel, markers: MarkerSequence, layout: MarkerLayout, config: MoshConfig
               ) -> dict[str, object]:
    """The person of the whole file in figures, and what the persons of its two halves differ by, millimetres."""
    middle = len(markers.positions) // 2
    halves = [MarkerSequence(some, markers.labels, markers.rate)
              for some in (markers.positions[:middle], markers.positions[middle:])]
    subjects = [model.subject(find_person(model, each, layout, config.person).betas) for each in (markers, *halves)]
    bodies = [at_rest(subject) for subject in subjects]
    row: dict[str, object] = {"halves_mm": apart(*bodies[1:]),
                              "halves_fitted_mm": 1e3 * fit_pose(subjects[2], bodies[1]).mean}
    if "landmarks" not in model.info:
        return row
    tapes = find_tapes(model.template, model.info["landmarks"])
    whole, one, two = (measure(body, tapes, only=MEASURES).values for body in bodies)
    return row | {"halves_stature_mm": 1e3 * abs(one["stature"] - two["stature"]),
                  "measures_mm": {name: round(1e3 * value) for name, value in whole.items()}}


def picture(model: BodyModel, motion: Motion, markers: MarkerSequence, every: int, path: Path, columns: int = 10
            ) -> None:
    """Every so many frames with the markers as dots."""
    from completion.motion_pictures import frame_panes
    from scanprep.pictures.scene import picture_panes
    from scanprep.pictures.sheets import save_png

    subject, rows, step = model.subject(motion.betas), [], every * columns
    for start in range(0, len(motion.poses), step):
        some = slice(start, start + step, every)
        few = Motion(motion.poses[some], motion.trans[some], motion.betas, motion.rate / every,
                     motion.residuals[some], motion.labels)
        rows.append(picture_panes(frame_panes(few, subject, markers.positions[some], np.arange(len(few.poses))), 300))
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
    model, presets = load_model(args.model), {"default": MoshConfig(), "published": MoshConfig.from_paper()}
    config = dataclasses.replace(presets[args.preset], soft_tissue=args.soft)
    people = model.info.get("people_vertices")
    layout = load_layout(args.layout, model.template, None if people is None else np.array(people))
    rows: list[dict] = []
    for path in sorted(args.folder.glob("*.c3d")):
        markers = read_markers(path)
        _, motion, row = follow(model, markers, layout, config)
        rows.append({"file": path.name, **row, **two_halves(model, markers, layout, config)})
        print("  ".join(f"{name} {value:.3g}" if isinstance(value, float) else f"{name} {value}"
                        for name, value in rows[-1].items()), flush=True)
        if args.pictures:
            args.pictures.mkdir(parents=True, exist_ok=True)
            picture(model, motion, markers, 50, args.pictures / f"{path.stem}.png")
    wanted = ("observed_mm", "soft_observed_mm", "held_out_mm", "soft_held_out_mm", "calibrated_mm",
              "soft_calibrated_mm")
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
