"""Faults put into marker sequences: what `find_artefacts` finds of them, and what they do to the motion.

    python tests/benchmarks/mosh_artefacts.py FOLDER -m MODEL.npz -o mosh_artefacts.json [--men 3] [--files 01_01 85_02]

FOLDER has real marker files. Three kinds of sequences: the real files with faults put in, the reference being the
motion without them; men of SPRING that the model has not seen, moved by the motions found in the files, their own
markers being 5 mm off along each axis and 0.5 mm noisy; and the files as they are, where every find is an alarm.
At any time a tenth of the markers is exchanged in pairs, each for `SPANS` seconds, and a twentieth out of sight; then,
one after the other, markers that slip by 2-5 cm, jitter by 1 cm along each axis, or stray 10-40 cm away.
An exchange counts as found when its pair is right and its span has more than half of the union with the true one.
"""
from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from marker_motion import dropped
from protocols import load_real, machine, spring_split, write_report

from completion.mocap.artefacts.find import find_artefacts
from completion.mocap.artefacts.results import BadKind, BadSpan, Swap
from completion.mocap.files.markers import MarkerSequence, read_markers
from completion.mocap.marker_sets.layout import MarkerLayout
from completion.mocap.marker_sets.named import load_layout
from completion.mocap.mosh.mosh import MoshConfig, mosh
from completion.mocap.pose.follow import animate
from completion.mocap.pose.marked_body import supports
from completion.mocap.subject.person import find_person
from completion.motion import Motion
from model.body import BodyModel
from model.files import load_model
from model.fitting import energy
from model.linear import Subject
from model.posing.transfer import subject_from_body

POSES = MoshConfig().poses
SPANS = (0.2, 2.0)                   # seconds that an exchange lasts
APART = 60                           # frames between two exchanges of a marker
NEAR = 0.2                           # metres, between the markers of a close pair
KINDS: tuple[BadKind, ...] = ("slipped", "noisy", "stray")


@dataclass(frozen=True, eq=False)
class Faulty:
    """A sequence with faults in it, and which."""

    markers: MarkerSequence
    exchanges: tuple[Swap, ...]
    bad: tuple[BadSpan, ...]


def exchanged(sequence: MarkerSequence, share: float, close: bool, rng: np.random.Generator) -> Faulty:
    """At any time this share of the markers bears another one's label; each is in one exchange at a time."""
    positions = sequence.positions.copy()
    T, L = positions.shape[:2]
    apart = np.nanmedian(np.linalg.norm(positions[::20, :, None] - positions[::20, None], axis=-1), axis=0)
    first, second = np.nonzero(np.triu(apart < (NEAR if close else np.inf), 1))
    busy, out = np.zeros((T, L), dtype=bool), []
    for _ in range(20000):
        if busy.mean() >= share:
            break
        pair = rng.integers(len(first))
        two = [int(first[pair]), int(second[pair])]
        length = min(round(rng.uniform(*SPANS) * sequence.rate), T // 3)
        t = int(rng.integers(1 - length, T))
        begin, end = max(t, 0), min(t + length, T)
        margin = slice(max(begin - APART, 0), end + APART)           # two with a gap between them would be one
        if end - begin < 0.1 * sequence.rate or busy[margin, two].any():
            continue
        busy[begin:end, two] = True
        positions[begin:end, two] = positions[begin:end, two[::-1]]
        out.append(Swap(sequence.labels[two[0]], sequence.labels[two[1]], begin, end - 1))
    return Faulty(MarkerSequence(positions, sequence.labels, sequence.rate), tuple(out), ())


def spoilt(sequence: MarkerSequence, kind: BadKind, count: int, part_rotations: np.ndarray, rng: np.random.Generator
           ) -> Faulty:
    """So many markers with one fault each.

    Parameters
    ----------
    part_rotations : (T, L, 3, 3)
        From the frame of a marker's part to the world.
    """
    positions = sequence.positions.copy()
    T = len(positions)
    out = []
    for i in rng.permutation(np.flatnonzero(sequence.seen.mean(axis=0) > 0.5))[:count]:
        way = rng.normal(size=3)
        way /= np.linalg.norm(way)
        begin, length = int(rng.uniform(0.1, 0.8) * T), min(round(rng.uniform(0.2, 1.5) * sequence.rate), T // 5)
        end = begin + length
        if kind == "slipped":
            end, size = T, rng.uniform(0.02, 0.05)
            shift = part_rotations[begin:end, i] @ (size * way)
        elif kind == "noisy":
            shift = rng.normal(0, 0.01, (length, 3))
        else:
            shift = np.broadcast_to(rng.uniform(0.1, 0.4) * way, (length, 3))
        positions[begin:end, i] += shift
        out.append(BadSpan(sequence.labels[i], kind, begin, end - 1, float(np.linalg.norm(shift, axis=1).mean())))
    return Faulty(MarkerSequence(positions, sequence.labels, sequence.rate), (), tuple(out))


def overlap(a: Swap | BadSpan, b: Swap | BadSpan) -> float:
    """Common frames of two spans over those of their union."""
    common = min(a.end, b.end) - max(a.begin, b.begin) + 1
    return max(0, common) / (a.end - a.begin + b.end - b.begin + 2 - max(0, common))


def hits(found: Sequence[Swap | BadSpan], true: Sequence[Swap | BadSpan]) -> tuple[int, int]:
    """How many of the found are true, and how many of the true are found."""
    def name(span: Swap | BadSpan) -> frozenset[str]:
        return frozenset((span.first, span.second) if isinstance(span, Swap) else (span.label, span.kind))

    same = np.array([[name(f) == name(t) and overlap(f, t) >= 0.5 for t in true] for f in found], dtype=bool)
    same = same.reshape(len(found), len(true))
    return int(same.any(axis=1).sum()), int(same.any(axis=0).sum())


def marked(spans: Sequence[Swap | BadSpan], sequence: MarkerSequence) -> np.ndarray:
    """Marker-frames (T, L) that spans cover."""
    out = np.zeros(sequence.positions.shape[:2], dtype=bool)
    for span in spans:
        for label in (span.first, span.second) if isinstance(span, Swap) else (span.label,):
            out[span.begin:span.end + 1, sequence.labels.index(label)] = True
    return out & sequence.seen


def scores(found: Sequence[Swap | BadSpan], true: Sequence[Swap | BadSpan], sequence: MarkerSequence
           ) -> dict[str, float]:
    """Counts of spans, and of marker-frames."""
    right, reached = hits(found, true)
    mine, theirs = marked(found, sequence), marked(true, sequence)
    return {"found": len(found), "right": right, "true": len(true), "reached": reached, "frames_found": mine.sum(),
            "frames_true": theirs.sum(), "frames_right": (mine & theirs).sum()}


def shares(rows: Sequence[dict[str, float]]) -> dict[str, float]:
    """Precision and recall over several sequences."""
    total = {name: sum(row[name] for row in rows) for name in rows[0]}
    return {"precision": total["right"] / max(total["found"], 1), "recall": total["reached"] / max(total["true"], 1),
            "frame_precision": total["frames_right"] / max(total["frames_found"], 1),
            "frame_recall": total["frames_right"] / max(total["frames_true"], 1), "spans": total["true"]}


@dataclass(frozen=True, eq=False)
class Case:
    """A sequence without faults of ours: its markers, and the true surface where that is known.

    Attributes
    ----------
    truth : Subject and Motion that made the markers, or None
    layout : MarkerLayout
        Where the markers are thought to be.
    """

    name: str
    markers: MarkerSequence
    layout: MarkerLayout
    truth: tuple[Subject, Motion] | None


def followed(model: BodyModel, case: Case, markers: MarkerSequence) -> tuple[Subject, MarkerLayout, Motion]:
    """The person and the motion of markers as they are."""
    found = find_person(model, markers, case.layout)
    subject = model.subject(found.betas)
    return subject, found.layout, animate(subject, markers, found.layout, POSES)


def surface(subject: Subject, motion: Motion, every: int = 10) -> np.ndarray:
    """Vertices (n, N', 3) of some frames, metres: every seventh."""
    return subject.vertices(motion.poses[::every], motion.trans[::every])[:, ::7]


def simulated(model: BodyModel, body: np.ndarray, motion: Motion, layout: MarkerLayout, name: str,
              rng: np.random.Generator) -> Case:
    """A man's own body with his own markers, moved as somebody else moved."""
    man = subject_from_body(model, body)
    ids, weights = supports(man.template, layout)
    points = man.points(ids, weights)
    exact = np.concatenate([energy.rise_above_skin(points.evaluate(motion.poses[i:i + 64], motion.trans[i:i + 64]),
                                                   np.asarray(layout.distances)) for i in range(0, len(motion.poses),
                                                                                                64)])
    misplaced = rng.normal(0, 0.005, (len(layout.labels), 3))
    exact += (turned(man, layout, motion) @ misplaced[..., None])[..., 0] + rng.normal(0, 0.0005, exact.shape)
    return Case(name, MarkerSequence(exact, layout.labels, motion.rate), layout, (man, motion))


def turned(subject: Subject, layout: MarkerLayout, motion: Motion) -> np.ndarray:
    """Rotations (T, L, 3, 3) of the parts on which the markers sit."""
    nearest = layout.vertices.reshape(len(layout.labels), -1)[:, 0]
    part = subject.skeleton.part_of_vertex(subject.template)[nearest]
    return subject.skeleton.part_rotations(motion.poses)[:, part]


def run_case(model: BodyModel, case: Case, seed: int) -> dict[str, object]:
    """All faults on one sequence."""
    rng = np.random.default_rng(seed)
    subject, layout, motion = followed(model, case, case.markers)
    if case.truth is None:
        reference, clean = surface(subject, motion), float(np.nanmean(motion.residuals))
    else:
        reference = surface(*case.truth)
        clean = float(np.linalg.norm(surface(subject, motion) - reference, axis=2).mean())
    start = time.process_time()
    plain = find_artefacts(subject, case.markers, layout)
    seconds = time.process_time() - start
    row: dict[str, object] = {"case": case.name, "clean_mm": 1e3 * clean, "alarms": [
        str(span) for span in (*plain.swaps, *plain.bad)], "frames_per_cpu_s": len(reference) * 10 / seconds}
    for close in (False, True):
        faulty = exchanged(case.markers, 0.1, close, rng)
        gone = dataclasses.replace(faulty, markers=dropped(faulty.markers, 0.05, 0.25, rng))
        row["close" if close else "random"] = run_exchanges(model, case, gone, reference, clean)
    turns = turned(subject, layout.select(layout.match_labels(case.markers.labels)), motion)
    known = case.markers.select(layout.match_labels(case.markers.labels))
    for kind in KINDS:
        faulty = spoilt(known, kind, 6, turns, rng)
        found = find_artefacts(subject, faulty.markers, layout)
        fresh = [b for b in found.bad if b.kind == kind]
        row[kind] = scores(fresh, faulty.bad, faulty.markers) | {
            "exchanges": len(found.swaps), "other": len(found.bad) - len(fresh)}
    return row


def run_exchanges(model: BodyModel, case: Case, faulty: Faulty, reference: np.ndarray, clean: float
                  ) -> dict[str, float]:
    """Find exchanges, and what is left of them in the motion: all from the faulty markers alone, seconds too."""
    person = find_person(model, faulty.markers, case.layout)
    subject = model.subject(person.betas)
    raw = animate(subject, faulty.markers, person.layout, POSES)
    start = time.process_time()
    result = mosh(faulty.markers, model, case.layout, MoshConfig(soft_tissue=False))
    seconds, found = time.process_time() - start, result.artefacts[0]
    mended = model.subject(result.betas), result.layout, result.motions[0]
    away = [float(np.linalg.norm(surface(s, m) - reference, axis=2).mean())
            for s, m in ((subject, raw), (mended[0], mended[2]))]
    on_it = animate(mended[0], case.markers, mended[1], POSES)     # what the true markers are off there
    return scores(found.swaps, faulty.exchanges, faulty.markers) | {
        "bad": len(found.bad), "raw_mm": 1e3 * away[0], "mended_mm": 1e3 * away[1],
        "true_markers_mm": 1e3 * float(np.nanmean(on_it.residuals)),
        "frames_per_cpu_s": len(faulty.markers.positions) / seconds}


def cases(model: BodyModel, args: argparse.Namespace) -> list[Case]:
    """The real files, and men moved as in them."""
    layout = load_layout("cmu41", model.template)
    out = [Case(path.stem, read_markers(path), layout, None) for path in sorted(args.folder.glob("*.c3d"))
           if not args.files or path.stem in args.files]
    if args.men:
        data = load_real()
        held = spring_split(len(data.shapes))[1] if args.held_out else np.array(
            [j for i, j in enumerate(spring_split(len(data.shapes))[0]) if i % 5 == 0])
        for i, j in enumerate(held[:: max(1, len(held) // args.men)][:args.men]):
            real = [case for case in out if case.truth is None][i % sum(case.truth is None for case in out)]
            _, _, motion = followed(model, real, real.markers)
            out.append(simulated(model, data.shapes[j], motion, layout, f"man {j} as {real.name}",
                                 np.random.default_rng(int(j))))
    return out if args.real else [case for case in out if case.truth]


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("-m", "--model", required=True)
    parser.add_argument("-o", "--output", default="mosh_artefacts.json")
    parser.add_argument("--files", nargs="*")
    parser.add_argument("--men", type=int, default=4)
    parser.add_argument("--real", action=argparse.BooleanOptionalAction, default=True, help="the files themselves too")
    parser.add_argument("--held-out", action="store_true", help="the 45 men kept for the end")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    model, rows = load_model(args.model), []
    for case in cases(model, args):
        row = run_case(model, case, args.seed)
        rows.append(row)
        print("\n".join([f"{name:18s} {value}" for name, value in row.items()]), flush=True)
    total = {kind: shares([{k: v for k, v in row[kind].items()} for row in rows])  # type: ignore[attr-defined]
             for kind in ("random", "close", *KINDS)}
    for kind, values in total.items():
        print(f"{kind:10s} " + "  ".join(f"{name} {value:.3g}" for name, value in values.items()), flush=True)
    write_report(args.output, {"machine": machine(), "rows": rows, "total": total})


if __name__ == "__main__":
    main()
