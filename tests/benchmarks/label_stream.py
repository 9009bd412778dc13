"""Labels while the points come in: share that is right, processor time, and people who leave and come back.

    python tests/benchmarks/label_stream.py FOLDER -o label_stream.json [--files basketball 85_02] [--rates 120]

FOLDER has real labelled recordings, of which only the points are given, in another order in every frame. The person and
the marker places are known: `find_person` has them from the labels of the first half. `disturbed` is a fifth of all
observations gone and five ghosts a frame in the box around the points. Lower rates leave frames out, higher ones are
interpolated by cubics. With 67 markers, poses of `animate` on the recording are given to the person with the layout
`mosh67`; each marker is 4 mm beside its place, the camera has 0.5 mm of noise.

Who returns: half a second of the recording, five seconds without anybody, then a second of another part of it, turned
about the vertical and metres away. Counted are markers under their own label among those that are there; a step that
searches for the body or a limb is slow (above 50 ms), and not in the frames per second of the median.
"""
from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from protocols import machine, write_report

from completion.mocap.files.markers import MarkerSequence, read_markers
from completion.mocap.labelling.stream import LabelledFrame, LabelStream
from completion.mocap.marker_sets.layout import MarkerLayout
from completion.mocap.marker_sets.named import choose_layout, load_layout
from completion.mocap.pose.follow import animate
from completion.mocap.subject.person import find_person
from model.body import BodyModel
from model.files import load_model
from model.linear import Subject
from scanprep.geometry import rotations

MISSING, GHOSTS = 0.2, 5             # share of observations that are gone, and points a frame that are no marker
WORN, NOISE = 0.004, 0.0005          # metres, of simulated markers
RETURNS = 6                          # of every file
SLOW = 0.05                          # seconds of processor time of a frame that holds a search


@dataclass(frozen=True, eq=False)
class Take:
    """A known person with markers (T, L, 3), metres, `rate` frames per second."""

    subject: Subject
    layout: MarkerLayout
    markers: np.ndarray
    rate: float


def recorded(model: BodyModel, path: Path) -> Take:
    """A recording; its person is found by the labels of the first half."""
    whole = read_markers(path)
    rows, worn = choose_layout(model, "cmu41", whole.labels)[0].match_columns(whole.labels)
    markers = whole.positions[:, rows]
    fit = find_person(model, MarkerSequence(markers[:len(markers) // 2], worn.labels, whole.rate), worn)
    return Take(model.subject(fit.betas), fit.layout, markers, whole.rate)


def simulated(model: BodyModel, take: Take) -> Take:
    """The same motion with 67 markers."""
    layout = load_layout("mosh67", model.template, np.asarray(model.info["people_vertices"]))
    sequence = MarkerSequence(take.markers, take.layout.labels, take.rate)
    motion, rng = animate(take.subject, sequence, take.layout), np.random.default_rng(0)
    markers = np.stack([layout.place(take.subject.template.with_vertices(take.subject.vertices(pose, trans)))
                        for pose, trans in zip(motion.poses, motion.trans, strict=True)])
    markers += rng.normal(0, WORN, markers.shape[1:]) + rng.normal(0, NOISE, markers.shape)
    return Take(take.subject, layout, markers, take.rate)


def resampled(take: Take, rate: float) -> Take:
    """At another rate: frames left out, or between others."""
    times = np.arange(0, len(take.markers) - 1, take.rate / rate)
    i, w = np.floor(times).astype(int), (times % 1)[:, None, None]
    a, b, c, d = (take.markers[np.clip(i + k, 0, len(take.markers) - 1)] for k in (-1, 0, 1, 2))
    between = b + 0.5 * w * (c - a + w * (2 * a - 5 * b + 4 * c - d + w * (3 * (b - c) + d - a)))
    return Take(take.subject, take.layout, np.where(w > 1e-9, between, b), rate)


def shuffled(markers: np.ndarray, disturb: bool, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Points (T, N, 3) in any order, and which marker (T, N) each is, -1 of a ghost, -2 of none."""
    points, (T, L) = markers, markers.shape[:2]
    if disturb:
        low, high = np.nanmin(markers, axis=1, keepdims=True), np.nanmax(markers, axis=1, keepdims=True)
        points = np.where(rng.random((T, L, 1)) < MISSING, np.nan, markers)
        points = np.concatenate([points, low + rng.random((T, GHOSTS, 3)) * (high - low)], axis=1)
    names = np.broadcast_to(np.r_[np.arange(L), np.full(points.shape[1] - L, -1)], points.shape[:2])
    names = np.where(np.isnan(points[..., 0]), -2, names)
    order = np.argsort(rng.random(names.shape), axis=1)
    return np.take_along_axis(points, order[..., None], axis=1), np.take_along_axis(names, order, axis=1)


def push_all(take: Take, points: np.ndarray) -> tuple[list[LabelledFrame], np.ndarray]:
    """The frames of a new stream, and the processor's seconds of each."""
    stream, frames, seconds = LabelStream(take.subject, take.layout, take.rate), [], np.empty(len(points))
    for t, each in enumerate(points):
        begin = time.process_time()
        frames.append(stream.push(each))
        seconds[t] = time.process_time() - begin
    return frames, seconds


def score(frames: list[LabelledFrame], names: np.ndarray) -> dict[str, float]:
    """Per cent of the markers under their own label, of labels wrong and on ghosts, and of both that are doubted."""
    columns = np.stack([frame.columns for frame in frames])
    labels = np.where(columns >= 0, np.take_along_axis(names, np.maximum(columns, 0), axis=1), -2)
    right = labels == np.arange(labels.shape[1])
    wrong = (labels > -2) & ~right
    doubted = np.stack([frame.confidence for frame in frames]) < 0.9
    return {"right": 100 * right.sum() / (names >= 0).sum(), "wrong": 100 * wrong.sum() / (labels > -2).sum(),
            "ghosts": 100 * (labels == -1).sum() / (labels > -2).sum(),
            "wrong_doubted": 100 * doubted[wrong].mean() if wrong.any() else 100.0,
            "right_doubted": 100 * doubted[right].mean()}


def followed(file: str, take: Take, disturb: bool) -> dict:
    """A whole recording."""
    points, names = shuffled(take.markers, disturb, np.random.default_rng(0))
    frames, seconds = push_all(take, points)
    return {"file": file, "markers": len(take.layout.labels), "rate": take.rate, "disturbed": disturb,
            "frames": len(frames), **score(frames, names), "per_cpu_s": 1 / float(np.median(seconds)),
            "per_cpu_s_all": len(seconds) / float(seconds.sum()), "slow": int((seconds > SLOW).sum()),
            "slowest_s": float(seconds.max())}


def returns(file: str, take: Take, disturb: bool) -> dict:
    """People who leave the volume and come back elsewhere, turned, in another pose."""
    n, away = round(take.rate), round(5 * take.rate)
    starts, rows = np.linspace(0, len(take.markers) - n - 1, RETURNS + 1).astype(int), []
    for k in range(RETURNS):
        rng = np.random.default_rng(k)
        first, second = (take.markers[starts[i]:starts[i] + n] for i in (k, (k + 3) % (RETURNS + 1)))
        R, centre = rotations.exp(np.array([0, 0, rng.uniform(-np.pi, np.pi)])), np.nanmean(second, axis=(0, 1))
        second = (second - centre) @ R.T + centre + np.array([*rng.normal(0, 2, 2), 0])
        (before, _), (after, names) = shuffled(first[:n // 2], disturb, rng), shuffled(second, disturb, rng)
        empty = np.full((away, *before.shape[1:]), np.nan)
        if disturb:
            empty[:, :GHOSTS] = np.nanmin(first, axis=(0, 1)) + 2 * rng.random((away, GHOSTS, 3))
        frames, seconds = push_all(take, np.concatenate([before, empty, after]))
        begin = len(before) + away
        found = [frame.found for frame in frames[begin:]]
        rows.append({"frames": found.index(True) if any(found) else n, "right": score(frames[begin:], names)["right"],
                     "labels_away": sum(int((frame.columns >= 0).sum()) for frame in frames[len(before):begin]),
                     "search_s": float(seconds[begin:].max())})
    return {"file": file, "markers": len(take.layout.labels), "disturbed": disturb, "returns": rows}


def main() -> None:
    """Run and print the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("-o", "--output", default="label_stream.json")
    parser.add_argument("--files", nargs="+", default=["basketball", "02_05", "85_02", "01_01"])
    parser.add_argument("--rates", nargs="+", type=float, default=[30.0, 120.0, 500.0], help="120 is as recorded")
    args = parser.parse_args()
    model, rows, back = load_model("people"), [], []
    for file in args.files:
        take = recorded(model, args.folder / f"{file}.c3d")
        takes = [take if rate == take.rate else resampled(take, rate) for rate in args.rates]
        for one in (*takes, simulated(model, take)):
            for disturb in (False, True):
                rows.append(followed(file, one, disturb))
                print(rows[-1], flush=True)
        for disturb in (False, True):
            back.append(returns(file, take, disturb))
            print(back[-1], flush=True)
    write_report(args.output, {"protocol": "known person, shuffled points", "machine": machine(), "rows": rows,
                               "returns": back})


if __name__ == "__main__":
    main()
