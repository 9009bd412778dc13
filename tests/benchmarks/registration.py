"""Registration of mesh000 to the virtual scans of `scans.py`: accuracy beside time.

    SCAPEKIT_DATA=... python tests/benchmarks/registration.py [--marks 10|7|4|0] [--front] [--set tuning|held]
        [--through auto|none|MODEL] [--poses 3,8] [--men 3] [--published] [--kept FOLDER] [-o FILE]

With fewer than seven marks the template is led through a model, the built-in people, and with none by correspondences
where that leaves something to doubt; `--through none` leaves the model out. What we lose at: the surface is right long
before the correspondence is; skin slides over muscles, and nothing in the shape says by how much.

Every scan is judged as on the page of a set, and the verdicts are compared with the truth: `off`, by more than 30 mm on
average or a limb by more than 150 mm; and `rolled`, a limb by more than 50 mm on average.
"""
from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from protocols import RealData, load_real, machine, write_report
from scans import HELD_MEN, HELD_POSES, MARKS, TUNING_MEN, TUNING_POSES, TestScan, errors, test_scan

from scanprep.judgement import size
from scanprep.registration.figures import ScanFigures, figures_of, review
from scanprep.registration.lead import Lead, lead_of
from scanprep.registration.limbs import PlausibilityIssue, limb_doubts
from scanprep.registration.nonrigid import Registration, register, registration_problem
from scanprep.registration.person import PersonParts, person_parts
from scanprep.registration.repair import repair_limbs
from scanprep.registration.schedule import RegistrationConfig
from scanprep.registration.unmarked import FEW, register_by_any, register_unmarked

SETS = {"tuning": (TUNING_POSES, TUNING_MEN), "held": (HELD_POSES, HELD_MEN)}
COLUMNS = ("all_mm", "before_mm", "seen_mm", "unseen_mm", "beyond_50mm", "surface_seen_mm", "max_mm", "flipped",
           "cpu_s", "wall_s")


def registered(data: RealData, parts: PersonParts, item: TestScan, marks: str, config: RegistrationConfig,
               lead: Lead | None) -> tuple[Registration, Registration, str]:
    """The template on one scan, by clicks or by what is found without, before and after limbs were repaired; and what
    led it."""
    landmarks, pairs = item.landmarks(data, marks), None
    if lead is not None:
        led = register_by_any(data.template, item.scan, landmarks, lead, parts, config)
        return led.fit, led.fit, led.way
    if landmarks is not None:
        found = register(data.template, item.scan, landmarks, config)
    else:
        found, pairs = register_unmarked(data.template, item.scan, config)
    led_by = "correspondences" if landmarks is None else "landmarks"
    if registration_problem(data.template, item.scan, found, marks != "0"):
        return found, found, led_by              # as in a folder: it means nothing, whatever its limbs do
    return found, repair_limbs(data.template, item.scan, found, parts, landmarks, config, correspondences=pairs), led_by


class Judged(NamedTuple):
    """The figures of one scan against the truth, and what the registration says of itself."""

    row: dict[str, object]
    figures: ScanFigures
    problem: str | None
    doubts: tuple[PlausibilityIssue, ...]


def measure(data: RealData, parts: PersonParts, kind: str, index: int, marks: str, front: bool,
            config: RegistrationConfig, lead: Lead | None, kept: Path | None) -> Judged:
    """Register one virtual scan, compare with the truth and judge it; the vertices are `kept` in a folder."""
    item = test_scan(data, kind, index, front)
    start = time.perf_counter(), time.process_time()
    before, found, led_by = registered(data, parts, item, marks, config, lead)
    wall, cpu = time.perf_counter() - start[0], time.process_time() - start[1]
    if kept:
        kept.mkdir(exist_ok=True)
        np.save(kept / f"{item.name}_{marks}.npy", found.mesh.vertices)
    row = {"scan": item.name, "kind": kind, "led_by": led_by, **errors(found.mesh.vertices, item),
           "repaired": found is not before, "before_mm": errors(before.mesh.vertices, item)["all_mm"],
           "flipped": found.inverted, "converged": found.converged,
           "seen_agrees": float((found.seen == item.seen).mean()),
           **worst_limb(found.mesh.vertices, item, parts), "cpu_s": cpu, "wall_s": wall}
    problem = registration_problem(data.template, item.scan, found, marks != "0")
    doubts = limb_doubts(data.template, parts, found.mesh.vertices)
    return Judged(row, figures_of(item.name, marks, data.template, found), problem, doubts)


def worst_limb(found: np.ndarray, item: TestScan, parts: PersonParts) -> dict[str, object]:
    """The part that is farthest off on average, and by how much, millimetres."""
    apart = 1e3 * np.linalg.norm(found - item.truth.vertices, axis=1)
    part = parts.skeleton.part_of_vertex(item.truth)
    means = np.bincount(part, apart) / np.bincount(part)
    return {"worst_limb": parts.skeleton.names[means.argmax()], "worst_limb_mm": float(means.max())}


def flags(data: RealData, judged: list[Judged]) -> dict[str, dict[str, float]]:
    """The verdict of every scan, put into its row; and how often they are right."""
    failed = {j.figures.name: j.problem for j in judged if j.problem}
    verdicts = review([j.figures for j in judged], failed, size(data.template), len(data.template.faces), None,
                      {j.figures.name: j.doubts for j in judged})
    for j in judged:
        j.row["verdict"] = str(next(v.judgement for v in verdicts if v.name == j.figures.name))
    told = np.array([j.row["verdict"] != "good" for j in judged])
    mean, limb = (np.array([j.row[key] for j in judged], dtype=float) for key in ("all_mm", "worst_limb_mm"))
    wrong = {"off": (mean > 30) | (limb > 150), "rolled": limb > 50}
    return {name: {"wrong": int(bad.sum()), "flagged": int(told.sum()), "both": int((bad & told).sum()),
                   "precision": float(bad[told].mean()) if told.any() else np.nan,
                   "recall": float(told[bad].mean()) if bad.any() else np.nan} for name, bad in wrong.items()}


def means(rows: list[dict[str, object]]) -> dict[str, float]:
    """Means of the columns over some scans, the worst of them, and the share that ends below 15 mm."""
    every = {key: np.array([row[key] for row in rows], dtype=float) for key in COLUMNS}
    return {**{key: float(values.mean()) for key, values in every.items()},
            "worst_mm": float(every["all_mm"].max()), "below_15mm": float((every["all_mm"] < 15).mean())}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--marks", choices=("10", "7", "4", "0"), default="10")
    parser.add_argument("--front", action="store_true", help="one view from the front instead of four all around")
    parser.add_argument("--set", choices=SETS, default="tuning", dest="chosen")
    parser.add_argument("--through", default="auto", help="model that leads where marks are few: auto, none, a file")
    parser.add_argument("--poses", help="numbers of SCAPE poses instead of those of the set")
    parser.add_argument("--men", help="numbers of SPRING men instead of those of the set")
    parser.add_argument("--published", action="store_true", help="the registration of [SCAPE] instead of ours [Hahnel]")
    parser.add_argument("--kept", type=Path, help="folder for the registered vertices")
    parser.add_argument("-o", "--output", help="write all figures here")
    args = parser.parse_args()
    data = load_real()
    poses, men = (tuple(int(k) for k in text.split(",") if k) if text is not None else default
                  for text, default in zip((args.poses, args.men), SETS[args.chosen], strict=True))
    config = RegistrationConfig.from_paper() if args.published else RegistrationConfig()
    parts = person_parts(data.template)
    assert parts is not None, "the template is a person"
    lead = lead_of(data.template, args.through) if len(MARKS[args.marks]) < FEW else None
    judged: list[Judged] = []
    for kind, index in [("pose", i) for i in poses] + [("man", i) for i in men]:
        judged.append(measure(data, parts, kind, index, args.marks, args.front, config, lead, args.kept))
        row = judged[-1].row
        print(" ".join(f"{k}={v:.4g}" if isinstance(v, float) else f"{k}={v}" for k, v in row.items()), flush=True)
    told, rows = flags(data, judged), [j.row for j in judged]
    summary = {kind: means([row for row in rows if row["kind"] == kind])
               for kind in ("pose", "man") if any(row["kind"] == kind for row in rows)}
    for kind, figures in summary.items():
        print(f"{kind}: " + " ".join(f"{key}={value:.4g}" for key, value in figures.items()))
    for row in rows:
        if row["verdict"] != "good":
            print(f"{row['scan']}: {row['verdict']}")
    print("flags:", told)
    if args.output:
        write_report(args.output, {"marks": args.marks, "front": args.front, "published": args.published,
                                 "through": args.through if lead else "none",
                                 "machine": machine(), "summary": summary, "flags": told, "rows": rows})


if __name__ == "__main__":
    main()
