"""What `scape prep landmarks` finds on scans that nobody clicked: how far it is off, and how far it says it may be.

    SCAPEKIT_DATA=... python tests/benchmarks/found_landmarks.py FOLDER [--set tuning|held] [--poses 2,17] [--men 2]
        [--fronts 22] [-o FILE]

The template is mesh000 with its 36 landmarks, brought onto every virtual scan without landmarks: four views all around,
and of the poses in `--fronts` one view from the front. FOLDER keeps the registered vertices and the verdicts, so that
what follows is done again in seconds. A landmark is compared with the true vertex of its name.

What we lose at: the surface of the trunk and the thighs says little of where along the skin a landmark belongs.
"""
from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from protocols import RealData, load_real, machine, write_report
from registration import measure
from scans import TestScan, test_scan

from scanprep.judgement import size
from scanprep.pipeline.landmarks import ScanLandmarks, landmark_errors, place_of, points_on_scan
from scanprep.registration.figures import UNSEEN, review
from scanprep.registration.lead import lead_of
from scanprep.registration.person import person_parts
from scanprep.registration.schedule import RegistrationConfig

# poses, men, and poses seen from the front: of the sets of `scans.py`, as many as take a quarter of an hour
SETS = {"tuning": ("3,14,29,48,63", "3,44,88,134,178,214", "8,24"),
        "held": ("2,17,32,52,67", "2,52,97,147,197", "22")}


def keep_registration(data: RealData, items: Sequence[tuple[str, int, bool]], folder: Path) -> None:
    """Register the template to those of some virtual scans that the folder does not hold yet."""
    missing = [one for one in items if not (folder / f"{scan_name(*one)}.json").exists()]
    if not missing:
        return
    parts, lead = person_parts(data.template), lead_of(data.template, "auto")
    assert parts is not None, "the template is a person"
    for kind, index, front in missing:
        done = measure(data, parts, kind, index, "0", front, RegistrationConfig(), lead, folder)
        # as `scape prep register` judges one scan alone
        verdict = review([done.figures], {done.figures.name: done.problem} if done.problem else {},
                         size(data.template), len(data.template.faces), None, {done.figures.name: done.doubts}, UNSEEN)
        (folder / f"{scan_name(kind, index, front)}.json").write_text(json.dumps(
            {"verdict": str(verdict[0].judgement), "cpu_s": done.row["cpu_s"]}))


def scan_name(kind: str, index: int, front: bool) -> str:
    """What a `TestScan` is called."""
    return f"{kind}{index:03d}{'front' if front else ''}"


def compare(data: RealData, item: TestScan, folder: Path) -> dict[str, object]:
    """The landmarks of one scan beside the true ones, millimetres."""
    told = json.loads((folder / f"{item.name}.json").read_text())
    body = data.template.with_vertices(np.load(folder / f"{item.name}_0.npy"))
    names, vertices = tuple(data.landmarks), np.array(list(data.landmarks.values()))
    points, gaps = points_on_scan(item.scan, body, vertices)
    found = ScanLandmarks(names, points, gaps, size(body))
    expected = 1e3 * landmark_errors(found, told["verdict"].split(":")[0])
    apart = 1e3 * np.linalg.norm(points - item.truth.vertices[vertices], axis=1)
    return {"scan": item.name, "verdict": told["verdict"], "cpu_s": told["cpu_s"], "median_mm": float(np.median(apart)),
            "mean_mm": float(apart.mean()), "worst_mm": float(apart.max()), "worst": names[int(apart.argmax())],
            "guessed": int((~found.seen).sum()), "apart_mm": dict(zip(names, apart.tolist(), strict=True)),
            "expected_mm": dict(zip(names, expected.tolist(), strict=True)),
            "seen": dict(zip(names, found.seen.tolist(), strict=True))}


def summarise(rows: Sequence[dict]) -> dict[str, dict[str, float]]:
    """Errors beside expected ones over groups of landmarks."""
    every = [(row["apart_mm"][name], row["expected_mm"][name], row["seen"][name], row["verdict"].split(":")[0],
              place_of(name)) for row in rows for name in row["apart_mm"] if not row["verdict"].startswith("failed")]
    groups = {"all": lambda one: True, "with data": lambda one: one[2], "guessed": lambda one: not one[2],
              "good scans": lambda one: one[3] == "good", "scans to be looked at": lambda one: one[3] == "check",
              **{place: lambda one, place=place: one[4] == place for place in sorted({one[4] for one in every})}}
    found = {}
    for group, belongs in groups.items():
        apart, expected = np.array([one[:2] for one in every if belongs(one)]).reshape(-1, 2).T
        if len(apart):
            found[group] = {"count": len(apart), "median_mm": float(np.median(apart)), "mean_mm": float(apart.mean()),
                            "nine_of_ten_mm": float(np.quantile(apart, 0.9)), "expected_mm": float(expected.mean()),
                            "within_once": float((apart <= expected).mean()),
                            "within_twice": float((apart <= 2 * expected).mean())}
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="keeps registered vertices")
    parser.add_argument("--set", choices=SETS, default="held", dest="chosen")
    parser.add_argument("--poses", help="numbers of SCAPE poses instead of those of the set")
    parser.add_argument("--men", help="numbers of SPRING men instead of those of the set")
    parser.add_argument("--fronts", help="numbers of SCAPE poses seen from the front")
    parser.add_argument("-o", "--output", help="write all figures here")
    args = parser.parse_args()
    texts = (default if text is None else text for text, default in
             zip((args.poses, args.men, args.fronts), SETS[args.chosen], strict=True))
    poses, men, fronts = (tuple(int(k) for k in text.split(",") if k) for text in texts)
    items = [*(("pose", i, False) for i in poses), *(("man", i, False) for i in men),
             *(("pose", i, True) for i in fronts)]
    data = load_real()
    args.folder.mkdir(parents=True, exist_ok=True)
    keep_registration(data, items, args.folder)
    rows = [compare(data, test_scan(data, *one), args.folder) for one in items]
    summary = summarise(rows)
    for row in rows:
        print(" ".join(f"{k}={v:.3g}" if isinstance(v, float) else f"{k}={v}" for k, v in row.items()
                       if not isinstance(v, dict)))
    for group, figures in summary.items():
        print(f"{group}: " + " ".join(f"{key}={value:.3g}" for key, value in figures.items()))
    if args.output:
        write_report(args.output, {"machine": machine(), "set": args.chosen, "summary": summary, "rows": rows})


if __name__ == "__main__":
    main()
