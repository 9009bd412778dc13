"""Whether bumps and hollows of the template come to lie on those of the scan: where we put them, and in the reference.

    SCAPEKIT_DATA=... python tests/benchmarks/signatures.py [--poses 3,24,48] [-o FILE]

Mean curvature of the template at rest, smoothed over 6 to 35 mm, against that of the true posed surface at the place of
every vertex: by the published registration of that scan, by the same slid 4 mm at random, by ours from ten landmarks.
The correlation (weighted by area) is highest where the skin is most probably in its place. Places of ours lie inside
triangles of the reference and are interpolated, which costs a little, as the slid places show.
"""
from __future__ import annotations

import argparse

import igl
import numpy as np
from protocols import load_real, machine, write_report
from scans import TUNING_POSES, test_scan
from scipy.sparse import csc_array, diags_array

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.sparse import Factored
from scanprep.geometry.surface import Surface
from scanprep.registration.nonrigid import register

SCALES = (0.006, 0.012, 0.02, 0.035)        # metres
SLIDE = 0.004                               # metres, RMS of each coordinate


def signature(mesh: Mesh) -> np.ndarray:
    """(N, scales) mean curvature, smoothed over and multiplied by each scale."""
    cotangents = csc_array(igl.cotmatrix(mesh.vertices, mesh.faces))
    area = igl.massmatrix(mesh.vertices, mesh.faces, igl.MASSMATRIX_TYPE_VORONOI).diagonal()
    curvature = -((cotangents @ mesh.vertices) * mesh.vertex_normals).sum(axis=1) / 2          # times the area
    return np.stack([s * Factored(csc_array(diags_array(area) - s**2 * cotangents)).solve(curvature) for s in SCALES],
                    axis=1)


def correlation(a: np.ndarray, b: np.ndarray, weights: np.ndarray) -> list[float]:
    """Of every column."""
    a, b = (x - np.average(x, axis=0, weights=weights) for x in (a, b))
    return ((weights @ (a * b)) / np.sqrt((weights @ a**2) * (weights @ b**2))).tolist()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--poses", default=",".join(map(str, TUNING_POSES)))
    parser.add_argument("-o", "--output")
    args = parser.parse_args()
    data = load_real()
    rest, weights = signature(data.template), data.template.vertex_areas
    rows = []
    for index in map(int, args.poses.split(",")):
        item = test_scan(data, "pose", index)
        surface, there = Surface(item.truth), signature(item.truth)
        ours = register(data.template, item.scan, item.landmarks(data, "10")).mesh.vertices
        slid = item.truth.vertices + np.random.default_rng(index).normal(0, SLIDE, ours.shape)
        carried = (surface.closest(x).transfer(there, item.truth.faces) for x in (slid, ours))
        rows.append({"pose": index, "apart_mm": 1e3 * float(np.linalg.norm(ours - item.truth.vertices, axis=1).mean())}
                    | {name: correlation(rest, values, weights)
                       for name, values in zip(("reference", "slid", "ours"), (there, *carried), strict=True)})
        print(rows[-1], flush=True)
    means = {name: np.mean([row[name] for row in rows], axis=0).tolist() for name in ("reference", "slid", "ours")}
    print(means)
    if args.output:
        write_report(args.output, {"machine": machine(), "scales_mm": [1e3 * s for s in SCALES], "rows": rows,
                                 "means": means})


if __name__ == "__main__":
    main()
