"""An imported model of the SMPL layout beside our own SCAPE model of as many synthetic people, on people not learned.

    python tests/benchmarks/imported_models.py -o imported_models.json [--bodies 4] [--frames 240] [--star] [--smplx]

Both have about 5,000 vertices that all synthetic people share; the imported one has 24 joints, 10 betas and 207 pose
columns. Half views are those of the protocol, landmarks included. 41 named and 6 spread markers, 9.5 mm above the skin,
walk along without noise. Figures are means over all vertices, millimetres, and wall-clock seconds of the whole call.
"""
from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from protocols import half_view, machine, write_report

sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[1] / "people")]
RATE = 60.0


def models(faces: int, which: list[str]) -> dict[str, tuple[Any, np.ndarray]]:
    """The models with the vertices of `Person` that they have."""
    from make_model import learn_people_model
    from published_bodies import as_smplx, as_star, synthetic_smpl

    from model.importing import import_model

    scape = learn_people_model(60, faces)
    made, out = synthetic_smpl(faces, 30, 60), {"SCAPE": (scape, np.array(scape.info["people_vertices"]))}
    with tempfile.TemporaryDirectory() as folder:
        for name, make in (("SMPL layout", dict), ("STAR layout", as_star), ("SMPL-X layout", as_smplx)):
            if name.split()[0] in which:
                path = Path(folder) / "model.npz"
                np.savez(path, **make(made.arrays))
                out[name] = import_model(path), made.vertices
    return out


def tried(call: Any) -> tuple[Any, float]:
    start = time.perf_counter()
    return call(), time.perf_counter() - start


def half_views(model: Any, own: np.ndarray, people: list[Any]) -> dict[str, float]:
    from completion.partial.completion import complete
    from scanprep.geometry.surface import Surface
    from scanprep.synthetic.landmarks import landmarks

    here = {int(v): i for i, v in enumerate(own)}
    marks = {name: here[v] for name, v in landmarks().items() if v in here}
    rows = []
    for k, (person, pose) in enumerate(people):
        body = model.template.with_vertices(person.in_pose(pose)[own])
        view = half_view(body, k, marks, np.random.default_rng(k))
        found, seconds = tried(lambda: complete(model, view.points, view.landmarks))                    # noqa: B023
        off = np.linalg.norm(found.completed.vertices - body.vertices, axis=1)
        seen = Surface(body).closest(found.completed.vertices[view.seen]).distances.mean()
        rows.append((1e3 * seen, 1e3 * off[~view.seen].mean(), seconds))
    return dict(zip(("seen_mm", "unseen_mm", "seconds"), np.mean(rows, axis=0).tolist(), strict=True))


def walking(model: Any, own: np.ndarray, people: list[Any], frames: int) -> dict[str, dict[str, float]]:
    from completion.mocap.files.markers import MarkerSequence
    from completion.mocap.marker_sets.layout import MarkerLayout
    from completion.mocap.mosh.mosh import mosh
    from completion.mocap.pose.follow import animate
    from model.fitting.vertices import fit_shape
    from scanprep.geometry.farthest_points import farthest_points
    from scanprep.synthetic.landmarks import markers
    from scanprep.synthetic.people import synthesise_walk

    here = {int(v): i for i, v in enumerate(own)}
    named = {name: here[v] for name, v in markers().items() if v in here}
    spread = farthest_points(model.template.vertices, 6)
    layout = MarkerLayout((*named, *(f"X{i}" for i in range(6))), np.array([*named.values(), *spread]), 0.0095)
    poses, trans = synthesise_walk(frames, RATE)
    rows: dict[str, list[Any]] = {"markers, shape known": [], "MoSh": []}
    for person, _ in people[:2]:
        bodies = np.stack([person.in_pose(pose, t)[own] for pose, t in zip(poses, trans, strict=True)])
        seen = MarkerSequence(np.stack([layout.place(model.template.with_vertices(y)) for y in bodies]),
                              layout.labels, RATE)
        subject = model.subject(fit_shape(model, person.mesh.vertices[own]).betas)
        motion, seconds = tried(lambda: animate(subject, seen, layout))                                 # noqa: B023
        rows["markers, shape known"].append((_off(motion.vertices(subject), bodies), seconds))
        found, seconds = tried(lambda: mosh(seen, model, layout))                                       # noqa: B023
        rows["MoSh"].append((_off(found.motions[0].vertices(model.subject(found.betas)), bodies), seconds))
    return {name: dict(zip(("mean_mm", "seconds"), np.mean(each, axis=0).tolist(), strict=True))
            for name, each in rows.items()}


def _off(found: np.ndarray, bodies: np.ndarray) -> float:
    return 1e3 * float(np.linalg.norm(found - bodies, axis=2).mean())


def main() -> None:
    from published_bodies import people_near_rest

    from model.fitting.vertices import fit_shape

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--bodies", type=int, default=4)
    parser.add_argument("--frames", type=int, default=240)
    parser.add_argument("--faces", type=int, default=10000)
    parser.add_argument("--star", action="store_true")
    parser.add_argument("--smplx", action="store_true")
    args = parser.parse_args()
    which = ["SMPL"] + ["STAR"] * args.star + ["SMPL-X"] * args.smplx
    people, report = people_near_rest(args.bodies, 77), {"machine": machine(), "frames": args.frames}
    for name, (model, own) in models(args.faces, which).items():
        rest = [fit_shape(model, person.mesh.vertices[own]).mean for person, _ in people]
        poses = np.random.default_rng(0).normal(0, 0.3, (256, len(model.skeleton.parents), 3))
        subject, _ = tried(lambda: model.subject(np.zeros(model.n_betas), dtype=np.float32))            # noqa: B023
        rows = {"fit of whole bodies": {"mean_mm": 1e3 * float(np.mean(rest))},
                "256 bodies of one person": {"seconds": tried(lambda: subject.vertices(poses))[1]},      # noqa: B023
                **walking(model, own, people, args.frames)}
        if name in ("SCAPE", "SMPL layout"):
            rows["half views"] = half_views(model, own, people)
        report[name] = rows
        print(name, rows, flush=True)
        write_report(args.output, report)


if __name__ == "__main__":
    main()
