"""Markers worn elsewhere, and pairs that bear each other's name throughout: what is found, moved and exchanged.

    python tests/benchmarks/mosh_worn_elsewhere.py FOLDER -m MODEL.npz -o mosh_worn_elsewhere.json [--first 20]

FOLDER has real marker files, of which every fourth frame is taken. Each is solved as it is; every marker that is moved
or exchanged there is an alarm, to be looked at. Then it is disturbed and solved again, in turns of four kinds:

- *moved*: one to four markers sit 10-40 cm from their place, on a vertex of the fitted body. They move with its
  surface, and what the marker was off the fitted body before, in the frame of its part, is added in the frame of the
  new part.
- *taken over*: one or two labels are those of another marker that was measured 10-40 cm away, whose own label is gone:
  real trajectories of places that no model made.
- *renamed*: one or two pairs, left and right or front and back, at least 10 cm apart, bear each other's name.
- *both*: a pair is renamed and a marker moved.

A moved marker is right when its new place is less than 20 mm from the true one, on the fitted body in the mean pose.
Shape and pose are compared by the mean distance of the markers that nobody touched, as a multiple of what it is without
disturbance (`ratio`), and by how far the surface is from the one without (`surface_mm`). With `--plain` nothing is
sought, which is how it was before. Seeds below 20 and from 100 on were used for tuning; what is reported begins at 20.
"""
from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path

import numpy as np
from protocols import machine, write_report

from completion.mocap.files.markers import MarkerSequence, read_markers
from completion.mocap.marker_sets.layout import MarkerLayout
from completion.mocap.marker_sets.named import load_layout
from completion.mocap.mosh.mosh import MoshConfig
from completion.mocap.pose.follow import animate
from completion.mocap.pose.marked_body import supports
from completion.mocap.subject.misplaced_markers import MisplacedMarkers, find_misplaced_markers
from completion.mocap.subject.person import find_person
from completion.motion import Motion
from model.body import BodyModel
from model.files import load_model
from model.fitting import energy
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.sides import other_side

EVERY = 4                            # of the frames one
NEAREST, FARTHEST = 0.1, 0.4         # metres from its place that a marker is moved
RIGHT = 0.02                         # metres within which a place is right
DISTANCE = 0.0095                    # metres from the skin of a moved marker
FRONT_BACK = (("LFHD", "LBHD"), ("RFHD", "RBHD"), ("LFWT", "LBWT"), ("RFWT", "RBWT"), ("CLAV", "C7"), ("STRN", "T10"))
KINDS = ("moved", "taken over", "renamed", "both")
CONFIG = MoshConfig()


@dataclass(frozen=True, eq=False)
class Solved:
    """What was found of a recording: who, how the markers are worn, and the motion."""

    betas: np.ndarray
    layout: MarkerLayout
    misplaced: MisplacedMarkers
    motion: Motion


@dataclass(frozen=True, eq=False)
class Reference:
    """A recording as it is, and what was found of it."""

    name: str
    markers: MarkerSequence              # those that the layout knows, under its labels
    result: Solved
    body: Mesh                           # the person in the mean pose
    places: np.ndarray                   # (L, 3) of the markers on it, metres
    noise: np.ndarray                    # (T, L, 3) what they are off, metres, in the frames of their parts


@dataclass
class Disturbed:
    """A recording with markers that are worn elsewhere or bear another's name."""

    positions: np.ndarray
    moved: dict[str, np.ndarray] = field(default_factory=dict)        # place on the body in the mean pose
    pairs: list[frozenset[str]] = field(default_factory=list)
    gone: set[str] = field(default_factory=set)

    @property
    def touched(self) -> set[str]:
        """Labels that are not where they were."""
        return set(self.moved) | self.gone | {label for pair in self.pairs for label in pair}


def mean_body(model: BodyModel, betas: np.ndarray) -> Mesh:
    """A person in the mean pose of the model's people."""
    pose = np.array(model.pose_mean).reshape(-1, 3).copy()
    pose[0] = 0
    return model.template.with_vertices(model.vertices(pose, betas))


def solved(model: BodyModel, markers: MarkerSequence, layout: MarkerLayout, seek: bool = True) -> Solved:
    """The stages of `mosh` up to the poses, without those that mend tracks; all as it was before without `seek`."""
    person, misplaced = find_person(model, markers, layout, CONFIG.person), MisplacedMarkers()
    if seek:
        misplaced = find_misplaced_markers(model, [markers], layout, person, CONFIG.person)
    if misplaced.changes:
        markers, layout = misplaced.restore_names(markers, layout), misplaced.update_layout(layout)
        person = find_person(model, markers, layout, CONFIG.person)
    motion = animate(model.subject(person.betas), markers, person.layout, CONFIG.poses)
    return Solved(person.betas, person.layout, misplaced, motion)


def simulated(model: BodyModel, result: Solved, layout: MarkerLayout) -> np.ndarray:
    """Markers (T, L, 3) of a layout in a motion, metres."""
    motion = result.motion
    points = model.subject(result.betas).points(*supports(model.template, layout))
    return np.concatenate([energy.rise_above_skin(points.evaluate(motion.poses[i:i + 64], motion.trans[i:i + 64]),
                                                  np.asarray(layout.distances)) for i in range(0, len(motion.poses),
                                                                                               64)])


def rotations_of(model: BodyModel, result: Solved, vertices: np.ndarray) -> np.ndarray:
    """Rotations (T, n, 3, 3) of the parts of some vertices (n,)."""
    part = model.skeleton.part_of_vertex(model.template)[vertices]
    return model.skeleton.part_rotations(result.motion.poses)[:, part]


def reference(model: BodyModel, path: Path, layout: MarkerLayout) -> Reference:
    """A recording solved as it is."""
    whole = read_markers(path)
    labels = [label for label in layout.match_labels(whole.labels) if whole.select([label]).seen.any()]
    few = whole.select(labels).frames(slice(None, None, EVERY))
    markers = MarkerSequence(few.positions, tuple(layout.aliases.get(label, label) for label in labels), few.rate)
    result = solved(model, markers, layout)
    own = result.layout.select(markers.labels)
    body = mean_body(model, result.betas)
    turned = rotations_of(model, result, own.nearest)
    off = markers.positions - simulated(model, result, own)
    return Reference(path.stem, markers, result, body, own.place(body), np.einsum("tldc,tld->tlc", turned, off))


def moved(model: BodyModel, ref: Reference, count: int, rng: np.random.Generator, into: Disturbed) -> None:
    """Put markers on other places of the body."""
    labels, layout = ref.markers.labels, MarkerLayout(("X",), np.array([0]), DISTANCE)
    free = [i for i, label in enumerate(labels) if label not in into.touched]
    for i in rng.choice(free, count, replace=False):
        away = np.linalg.norm(ref.body.vertices - ref.places[i], axis=1)
        v = int(rng.choice(np.flatnonzero((away > NEAREST) & (away < FARTHEST))))
        there = layout.with_places({"X": v})
        turned = rotations_of(model, ref.result, np.array([v]))[:, 0]
        noise = np.einsum("tdc,tc->td", turned, ref.noise[:, i])
        into.positions[:, i] = simulated(model, ref.result, there)[:, 0] + noise
        into.moved[labels[i]] = there.place(ref.body)[0]


def taken_over(ref: Reference, count: int, rng: np.random.Generator, into: Disturbed) -> None:
    """Give labels the measured track of another marker, whose own label goes."""
    labels = ref.markers.labels
    for _ in range(count):
        apart = np.linalg.norm(ref.places[:, None] - ref.places, axis=2)
        fit = (apart > NEAREST) & (apart < FARTHEST)
        for label in into.touched:
            fit[labels.index(label)] = fit[:, labels.index(label)] = False
        i, j = rng.choice(np.argwhere(fit))
        into.positions[:, i], into.positions[:, j] = into.positions[:, j].copy(), np.nan
        into.moved[labels[i]] = ref.places[j]
        into.gone.add(labels[j])


def renamed(ref: Reference, count: int, rng: np.random.Generator, into: Disturbed) -> None:
    """Exchange the names of pairs."""
    labels = ref.markers.labels
    sides = [(label, other_side(label)) for label in labels if label.startswith("L")]
    there = [pair for pair in (*sides, *FRONT_BACK) if set(pair) <= set(labels)]
    for _ in range(count):
        pairs = [(labels.index(a), labels.index(b)) for a, b in there if not {a, b} & into.touched]
        wide = [(i, j) for i, j in pairs if np.linalg.norm(ref.places[i] - ref.places[j]) > NEAREST]
        i, j = (int(k) for k in rng.choice(wide))
        into.positions[:, [i, j]] = into.positions[:, [j, i]]
        into.pairs.append(frozenset((labels[i], labels[j])))


def disturbed(model: BodyModel, ref: Reference, kind: str, seed: int) -> Disturbed:
    """A recording with one kind of disturbance."""
    rng = np.random.default_rng([seed, *ref.name.encode()])
    into = Disturbed(ref.markers.positions.copy())
    if kind == "moved":
        moved(model, ref, int(rng.integers(1, 5)), rng, into)
    elif kind == "taken over":
        taken_over(ref, int(rng.integers(1, 3)), rng, into)
    else:
        renamed(ref, 1 if kind == "both" else int(rng.integers(1, 3)), rng, into)
        if kind == "both":
            moved(model, ref, 1, rng, into)
    return into


def compared(model: BodyModel, ref: Reference, result: Solved, untouched: Sequence[str]) -> dict[str, float]:
    """Distance of the markers that nobody touched, and of the surface from that without disturbance."""
    rows = [ref.markers.labels.index(label) for label in untouched]
    before = np.nanmean(ref.result.motion.residuals[:, rows])
    rows = [result.motion.labels.index(label) for label in untouched]
    off = np.nanmean(result.motion.residuals[:, rows])
    step = max(1, len(ref.markers.positions) // 40)
    here, there = (model.subject(r.betas).vertices(r.motion.poses[::step], r.motion.trans[::step])
                   for r in (result, ref.result))
    shape = [mean_body(model, r.betas).vertices for r in (result, ref.result)]
    return {"ratio": float(off / before), "untouched_mm": 1e3 * float(off),
            "surface_mm": 1e3 * float(np.linalg.norm(here - there, axis=2).mean()),
            "shape_mm": 1e3 * float(np.linalg.norm(shape[0] - shape[1], axis=1).mean())}


def run_case(model: BodyModel, ref: Reference, layout: MarkerLayout, kind: str, seed: int, seek: bool) -> dict:
    """Disturb, solve, compare."""
    case = disturbed(model, ref, kind, seed)
    there = [label for label in ref.markers.labels if label not in case.gone]
    markers = MarkerSequence(case.positions, ref.markers.labels, ref.markers.rate).select(there)
    start = time.process_time()
    result = solved(model, markers, layout, seek)
    seconds, misplaced = time.process_time() - start, result.misplaced
    on = result.layout.place(ref.body)
    off = {label: 1e3 * float(np.linalg.norm(on[result.layout.labels.index(label)] - place))
           for label, place in case.moved.items() if label in result.layout.labels}
    usual = np.linalg.norm(layout.select(list(case.moved)).place(ref.body) - np.array(list(case.moved.values())
                           ).reshape(-1, 3), axis=1) if case.moved else np.zeros(0)
    own = {m.label for m in misplaced.moved}
    untouched = [label for label in ref.markers.labels if label not in case.touched]
    return {"file": ref.name, "kind": kind, "seed": seed, "moved": len(case.moved), "off_mm": off,
            "found": sorted(own), "unplaced": list(misplaced.unplaced),
            "away_mm": dict(zip(case.moved, (1e3 * usual).round().tolist(), strict=True)),
            "right": sum(label in own and off[label] < 1e3 * RIGHT for label in case.moved),
            "pairs": len(case.pairs), "pairs_true": [sorted(p) for p in case.pairs],
            "pairs_found": [sorted(p) for p in misplaced.exchanged],
            "pairs_right": sum(frozenset(pair) in case.pairs for pair in misplaced.exchanged),
            "false": len(own - set(case.moved)) + sum(frozenset(p) not in case.pairs for p in misplaced.exchanged),
            "seconds": seconds, **compared(model, ref, result, untouched)}


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("-m", "--model", required=True)
    parser.add_argument("-o", "--output", default="mosh_worn_elsewhere.json")
    parser.add_argument("--layout", default="cmu41")
    parser.add_argument("--files", nargs="*")
    parser.add_argument("--kinds", nargs="*", default=KINDS)
    parser.add_argument("--first", type=int, default=0, help="the first seed; 100 for tuning")
    parser.add_argument("--plain", action="store_true", help="seek nothing")
    parser.add_argument("--seeds", type=int, default=3)
    args = parser.parse_args()
    model = load_model(args.model)
    layout, rows, refs, plain = load_layout(args.layout, model.template), [], [], []
    for path in sorted(args.folder.glob("*.c3d")):
        if args.files and path.stem not in args.files:
            continue
        refs.append(reference(model, path, layout))
        misplaced, motion = refs[-1].result.misplaced, refs[-1].result.motion
        plain.append({"file": path.name, "alarms": [*misplaced.exchanged, *(m.label for m in misplaced.moved)],
                      "unplaced": misplaced.unplaced, "mm": 1e3 * float(np.nanmean(motion.residuals))})
        print(plain[-1], flush=True)
    for seed in range(args.first, args.first + args.seeds):
        for kind, ref in product(args.kinds, refs):
            rows.append(run_case(model, ref, layout, kind, seed, not args.plain))
            print("  ".join(f"{name} {value:.3g}" if isinstance(value, float) else f"{name} {value}"
                            for name, value in rows[-1].items()), flush=True)
            total = {one: totals(some) for one in args.kinds if (some := [row for row in rows if row["kind"] == one])}
            write_report(args.output, {"machine": machine(), "undisturbed": plain, "rows": rows, "total": total})
    for kind, values in total.items():
        print(f"{kind:12s} " + "  ".join(f"{name} {value:.3g}" for name, value in values.items()))


def totals(rows: Sequence[dict]) -> dict[str, float]:
    """What was there, found, right and false, and what it cost in shape and pose."""
    placed = [off for row in rows for label, off in row["off_mm"].items() if label in row["found"]]
    return {"moved": sum(row["moved"] for row in rows), "right": sum(row["right"] for row in rows),
            "place_mm": float(np.mean(placed)) if placed else np.nan,
            "pairs": sum(row["pairs"] for row in rows), "pairs_right": sum(row["pairs_right"] for row in rows),
            "false": sum(row["false"] for row in rows), "ratio": float(np.mean([row["ratio"] for row in rows])),
            "ratio_worst": float(max(row["ratio"] for row in rows)),
            "surface_mm": float(np.mean([row["surface_mm"] for row in rows])),
            "shape_mm": float(np.mean([row["shape_mm"] for row in rows]))}


if __name__ == "__main__":
    main()
