"""The two searches for pose and shape on the same scans: that of `complete` and that of `register_with_model`.

    SCAPEKIT_DATA=... python tests/benchmarks/searches.py -m MODEL.npz --fold FOLD_0.npz -o searches.json

Whole scans (four virtual views) of four held-out men of unknown shape, and half views of a known man in three poses of
fold 0, each with seven landmarks and without any. Time is that of the whole call, which in one case ends with the free
surface and in the other with a non-rigid registration.
"""
from __future__ import annotations

import argparse
import time
from collections.abc import Iterator

import numpy as np
from protocols import RealData, half_view, load_real, machine, scape_fold, spring_split, write_report
from scans import test_scan

from completion import complete
from model import BodyModel, Subject, load_model, register_with_model
from scanprep.geometry.mesh import Mesh

MEN, POSES = (2, 8, 14, 20), (0, 2, 4)              # of the held-out men; of the held-out poses of the fold
Landmarks = tuple[np.ndarray, np.ndarray]
Case = tuple[str, BodyModel | Subject, Mesh | np.ndarray, Landmarks | None, np.ndarray]


def cases(data: RealData, people: BodyModel, fold: BodyModel) -> Iterator[Case]:
    """What, body, scan, seven landmarks, true vertices (N, 3)."""
    held = spring_split(len(data.shapes))[1]
    for k in MEN:
        item = test_scan(data, "man", int(held[k]))
        yield "whole scan, unknown man", people, item.scan, item.landmarks(data, "7"), item.truth.vertices
    poses, known = data.poses[scape_fold(0)[1]], fold.subject(None)
    for k in POSES:
        body = data.template.with_vertices(poses[k])
        view = half_view(body, k, data.landmarks, np.random.default_rng(k))
        yield "half view, known man", known, view.points, view.landmarks, body.vertices


def measured(body: BodyModel | Subject, scan: Mesh | np.ndarray, landmarks: Landmarks | None, truth: np.ndarray,
             part: np.ndarray, way: str) -> dict[str, float]:
    """Millimetres to the true vertices: the mesh, the model's own, the part of it that is farthest; seconds."""
    start = time.process_time()
    if way == "complete":
        done = complete(body, scan, landmarks)
        mesh, predicted = done.completed, done.predicted
    else:
        found = register_with_model(body, scan, landmarks)
        mesh, predicted = found.mesh, found.predicted
    seconds = time.process_time() - start
    mesh_mm, model_mm = (1e3 * np.linalg.norm(m.vertices - truth, axis=1) for m in (mesh, predicted))
    worst = max(float(model_mm[part == j].mean()) for j in np.unique(part))
    return {"mesh_mm": float(mesh_mm.mean()), "model_mm": float(model_mm.mean()), "worst_part_mm": worst,
            "cpu_s": seconds}


def main() -> None:
    """Both ways on all cases."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-m", "--model", required=True, help="of the 182 training men")
    parser.add_argument("--fold", required=True, help="of the training poses of fold 0")
    parser.add_argument("-o", "--output", default="searches.json")
    args = parser.parse_args()
    data, people, fold = load_real(), load_model(args.model), load_model(args.fold)
    rows = []
    for what, body, scan, marks, truth in cases(data, people, fold):
        part = body.skeleton.part_of_vertex(data.template)
        for landmarks in (marks, None):
            for way in ("complete", "register_with_model"):
                row = {"what": what, "landmarks": 7 if landmarks else 0, "way": way,
                       **measured(body, scan, landmarks, truth, part, way)}
                rows.append(row)
                print(row, flush=True)
    write_report(args.output, {"machine": machine(), "rows": rows})


if __name__ == "__main__":
    main()
