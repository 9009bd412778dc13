"""After a few clicks the other landmarks are predicted, as in `scape pick`: how far from where they belong.

    SCAPEKIT_DATA=... python tests/benchmarks/predicted_landmarks.py [--poses 2,7] [--marks 4] [--full] [-o FILE]

The template is mesh000 with all its landmarks; of every virtual scan (four views all around) hands and feet are
clicked, without error, and the other landmarks are compared with the true ones. `scape pick` predicts after four, by a
registration without its last steps.
"""
from __future__ import annotations

import argparse
import time

import numpy as np
from protocols import RealData, load_real, machine, write_report
from scans import HELD_MEN, HELD_POSES, MARKS, TUNING_POSES, TestScan, test_scan

from scanprep.registration.nonrigid import register
from scanprep.viewer.clicked import predict_landmarks
from scanprep.viewer.surface_clicks import Clickable


def registered(data: RealData, item: TestScan, marks: str) -> dict[str, object]:
    """The same by a registration with all its steps."""
    cpu, body = time.process_time(), Clickable(item.scan)
    found = register(data.template, item.scan, item.landmarks(data, marks)).mesh.vertices
    cpu = time.process_time() - cpu
    others = [v for name, v in data.landmarks.items() if name not in MARKS[marks]]
    apart = [1e3 * float(np.linalg.norm(body.nearest(found[v]) - item.truth.vertices[v])) for v in others]
    return {"full_apart_mm": apart, "full_median_mm": float(np.median(apart)), "full_cpu_s": cpu}


def measure(data: RealData, kind: str, index: int, marks: str, full: bool) -> dict[str, object]:
    """One scan, millimetres."""
    item = test_scan(data, kind, index)
    on_template, true = ({name: body.vertices[v] for name, v in data.landmarks.items()}
                         for body in (data.template, item.truth))
    start, cpu = time.perf_counter(), time.process_time()
    clicked = {name: true[name] for name in MARKS[marks]}
    found = predict_landmarks(data.template, on_template, Clickable(item.scan), clicked)
    wall, cpu = time.perf_counter() - start, time.process_time() - cpu
    apart = {name: 1e3 * float(np.linalg.norm(found[name] - true[name])) for name in true if name not in clicked}
    every = np.array(list(apart.values()))
    whole = {} if not full else registered(data, item, marks)
    return {**whole, "scan": item.name, "kind": kind, "median_mm": float(np.median(every)),
            "mean_mm": float(every.mean()), "nine_of_ten_mm": float(np.quantile(every, 0.9)),
            "worst_mm": float(every.max()), "worst": max(apart, key=lambda name: apart[name]),
            "within_10": float((every <= 10).mean()), "cpu_s": cpu, "wall_s": wall, "apart_mm": apart}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--poses", default=",".join(map(str, sorted(HELD_POSES + TUNING_POSES))))
    parser.add_argument("--men", default=",".join(map(str, HELD_MEN[:5])))
    parser.add_argument("--marks", choices=("4", "7", "10"), default="4")
    parser.add_argument("--full", action="store_true", help="also by a registration with all its steps")
    parser.add_argument("-o", "--output")
    args = parser.parse_args()
    data, rows = load_real(), []
    for kind, given in (("pose", args.poses), ("man", args.men)):
        for index in map(int, filter(None, given.split(","))):
            rows.append(measure(data, kind, index, args.marks, args.full))
            print({name: value for name, value in rows[-1].items() if not name.endswith("apart_mm")}, flush=True)
    if args.output:
        write_report(args.output, {"machine": machine(), "marks": args.marks, "rows": rows})


if __name__ == "__main__":
    main()
