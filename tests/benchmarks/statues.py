"""Statues: the tables of the paper, mean and RMS from the reconstruction to the scan at every level, for any scans.

    python tests/benchmarks/statues.py SCAN... [--size 2048] [-o FILE]

Scans stand upright, in metres; each is fitted without clicks. Distances leave holes of the scan out. `e` is the error
left by the map where it is one-to-one. Relief on smooth scans, 1 to 3 mm with wrinkles, is put there by `--emboss`.
"""
from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from protocols import machine, write_report

from model.statue.detail.displacement import coverage_shares
from model.statue.detail.reconstruction import (
    Reconstruction,
    find_inverted,
    in_folds,
    measure_levels,
    remaining_error,
)
from model.statue.fit import StatueConfig, fit_statue
from scanprep import Mesh, read_mesh

FRAMES = 50


def embossed(scan: Mesh) -> Mesh:
    """The scan in four to sixteen times the triangles, with waves of 40 to 60 mm and wrinkles of 12 mm."""
    import igl

    v, f = scan.vertices, scan.faces
    while len(f) < 120_000:
        v, f = igl.loop(np.ascontiguousarray(v), np.ascontiguousarray(f), 1)[:2]
    fine = Mesh(np.asarray(v), np.asarray(f, dtype=np.int64))
    x, y, z = 2 * np.pi * (fine.vertices - fine.vertices.min(axis=0)).T
    height = z / (2 * np.pi)
    waves = 0.0010 * np.sin(x / 0.045) * np.sin(y / 0.05) * np.sin(z / 0.04)
    bands = 0.0012 * np.sin((z + 0.3 * x) / 0.06) * np.exp(-((height % 0.5 - 0.25) / 0.12)**2)
    wrinkles = 0.0008 * np.sin(z / 0.012) * np.exp(-((height % 0.6 - 0.2) / 0.05)**2)
    return fine.with_vertices(fine.vertices + (waves + bands + wrinkles)[:, None] * fine.vertex_normals)


def row(name: str, scan: Mesh, size: int) -> dict[str, object]:
    """All figures of one statue."""
    start, cpu = time.perf_counter(), time.process_time()
    statue = fit_statue(scan, config=StatueConfig(size=size))
    seconds, cpu = time.perf_counter() - start, time.process_time() - cpu
    control, map_ = statue.control, statue.map
    levels, fine = measure_levels(statue, scan)
    build = Reconstruction(control, map_, fine)
    start = time.perf_counter()
    for _ in range(FRAMES):
        moved = build(control.mesh.vertices)
    rate = FRAMES / (time.perf_counter() - start)
    turned = find_inverted(control, control.mesh.vertices, fine, moved)
    left = remaining_error(control, map_, scan)
    return {"scan": name, "triangles": len(scan.faces), **coverage_shares(control, map_),
            "levels": [{"vertices": len(one.mesh.vertices), "mean_mm": 1e3 * one.mean, "rms_mm": 1e3 * one.rms}
                       for one in levels], "e_mm": 1e3 * left.mean(), "frames_per_s": rate, "seconds": seconds,
            "cpu_s": cpu, "inverted_outside_folds": int((~in_folds(control, map_, fine)[turned]).sum())}


def main() -> None:
    """Measure and write."""
    read = argparse.ArgumentParser()
    read.add_argument("scans", nargs="+", type=Path)
    read.add_argument("--size", type=int, default=2048)
    read.add_argument("--emboss", action="store_true")
    read.add_argument("-o", "--output", type=Path)
    given = read.parse_args()
    rows = []
    for path in given.scans:
        scan = read_mesh(path)
        scan = embossed(scan) if given.emboss else scan
        rows.append(row(path.stem, scan, given.size))
        print(rows[-1], flush=True)
    if given.output:
        write_report(given.output, {"machine": machine(), "size": given.size, "rows": rows})


if __name__ == "__main__":
    main()
