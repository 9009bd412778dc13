"""Strangers by models that never saw them: whole scans and half views of SPRING men and SCAPE poses.

    SCAPEKIT_DATA=... python tests/benchmarks/built_in_people.py -o built_in.json [-m people OTHER.npz ...]
        [--set spring|scape] [--only K ...]

The held-out men (SPRING-182/45) or the poses of SCAPE-5fold's fold 0; any human model with named landmarks can be
measured, "people" is the built-in one. Models have other triangles than the scans, so all distances are from true
vertices to the nearest point of a mesh: *whole* of the predicted mesh from 20,000 points of the whole surface with
2 mm noise, *unseen* and *seen* of the half view of DESIGN's protocol with seven landmarks (completed and predicted).
"""
from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
from protocols import half_view, load_real, machine, scape_fold, spring_split, write_report

from completion.partial.completion import complete
from model.files import load_model
from scanprep.geometry.landmark_names import pair_names
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface


def measure_body(model: Any, body: Mesh, k: int, landmarks: dict[str, int]) -> dict[str, float]:
    """Figures of one body, millimetres and seconds."""
    rng = np.random.default_rng(k)
    names = {theirs: mine for mine, theirs in pair_names(model.info["landmarks"], landmarks)}
    known = {name: vertex for name, vertex in landmarks.items() if name in names}
    mine = {vertex: model.info["landmarks"][names[name]] for name, vertex in known.items()}

    def pairs(chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.array([mine[v] for v in chosen]), body.vertices[chosen]

    def distances(mesh: Mesh, of: np.ndarray) -> float:
        return float(1e3 * Surface(mesh).closest(body.vertices[of]).distances.mean())

    start = time.process_time()
    points, _, _ = body.sample(20000, rng)
    points = points + rng.normal(0, 0.002, points.shape)
    every = np.array(list(known.values()))
    seven = every[np.round(np.linspace(0, len(every) - 1, 7)).astype(int)]
    whole = complete(model, points, pairs(seven))
    view = half_view(body, k, known, rng)
    half = complete(model, view.points, pairs(view.landmarks[0]))
    everywhere = np.ones(len(body.vertices), dtype=bool)
    return {"whole_mm": distances(whole.predicted, everywhere), "unseen_mm": distances(half.completed, ~view.seen),
            "unseen_predicted_mm": distances(half.predicted, ~view.seen),
            "seen_predicted_mm": distances(half.predicted, view.seen),
            "betas": float(np.linalg.norm(whole.betas)), "largest_beta": float(np.abs(whole.betas).max()),
            "cpu_seconds": time.process_time() - start}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("-m", "--models", nargs="+", default=["people"])
    parser.add_argument("--set", choices=("spring", "scape"), default="spring")
    parser.add_argument("--only", type=int, nargs="*")
    args = parser.parse_args()
    data = load_real()
    bodies = data.shapes[spring_split()[1]] if args.set == "spring" else data.poses[scape_fold(0)[1]]
    models, rows = {name: load_model(name) for name in args.models}, []
    for k in range(len(bodies)) if args.only is None else args.only:
        for name, model in models.items():
            rows.append({"k": k, "model": name,
                         **measure_body(model, data.template.with_vertices(bodies[k]), k, data.landmarks)})
            print(k, name, {key: round(value, 2) for key, value in rows[-1].items() if key not in ("k", "model")},
                  flush=True)
    for name in models:
        mine = [row for row in rows if row["model"] == name]
        print(name, {key: (round(float(np.mean([row[key] for row in mine])), 2),
                           round(max(row[key] for row in mine), 2)) for key in mine[0] if key not in ("k", "model")})
    write_report(args.output, {"machine": machine(), "set": args.set, "rows": rows})


if __name__ == "__main__":
    main()
