"""Marker tracking by pymomentum and by scapekit: the same recordings and the same 35 markers, in one run.

    python tests/benchmarks/peer_markers.py FOLDER -m MODEL.npz [-o peer_markers.json] [--files 01_01,basketball]

Needs pymomentum-core (`pip install scapekit[benchmarks]`). Both find person and frames from the recording alone;
six markers are in no stage. Of `scapekit` it is `mosh` with a fixed shape and its own settings.

What pymomentum was given. Its package brings no character, so it has ours: the joints of the mean person of the model,
y up, in centimetres; three rotations at every joint, place and turn of the root, one global scale, and one length for
every bone, the same left and right; a locator for every marker, in the frame of the part and at the place where our
layout has it on the mean person. `process_markers` with `calibrate=True` then finds proportions, places of the locators
and all frames. With its defaults the bones have no limits and the locators are free.

The second row is the best of twenty that we tried for it on 01_01.c3d, by the used and the held-out markers: bones at
most 15% longer or shorter, the whole body between 0.8 and 1.2 times as large, every tenth frame a candidate when the
frames of the calibration are chosen greedily, smoothing 0.1. Tried and lost: bones within 30%; locators held at their
places (weights 1e-5 to 1: a little better held out, the used markers up to three times as far); locators that follow
the skin by blend weights; the ranges of angles of our 71 poses as limits; smoothing 0.3 and 1; 300 frames and six
rounds of calibration; a robust loss (`loss_alpha=1`, which lost the body). Markers turned to face as the character does
made no difference. It has no prior of shapes or poses, which is what ours has learned; a rig made by hand with
anatomical limits, or with fewer degrees of freedom, may do better than this one. For ours, the weights of the poses and
the layout were chosen with the 35 markers of these four files.

Told are, in millimetres: the distance of every marker that was used from where the solved body has it; and of the
held-out markers, calibrated: a marker's place in the frame of its part is the mean over 12 frames in which the markers
stand to each other in many ways, the same for both; the error is the distance from there in all other frames. Its part
is the one that has it in our layout or one that adjoins, where it moves least in the 12 frames, for each tool by
itself. `acceleration` is the root of the mean squared change of the joints' angular velocities: how smooth a motion is.
Seconds are those of the processor, all threads, reading files and building the rig left out.
"""
from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from alone import Outcome, alone, processor_seconds
from c3d import HELD_OUT
from peer_momentum import Given, Markers, solve
from protocols import machine, write_report
from scipy.spatial.transform import Rotation

from completion.mocap.files.markers import MarkerSequence, read_markers
from completion.mocap.marker_sets.layout import MarkerLayout
from completion.mocap.marker_sets.named import load_layout
from completion.mocap.mosh.mosh import MoshConfig, mosh
from completion.mocap.pose.marked_body import MarkedBody
from completion.mocap.subject.person import spread_frames
from model.body import BodyModel
from model.files import load_model
from model.rig import make_rig
from scanprep.geometry import rotations
from scanprep.geometry.format_glb import turn_up
from scanprep.pictures.camera import guess_upright
from scanprep.skeleton.tree import Skeleton

CALIBRATED = 12                      # frames that tell where a held-out marker is
CM = 100.0                           # centimetres a metre
TUNED = Given(lengths=0.15, size=0.3, calibration={"greedy_sampling": 10}, tracking={"smoothing": 0.1})


class Solved(NamedTuple):
    """A recording as a tool explains it."""

    places: np.ndarray               # (T, L, 3) metres, of the markers that were used
    rotations: np.ndarray            # (T, J, 3, 3) of the parts in the world
    joints: np.ndarray               # (T, J, 3) metres
    cpu_s: float


def fixed_shape(model_file: str, markers: MarkerSequence, layout: MarkerLayout) -> tuple:
    """`mosh` with a fixed shape, as the fields of `Solved`."""
    model = load_model(model_file)
    start = processor_seconds()
    found = mosh(markers, model, layout, MoshConfig(soft_tissue=False))
    cpu_s, motion, subject = processor_seconds() - start, found.motions[0], model.subject(found.betas)
    body = MarkedBody(subject, found.layout.select(layout.match_labels(markers.labels)), 0.0, 0.0)
    return (body.positions(body.body.join(motion.poses, motion.trans)), model.skeleton.part_rotations(motion.poses),
            subject.joints(motion.poses, motion.trans), cpu_s)


def by_scapekit(limit: float, model_file: str, markers: MarkerSequence, layout: MarkerLayout) -> Solved | Outcome:
    """Our own, or why there is none."""
    done = alone(limit, fixed_shape, model_file, markers, layout)
    return done if done.why else Solved(*done.value)


def by_momentum(given: Given, limit: float, model_file: str, markers: MarkerSequence, layout: MarkerLayout
                ) -> Solved | Outcome:
    """pymomentum on the joints of our mean person, or why there is none."""
    model = load_model(model_file)
    up = guess_upright(model.template)[0]
    U, labels, rig = turn_up(up), layout.match_labels(markers.labels), make_rig(model,
                                                                                np.zeros(model.n_betas)).with_up(up)
    worn, skeleton = layout.select(labels), rig.skeleton
    done = alone(limit, solve, Markers(
        skeleton.names, skeleton.parents, CM * skeleton.joints, labels,
        skeleton.part_of_vertex(rig.mesh)[worn.nearest], CM * worn.place(rig.mesh),
        CM * markers.select(labels).positions @ U.T), given)
    if done.why:
        return done
    places, q, joints, cpu_s = done.value
    R = Rotation.from_quat(q.reshape(-1, 4)).as_matrix().reshape(*q.shape[:-1], 3, 3)
    return Solved(places @ U / CM, U.T @ R, joints @ U / CM, cpu_s)


TOOLS: dict[str, Callable[[float, str, MarkerSequence, MarkerLayout], Solved | Outcome]] = {
    "scapekit": by_scapekit, "pymomentum, defaults": partial(by_momentum, Given()),
    "pymomentum, tuned on 01_01": partial(by_momentum, TUNED)}


def measure(found: Solved, model: BodyModel, markers: MarkerSequence, layout: MarkerLayout) -> dict[str, object]:
    """The figures of a tool and a recording."""
    seen = markers.select(layout.without(HELD_OUT).match_labels(markers.labels)).positions
    off = 1e3 * np.linalg.norm(found.places - seen, axis=2)
    held = [label for label in layout.match_labels(markers.labels) if layout.aliases.get(label, label) in HELD_OUT]
    part = model.skeleton.part_of_vertex(model.template)[layout.select(held).nearest]
    apart, parts = calibrated(found, model.skeleton, part, markers.select(held).positions,
                              spread_frames(seen, CALIBRATED))
    return {"frames": len(seen), "markers": int(np.isfinite(off).sum()), "used_mm": float(np.nanmean(off)),
            "used_p95_mm": float(np.nanpercentile(off, 95)), "held_out_mm": float(np.nanmean(apart)),
            "held_out_p95_mm": float(np.nanpercentile(apart, 95)),
            "each_mm": dict(zip(held, np.nanmean(apart, axis=0).round(1).tolist(), strict=True)),
            "parts": {label: model.skeleton.names[p] for label, p in zip(held, parts, strict=True)},
            "acceleration": angular_acceleration(model.skeleton, found.rotations, markers.rate),
            "cpu_s": found.cpu_s, "frames_per_cpu_s": len(seen) / found.cpu_s}


def calibrated(found: Solved, skeleton: Skeleton, part: np.ndarray, held: np.ndarray, known: np.ndarray
               ) -> tuple[np.ndarray, np.ndarray]:
    """(T', H) millimetres in the frames that are not `known`, of held-out markers (T, H, 3), and the parts (H,).

    A marker is on the part (H,) that has it in the layout, or on one that adjoins: where it moves least when `known`.
    """
    local = np.einsum("tjba,tjhb->tjha", found.rotations, held[:, None] - found.joints[:, :, None])
    places = np.nanmean(local[known], axis=0)                                                   # (J, H, 3)
    moves = np.nanmean(np.linalg.norm(local[known] - places, axis=3), axis=0)
    links = np.eye(len(places), dtype=bool)
    links[np.arange(1, len(places)), skeleton.parents[1:]] = True
    best = np.where((links | links.T)[:, part], moves, np.inf).argmin(axis=0)
    rest, each = np.setdiff1d(np.arange(len(held)), known), np.arange(len(part))
    return 1e3 * np.linalg.norm(local[rest][:, best, each] - places[best, each], axis=2), best


def angular_acceleration(skeleton: Skeleton, R: np.ndarray, rate: float) -> float:
    """Root mean square over joints and frames, radians per second squared, of part rotations (T, J, 3, 3)."""
    relative = np.swapaxes(R[:, skeleton.parents[1:]], -1, -2) @ R[:, 1:]
    velocity = rate * rotations.log(np.swapaxes(relative[:-1], -1, -2) @ relative[1:])
    return float(np.sqrt((((rate * np.diff(velocity, axis=0))**2).sum(axis=-1)).mean()))


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("-m", "--model", required=True)
    parser.add_argument("-o", "--output", default="peer_markers.json")
    parser.add_argument("--layout", default="cmu41")
    parser.add_argument("--files", default="", help="names of recordings, with commas; else all")
    parser.add_argument("--only", default="", help="part of a tool's name")
    parser.add_argument("--limit", type=float, default=1800.0, help="seconds after which a tool is stopped")
    args = parser.parse_args()
    model, rows = load_model(args.model), []
    people = model.info.get("people_vertices")
    layout = load_layout(args.layout, model.template, None if people is None else np.array(people))
    for path in sorted(args.folder.glob("*.c3d")):
        if args.files and path.stem not in args.files.split(","):
            continue
        markers = read_markers(path)
        for name, tool in TOOLS.items():
            if args.only not in name:
                continue
            done = tool(args.limit, args.model, markers, layout.without(HELD_OUT))
            told = measure(done, model, markers, layout) if isinstance(done, Solved) else done.why
            rows.append({"file": path.name, "tool": name, **told})
            print("  ".join(f"{key} {value:.3g}" if isinstance(value, float) else f"{key} {value}"
                            for key, value in rows[-1].items()), flush=True)
            write_report(args.output, {"protocol": f"{args.layout} without {', '.join(HELD_OUT)}",
                                       "machine": machine(), "tuned": asdict(TUNED), "rows": rows})


if __name__ == "__main__":
    main()
