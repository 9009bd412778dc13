"""Registration of mesh000 to the virtual scans of `scans.py`: accuracy beside time.

    SCAPEKIT_DATA=... python tests/benchmarks/registration.py [--marks 10|7|4|0] [--front] [--set tuning|held]
        [--poses 3,8] [--men 3] [--published] [--json FILE]

With `--marks 0` the template is led by `find_correspondences`, with no click. What we lose at: the surface is right
long before the correspondence is; skin slides over muscles, and nothing in the shape says by how much.
"""
from __future__ import annotations

import argparse
import time

import numpy as np
from protocols import RealData, load_real, machine, write_report
from scans import HELD_MEN, HELD_POSES, TUNING_MEN, TUNING_POSES, TestScan, errors, test_scan

from scanprep.registration.nonrigid import Registration, register
from scanprep.registration.schedule import RegistrationConfig

SETS = {"tuning": (TUNING_POSES, TUNING_MEN), "held": (HELD_POSES, HELD_MEN)}
COLUMNS = ("all_mm", "seen_mm", "unseen_mm", "beyond_50mm", "surface_seen_mm", "max_mm", "flipped", "cpu_s", "wall_s")


def registered(data: RealData, item: TestScan, marks: str, config: RegistrationConfig) -> Registration:
    """The template on one scan, by clicks or by what is found without any."""
    landmarks = item.landmarks(data, marks)
    if landmarks is not None:
        return register(data.template, item.scan, landmarks, config)
    from scanprep.correspondence.correlated import find_correspondences

    return register(data.template, item.scan, None, config,
                    correspondences=find_correspondences(data.template, item.scan))


def measure(data: RealData, kind: str, index: int, marks: str, front: bool, config: RegistrationConfig
            ) -> dict[str, object]:
    """Register one virtual scan and compare with the truth."""
    item = test_scan(data, kind, index, front)
    start = time.perf_counter(), time.process_time()
    found = registered(data, item, marks, config)
    wall, cpu = time.perf_counter() - start[0], time.process_time() - start[1]
    sure = found.seen == item.seen
    return {"scan": item.name, "kind": kind, **errors(found.mesh.vertices, item), "flipped": found.inverted,
            "converged": found.converged, "seen_agrees": float(sure.mean()), "cpu_s": cpu, "wall_s": wall}


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
    parser.add_argument("--poses", help="numbers of SCAPE poses instead of those of the set")
    parser.add_argument("--men", help="numbers of SPRING men instead of those of the set")
    parser.add_argument("--published", action="store_true", help="the registration of [SCAPE] instead of ours [Hahnel]")
    parser.add_argument("--json", help="write all figures here")
    args = parser.parse_args()
    data = load_real()
    poses, men = (tuple(int(k) for k in text.split(",") if k) if text is not None else default
                  for text, default in zip((args.poses, args.men), SETS[args.chosen], strict=True))
    config = RegistrationConfig.published() if args.published else RegistrationConfig()
    rows: list[dict[str, object]] = []
    for kind, index in [("pose", i) for i in poses] + [("man", i) for i in men]:
        rows.append(measure(data, kind, index, args.marks, args.front, config))
        print(" ".join(f"{k}={v:.4g}" if isinstance(v, float) else f"{k}={v}" for k, v in rows[-1].items()), flush=True)
    summary = {kind: means([row for row in rows if row["kind"] == kind])
               for kind in ("pose", "man") if any(row["kind"] == kind for row in rows)}
    for kind, figures in summary.items():
        print(f"{kind}: " + " ".join(f"{key}={value:.4g}" for key, value in figures.items()))
    if args.json:
        write_report(args.json, {"marks": args.marks, "front": args.front, "published": args.published,
                                 "machine": machine(), "summary": summary, "rows": rows})


if __name__ == "__main__":
    main()
