"""Correspondences from a few seeds, or none, on the scans that registration is measured on.

    SCAPEKIT_DATA=... python tests/benchmarks/correspondences.py --set tuning --seeds 7
    SCAPEKIT_DATA=... python tests/benchmarks/correspondences.py --set held --seeds 0 -o correspondences.json

`median` and `beyond` are of the distance along the true body between the true place of the template's vertex and
the point of the scan given for it. A correspondence is flipped when it lies more than 100 mm off and at most half
as far from the true place of the vertex on the other side. Seconds are of the processor, one thread. With no seeds
the time includes finding them.
"""
from __future__ import annotations

import argparse
import time

import numpy as np
from protocols import RealData, load_real, machine, write_report
from scans import HELD_MEN, HELD_POSES, TUNING_MEN, TUNING_POSES, TestScan, test_scan

from scanprep.correspondence.correlated import find_correspondences
from scanprep.correspondence.correspondences import Correspondences
from scanprep.geometry.geodesics import SurfaceGraph
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface


def other_side(data: RealData) -> np.ndarray:
    """(N,) for every vertex of the template the one that sees the landmarks as it does, left and right swapped."""
    names = list(data.landmarks)
    swapped = [name.replace("right", "#").replace("left", "right").replace("#", "left") for name in names]
    both = [(a, b) for a, b in zip(names, swapped, strict=True) if b in data.landmarks]
    far = SurfaceGraph(data.template).distances(np.array([data.landmarks[a] for a, _ in both])).T
    from scipy.spatial import cKDTree

    column = {a: k for k, (a, _) in enumerate(both)}
    return cKDTree(far).query(far[:, [column[b] for _, b in both]])[1]


def along(truth: Mesh, vertices: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Millimetres (C,) along a body between its vertices and the places of the surface nearest to points."""
    place = Surface(truth).closest(points)
    corners = truth.faces[place.faces]
    distances = SurfaceGraph(truth).distances(vertices)[np.arange(len(vertices))[:, None], corners]
    rest = np.linalg.norm(truth.vertices[corners] - place.points[:, None], axis=2)
    straight = np.linalg.norm(truth.vertices[vertices] - place.points, axis=1)
    # Within two edges the way over vertices is a detour.
    return 1e3 * np.where(straight < 2 * truth.mean_edge, straight, (distances + rest).min(axis=1))


def figures(found: Correspondences, item: TestScan, other: np.ndarray, seconds: float) -> dict[str, float]:
    """What one pair of template and scan came to."""
    error = along(item.truth, found.template_vertices, found.scan_points)
    mirrored = along(item.truth, other[found.template_vertices], found.scan_points)
    flipped = (error > 100) & (mirrored < error / 2)
    return {"count": len(found), "median_mm": float(np.median(error)), "p90_mm": float(np.percentile(error, 90)),
            "beyond_100mm": float((error > 100).mean()), "flipped": int(flipped.sum()), "seconds": seconds}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--set", choices=("tuning", "held"), default="tuning")
    parser.add_argument("--seeds", choices=("10", "7", "4", "0"), default="7")
    parser.add_argument("--front", action="store_true", help="one view from the front in place of four")
    parser.add_argument("--first", type=int, default=None, help="only so many poses and men")
    parser.add_argument("-o", "--output", help="write the figures here")
    options = parser.parse_args()
    data = load_real()
    other = other_side(data)
    poses, men = (HELD_POSES, HELD_MEN) if options.set == "held" else (TUNING_POSES, TUNING_MEN)
    rows: dict[str, dict[str, float]] = {}
    print(f"{'scan':14s} count  median mm  p90 mm  >100 mm  flipped  seconds")
    for kind, index in [("pose", i) for i in poses[:options.first]] + [("man", i) for i in men[:options.first]]:
        item = test_scan(data, kind, index, options.front)
        start = time.process_time()
        try:
            found = find_correspondences(data.template, item.scan, item.landmarks(data, options.seeds))
        except ValueError as error:
            print(f"{item.name:14s} {error}")
            rows[item.name] = {"failed": 1}
            continue
        row = rows[item.name] = figures(found, item, other, time.process_time() - start)
        print(f"{item.name:14s} {row['count']:5.0f} {row['median_mm']:10.1f} {row['p90_mm']:7.1f} "
              f"{100 * row['beyond_100mm']:7.1f}% {row['flipped']:8.0f} {row['seconds']:8.1f}", flush=True)
    done = [row for row in rows.values() if "count" in row]
    mean = {name: float(np.mean([row[name] for row in done])) for name in done[0]}
    mean["worst_median_mm"] = max(row["median_mm"] for row in done)
    mean["failed"] = len(rows) - len(done)
    print("mean of scans: " + ", ".join(f"{name} {value:.3g}" for name, value in mean.items()))
    if options.output:
        settings = {name: value for name, value in vars(options).items() if name != "json"}
        write_report(options.output, {"settings": settings, "machine": machine(), "scans": rows, "mean": mean})


if __name__ == "__main__":
    main()
