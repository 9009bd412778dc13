"""Soft tissue: is it what moves, or noise? Markers left out of real files, and simulated people who breathe and shake.

    python tests/benchmarks/mosh_soft.py FOLDER -m MODEL.npz -o mosh_soft.json [--frames 150] [--files 02_05 ...]

Left out: poses and changes of some frames of each file are found again without a sixth of the markers, six times; the
error is that of the markers left out (mm, mean), beside that of markers that were used. `fixed` is the same with the
change held at nothing. Markers sit where stage 1 put them with all of them.

Simulated: a person of random betas moves as in the first file, with 1 mm of noise on the markers. His skin does
nothing, or swings around the breastbone (0.6 Hz) or around thigh and breastbone (4 and 3 Hz) along those directions of
the model that move little else. Given are the root mean square over the skin of the true change, of the error of the
change that was found (both in the mean pose), how much of the true change was found (1 is all), and the mean distance
of the whole moving skin from the true one (mm).
"""
from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from protocols import machine, write_report
from scipy.linalg import eigh

from completion.energy import lifted
from completion.mocap.files.markers import MarkerSequence, read_markers
from completion.mocap.marker_sets.layout import MarkerLayout
from completion.mocap.marker_sets.named import named_layout
from completion.mocap.mosh.mosh import MoshConfig
from completion.mocap.pose.follow import animate
from completion.mocap.pose.marked_body import supports
from completion.mocap.soft_tissue.changing_body import changing_bodies
from completion.mocap.soft_tissue.soft_tissue import SoftFollower, SoftTissueConfig, follow_soft_tissue
from completion.mocap.subject.person import find_person
from completion.motion import Motion
from model.body import BodyModel
from model.files import load_model

OURS, POSES = SoftTissueConfig(), MoshConfig().poses
PAPER = SoftTissueConfig.published()
CHOICES = {"paper, fixed": replace(PAPER, change=1e8), "paper": PAPER, "fixed": replace(OURS, change=1e8), "ours": OURS,
           "not smooth": replace(OURS, temporal_smoothness=0.0), "no skin": replace(OURS, skin=0.0)}
GROUPS = 6
NOISE = 0.001                        # metres


def left_out(model: BodyModel, markers: MarkerSequence, motion: Motion, layout: MarkerLayout, config: SoftTissueConfig
             ) -> dict[str, float]:
    """Errors, mm, of markers that were used and of those left out."""
    follower = SoftFollower(model, motion, markers, layout, config)
    order = np.random.default_rng(1).permutation(len(follower.rows))
    without, used = np.full(follower.targets.shape[:2], np.nan), np.nan
    for group in range(GROUPS + 1):
        mine, trusted = order[group::GROUPS] if group < GROUPS else order[:0], motion.trusted.copy()
        trusted[:, follower.rows[mine]] = False
        follower.motion = replace(motion, trusted=trusted)
        x, z, _ = follower.solve()
        off = np.linalg.norm(follower.body.positions(x, z) - follower.targets, axis=2)
        off[~motion.trusted[:, follower.rows]] = np.nan
        without[:, mine] = off[:, mine]
        used = np.nanmean(off)
    return {"used_mm": 1e3 * float(used), "left_out_mm": 1e3 * float(np.nanmean(without)),
            "left_out_median_mm": 1e3 * float(np.nanmedian(without))}


def swinging(model: BodyModel, slopes: np.ndarray, centre: np.ndarray, radius: float) -> np.ndarray:
    """The change of betas (K,) that moves the skin around a point by 1 m, root mean square, and the rest least."""
    near = np.exp(-((model.template.vertices - centre)**2).sum(axis=1) / radius**2)
    inside, outside = (np.einsum("n,ndk,ndl->kl", w, slopes, slopes) / len(w) for w in (near, 1 - near))
    direction = eigh(inside, outside + 1e-8 * np.eye(len(inside)))[1][:, -1]
    moved = ((slopes @ direction)**2).sum(axis=1)
    return np.asarray(direction / np.sqrt((near * moved).sum() / near.sum()))


def simulated(model: BodyModel, motion: Motion, layout: MarkerLayout, rng: np.random.Generator
              ) -> list[dict[str, object]]:
    """The rows of every case and choice."""
    t, slopes = motion.times, model.shape_jacobian(model.pose_mean)
    places = dict(zip(layout.labels, layout.place(model.template), strict=True))
    chest, thigh = (swinging(model, slopes, places[label], 0.11) for label in ("STRN", "RTHI"))
    cases = {"still": np.zeros((len(t), model.n_betas)), "breath": np.outer(0.008 * np.sin(1.2 * np.pi * t), chest),
             "shake": np.outer(0.010 * np.sin(8 * np.pi * t), thigh) + np.outer(0.006 * np.cos(6 * np.pi * t), chest)}
    own = np.pad(rng.normal(0, 0.7, min(40, model.n_betas)), (0, max(0, model.n_betas - 40)))
    ids, weights = supports(model.template, layout)
    rows: list[dict[str, object]] = []
    for name, change in cases.items():
        truth = changing_bodies(model, motion.poses, own + change, motion.trans)
        markers = lifted(np.einsum("lk,tlkd->tld", weights, truth[:, ids]), np.asarray(layout.distances))
        seen = MarkerSequence(markers + rng.normal(0, NOISE, markers.shape), layout.labels, motion.rate)
        start = animate(model.subject(own), seen, layout, POSES)
        for choice, config in CHOICES.items():
            soft = follow_soft_tissue(model, start, seen, layout, config)
            found = np.pad(soft.changes, ((0, 0), (0, model.n_betas - soft.changes.shape[1])))
            true, error = (np.einsum("tk,ndk->tnd", c, slopes) for c in (change, found - change))
            off = np.linalg.norm(soft.vertices(model) - truth, axis=2)
            rows.append({"case": name, "choice": choice, "true_rms_mm": _rms(true), "error_rms_mm": _rms(error),
                         "found_share": float(((error + true) * true).sum() / max((true**2).sum(), 1e-12)),
                         "skin_mean_mm": 1e3 * float(off.mean())})
            print(rows[-1], flush=True)
    return rows


def _rms(moved: np.ndarray) -> float:
    return 1e3 * float(np.sqrt((moved**2).sum(axis=2).mean()))


def main() -> None:
    """Run and print the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("-m", "--model", required=True)
    parser.add_argument("-o", "--output", default="mosh_soft.json")
    parser.add_argument("--layout", default="cmu41")
    parser.add_argument("--frames", type=int, default=150, help="of each file, from its middle")
    parser.add_argument("--files", nargs="*", help="stems; all of the folder when not given")
    args = parser.parse_args()
    model = load_model(args.model)
    layout, rows, simulation = named_layout(args.layout, model.template), [], None
    for path in sorted(args.folder.glob("*.c3d")):
        if args.files and path.stem not in args.files:
            continue
        whole = read_markers(path)
        first = max(0, (len(whole.positions) - args.frames) // 2)
        markers = whole.frames(slice(first, first + args.frames))
        person = find_person(model, whole, layout)
        motion = animate(model.subject(person.betas), markers, person.layout, POSES)
        if simulation is None:
            simulation = simulated(model, motion, layout, np.random.default_rng(0))
        for choice, config in CHOICES.items():
            rows.append({"file": path.name, "choice": choice,
                         **left_out(model, markers, motion, person.layout, config)})
            print(rows[-1], flush=True)
    write_report(args.output, {"protocol": "soft tissue: left-out markers and simulated change", "machine": machine(),
                               "left_out": rows, "simulated": simulation})


if __name__ == "__main__":
    main()
