"""Half views completed: held-out SCAPE poses of a known subject, or held-out SPRING men of unknown shape.

    SCAPEKIT_DATA=... python tests/benchmarks/half_views.py -o half_views.json --pictures DIR
    SCAPEKIT_DATA=... python tests/benchmarks/half_views.py -m MODEL.npz --marks 0 -o half_views_blind.json
    SCAPEKIT_DATA=... python tests/benchmarks/half_views.py --people -m MODEL.npz -o half_people.json
    SCAPEKIT_DATA=... python tests/benchmarks/half_views.py -m MODEL.npz --only 0 1 2 3 4 --published -o published.json

Without a model it is learned first, from the training part alone. `seen` is the distance of the seen vertices to
the true surface, `unseen` that of corresponding vertices; both for the completed mesh and for the predicted one.
With `--marks 0` there are no landmarks. A limb counts as flipped when the vertices of one part are FLIPPED off in
the mean, and at least SHOWN of them were seen: where nothing was seen of it, its place is a guess.
"""
from __future__ import annotations

import argparse
import dataclasses
import time
from pathlib import Path

import numpy as np
from protocols import HalfView, RealData, half_view, load_real, machine, scape_fold, spring_split, write_report

from completion.partial.completion import Completion, complete
from completion.partial.settings import CompletionConfig
from model import LearnConfig, learn_scape
from model.files import load_model
from model.scape import ScapeModel
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.skeleton.find import find_skeleton

FLIPPED, FAR = 100.0, 30.0           # mm: mean of one part, and of all that was not seen
SHOWN = 0.2                          # share of a part's vertices


def errors(body: Mesh, view: HalfView, result: Completion, part: np.ndarray) -> dict[str, float]:
    """Figures of one completion, millimetres."""
    surface, out = Surface(body), {}
    for name, mesh in (("completed", result.completed), ("predicted", result.predicted)):
        apart = 1e3 * np.linalg.norm(mesh.vertices - body.vertices, axis=1)
        out[f"{name}_seen_mm"] = 1e3 * surface.closest(mesh.vertices[view.seen]).distances.mean()
        out[f"{name}_unseen_mm"] = apart[~view.seen].mean()
    worst = [apart[part == p].mean() for p in range(part.max() + 1)]
    shown = [view.seen[part == p].mean() for p in range(part.max() + 1)]
    seen_worst = max(w for w, s in zip(worst, shown, strict=True) if s >= SHOWN)
    out |= {"below_30_mm": out["completed_unseen_mm"] < FAR, "flipped": seen_worst > FLIPPED,
            "worst_part_mm": max(worst), "worst_part": int(np.argmax(worst)), "worst_seen_part_mm": seen_worst,
            "explained": result.explained,
            "landmark_rms_mm": 1e3 * result.landmark_rms, "rounds": result.iterations,
            "converged": result.converged}
    return {name: round(float(value), 3) for name, value in out.items() if np.isfinite(value)}   # no landmarks, no rms


def picture(body: Mesh, view: HalfView, result: Completion, path: Path) -> None:
    """Truth, completed mesh (seen and unseen) and its error, from the camera and from behind."""
    from scanprep.pictures.camera import Camera
    from scanprep.pictures.colors import heat
    from scanprep.pictures.shading import Dots, Solid, render
    from scanprep.pictures.sheets import contact_sheet, save_png

    apart = np.linalg.norm(result.completed.vertices - body.vertices, axis=1)
    two = np.where(result.seen[:, None], [0.45, 0.6, 0.8], [0.9, 0.6, 0.35])
    marks = Dots(view.landmarks[1], (0.8, 0.1, 0.1), 0.015)
    shapes: list[list[Solid | Dots]] = [[Solid(body), marks], [Solid(result.completed, two)],
                                        [Solid(result.completed, heat(apart, 0, 0.05))]]
    away = view.camera - body.vertices.mean(axis=0)
    azimuth = np.degrees(np.arctan2(away[1], away[0]))
    images = [render(shape, Camera.around(body, azimuth + turn), width=300, height=400)
              for turn in (0, 180) for shape in shapes]
    save_png(path, contact_sheet(images, columns=3))


def learned(data: RealData, people: bool, fold: int) -> ScapeModel:
    """The model of the training part: 182 people and all poses, or the poses of a fold."""
    if people:
        train, _ = spring_split(len(data.shapes))
        return learn_scape(data.template, data.poses, data.shapes[train], find_skeleton(data.template, data.poses),
                           LearnConfig(components=40))
    train, _ = scape_fold(fold)
    return learn_scape(data.template, data.poses[train], None, find_skeleton(data.template, data.poses[train]))


def main() -> None:
    """Complete every half view and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", default="half_views.json")
    parser.add_argument("-m", "--model", help="of the training part; learned when not given")
    parser.add_argument("--people", action="store_true", help="SPRING men of unknown shape")
    parser.add_argument("--fold", type=int, default=0)
    parser.add_argument("--only", type=int, nargs="*", help="indices in the list of held-out bodies")
    parser.add_argument("--marks", type=int, choices=(0, 7), default=7, help="landmarks on each view")
    parser.add_argument("--published", action="store_true", help="the paper's way, beside the default")
    parser.add_argument("--known-viewpoint", action="store_true", help="tell where the camera stood")
    parser.add_argument("--pictures", type=Path, help="folder for a picture of each")
    args = parser.parse_args()
    data = load_real()
    model = load_model(args.model) if args.model else learned(data, args.people, args.fold)
    bodies = data.shapes[spring_split(len(data.shapes))[1]] if args.people else data.poses[scape_fold(args.fold)[1]]
    subject = model if args.people or args.published else model.subject(None)      # the paper's way takes models only
    part = model.skeleton.part_of_vertex(data.template)
    rows = []
    for k in args.only if args.only is not None else range(len(bodies)):
        body = data.template.with_vertices(bodies[k])
        view = half_view(body, k, data.landmarks, np.random.default_rng(k))
        config = CompletionConfig.from_paper() if args.published else CompletionConfig()
        config = dataclasses.replace(config, viewpoint=tuple(view.camera) if args.known_viewpoint else None)
        start, cpu = time.perf_counter(), time.process_time()
        result = complete(subject, view.points, view.landmarks if args.marks else None, config)
        row = {"k": k, **errors(body, view, result, part), "seconds": round(time.perf_counter() - start, 2),
               "cpu_seconds": round(time.process_time() - cpu, 2)}
        rows.append(row)
        print(row, flush=True)
        if args.pictures:
            picture(body, view, result, args.pictures / f"{'person' if args.people else 'pose'}_{k:02d}.png")
    mean = {name: float(np.mean([row[name] for row in rows])) for name in rows[0] if name not in ("k", "worst_part")}
    for name, value in mean.items():
        print(f"{name:24s} {value:8.2f}")
    write_report(args.output, {"protocol": "half views", "people": args.people, "fold": args.fold,
                               "marks": args.marks,
                               "machine": machine(), "config": dataclasses.asdict(config), "mean": mean,
                               "rows": rows})


if __name__ == "__main__":
    main()
