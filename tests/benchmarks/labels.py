"""Labels of markers without names, on recordings whose labels were taken away.

    python tests/benchmarks/labels.py FOLDER -o labels.json
    python tests/benchmarks/labels.py FOLDER --files basketball --stages shuffled stream -o labels.json
    python tests/benchmarks/labels.py FOLDER --files 02_05 --stages memory --minutes 10 -o label_memory.json

Of FOLDER the recordings *.c3d with the markers of `cmu41`; the person is not known. Stages:

shuffled : the points of every frame in another order, so that there are no tracks
tracks : columns as they are, in another order
corrupted : 20% of the observations gone, 5 ghosts in every frame, and another order of columns every second
stream : shuffled, frame by frame, by `LabelStream`, of the person found from the first half of the labelled recording
mosh : the mean distance of markers that `mosh` leaves on the labels of `corrupted`, without its ghosts, over that on
    the true labels of the same observations
two : each recording with the next, which come near, turn half about each other, and part; shuffled
memory : `shuffled` repeated to so many minutes; the largest resident memory

`right` is the share of the labelled observations that got their label, `precision` that of the labels that are right,
`ghosts` that of ghosts that stayed without one; `sure_wrong` that of labels of confidence 0.9 and more that are wrong.
"""
from __future__ import annotations

import argparse
import resource
import time
from pathlib import Path

import numpy as np
from protocols import machine, write_report

from completion import LabelStream, MarkerLayout, MarkerSequence, find_person, mosh, read_markers
from completion.mocap.labelling.label import label_markers, label_people
from completion.mocap.marker_sets.named import choose_layout
from model import BodyModel, load_model

STAGES = ("shuffled", "tracks", "corrupted", "stream", "mosh", "two")
GHOSTS, GONE, RATE = 5, 0.2, 120.0


def spoil(places: np.ndarray, rate: float, stage: str) -> tuple[np.ndarray, np.ndarray]:
    """Points (T, C, 3) in an order of their own, and the marker (T, C) each is, -1 of a ghost, -2 of none."""
    T, L = places.shape[:2]
    rng = np.random.default_rng(0)
    truth = np.tile(np.arange(L), (T, 1))
    if stage == "corrupted":
        places = np.where(rng.random((T, L, 1)) < GONE, np.nan, places)
        low, high = np.nanmin(places, axis=1), np.nanmax(places, axis=1)
        ghosts = low[:, None] + rng.random((T, GHOSTS, 3)) * (high - low)[:, None]
        places = np.concatenate([places, ghosts], axis=1)
        truth = np.concatenate([truth, np.full((T, GHOSTS), -1)], axis=1)
    truth = np.where(np.isfinite(places[..., 0]), truth, -2)
    # how many frames the order of columns lasts
    lasts = {"tracks": T, "corrupted": round(rate)}.get(stage, 1)
    orders = np.stack([rng.permutation(places.shape[1]) for _ in range(-(-T // lasts))])
    order = orders[np.arange(T) // lasts]
    return np.take_along_axis(places, order[..., None], axis=1), np.take_along_axis(truth, order, axis=1)


def score(columns: np.ndarray, truth: np.ndarray, confidence: np.ndarray) -> dict[str, float]:
    """Shares of right labels."""
    frames, rows = np.nonzero(columns >= 0)
    given = columns[frames, rows]
    right = truth[frames, given] == rows
    sure = confidence[frames, rows] >= 0.9
    taken = np.zeros(truth.shape, dtype=bool)
    taken[frames, given] = True
    out = {"right": right.sum() / (truth >= 0).sum(), "precision": right.mean(), "sure_wrong": (~right[sure]).mean()}
    return out | ({"ghosts": (~taken[truth == -1]).mean()} if (truth == -1).any() else {})


def unnamed(points: np.ndarray, rate: float) -> MarkerSequence:
    return MarkerSequence(points, tuple(f"*{i}" for i in range(points.shape[1])), rate)


def label(model: BodyModel, layout: MarkerLayout, places: np.ndarray, rate: float, stage: str) -> dict:
    """A stage of one recording."""
    points, truth = spoil(places, rate, stage)
    start = time.process_time()
    if stage == "stream":
        fit = find_person(model, MarkerSequence(places[:len(places) // 2], layout.labels, rate), layout)
        stream, columns = LabelStream(model.subject(fit.betas), fit.layout, rate), np.full(places.shape[:2], -1)
        confidence, seconds = np.zeros(columns.shape), np.zeros(len(points))
        for t, frame in enumerate(points):
            start = time.process_time()
            told = stream.push(frame)
            seconds[t] = time.process_time() - start
            columns[t], confidence[t] = told.columns, told.confidence
        speed = {"frames_per_s": 1 / float(np.median(seconds)), "frames_per_s_all": len(points) / float(seconds.sum())}
        return {**score(columns, truth, confidence), **speed}
    found = label_markers(model, unnamed(points, rate), layout)
    return {**score(found.columns, truth, found.confidence), "verdict": found.judgement.verdict,
            "frames_per_s": len(points) / (time.process_time() - start)}


def mosh_ratio(model: BodyModel, layout: MarkerLayout, places: np.ndarray, rate: float) -> dict:
    """What `mosh` leaves on labels that were found, over what it leaves on the true ones, on the true observations."""
    points, truth = spoil(places, rate, "corrupted")
    found = label_markers(model, unnamed(points, rate), layout).markers
    true = np.full(places.shape, np.nan)
    frames, columns = np.nonzero(truth >= 0)
    true[frames, truth[frames, columns]] = points[frames, columns]
    both = found, MarkerSequence(true, layout.labels, rate)
    motions = [mosh(markers, model, layout).motions[0] for markers in both]
    # both by the true observations, whatever they were labelled
    seen = np.isfinite(true[..., 0]) & np.isfinite(motions[0].residuals) & np.isfinite(motions[1].residuals)
    off = [1000 * float(motion.residuals[seen].mean()) for motion in motions]
    return {"labelled_mm": off[0], "true_mm": off[1], "ratio": off[0] / off[1]}


def two_people(model: BodyModel, layouts: list[MarkerLayout], places: list[np.ndarray], rate: float) -> dict:
    """Two recordings in one volume, at the nearest some centimetres apart."""
    T = min(map(len, places))
    s = np.linspace(0, 1, T)
    away = np.interp(s, [0, 0.3, 0.7, 1], [1.2, 0.35, 0.35, 1.2])[:, None]
    turn = np.interp(s, [0, 0.35, 0.65, 1], [0, 0, np.pi, np.pi])
    way = away * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    both = [each[:T] - np.nanmean(each[:T], axis=1, keepdims=True) * [1, 1, 0] + sign * way[:, None]
            for each, sign in zip(places, (1, -1), strict=True)]
    points, truth = spoil(np.concatenate(both, axis=1), rate, "shuffled")
    found = label_people([(model, layout) for layout in layouts], unnamed(points, rate))
    first = len(layouts[0].labels)
    orders = [found, found[::-1]] if len(layouts[1].labels) == first else [found]
    tried = []
    for people in orders:                                               # which is called the first does not matter
        columns = np.concatenate([each.columns for each in people], axis=1)
        tried.append((score(columns, truth, np.concatenate([each.confidence for each in people], axis=1)), columns))
    best, columns = max(tried, key=lambda one: one[0]["right"])
    frames, rows = np.nonzero(columns >= 0)
    who = truth[frames, columns[frames, rows]]
    nearest = min(float(np.nanmin(np.linalg.norm(a[:, None] - b, axis=2))) for a, b in zip(*both, strict=True))
    return {**best, "exchanged": int(((who >= first) != (rows >= first))[who >= 0].sum()), "nearest_m": nearest}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--files", nargs="*", default=[])
    parser.add_argument("--stages", nargs="*", default=STAGES)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--frames", type=int, default=None)
    parser.add_argument("-o", "--output", default="labels.json")
    arguments = parser.parse_args()
    model, recordings = load_model("people"), {}
    for path in sorted(arguments.folder.glob("*.c3d")):
        if not arguments.files or path.stem in arguments.files:
            markers = read_markers(path)
            rows, layout = choose_layout(model, "cmu41", markers.labels)[0].match_columns(markers.labels)
            order = np.argsort(layout.labels)                           # the same in all files
            layout = layout.select([layout.labels[i] for i in order])
            recordings[path.stem] = layout, markers.positions[:arguments.frames, rows[order]], markers.rate
    out = []
    for i, (name, (layout, places, rate)) in enumerate(recordings.items()):
        for stage in arguments.stages:
            row = {"file": name, "stage": stage, "frames": len(places)}
            if stage == "mosh":
                row |= mosh_ratio(model, layout, places, rate)
            elif stage == "two":
                other = list(recordings)[(i + 1) % len(recordings)]
                row |= two_people(model, [layout, recordings[other][0]], [places, recordings[other][1]], rate)
            elif stage == "memory":
                count = round(arguments.minutes * 60 * rate)
                there = np.concatenate([places, places[::-1]])
                there = np.concatenate([there] * -(-count // len(there)))[:count]
                row |= label(model, layout, there, rate, "shuffled") | {"frames": count}
                row["peak_MiB"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            else:
                row |= label(model, layout, places, rate, stage)
            out.append(row)
            print(row, flush=True)
    write_report(arguments.output, {"machine": machine(), "rows": out})


if __name__ == "__main__":
    main()
