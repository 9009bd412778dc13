"""Marker-less capture: a procedural walk seen by virtual depth cameras, and real poses where they are at hand.

Run:  python tests/benchmarks/tracking.py -o FILE [--quick] [--only NAME ...] [--real MODEL.npz FOLD]

The walking person is not among those that the model of the synthetic people was learned from. The scanner's cameras
go along with the person, 2.5 m away. Real motion leads through held-out poses: the model's poses in between, and what
the model cannot follow of each mesh carried along, so that the surface that is tracked is not the model's own.
"""
from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from protocols import load_real, machine, scape_fold, write_report
from scipy.spatial.transform import Rotation, Slerp

from completion import TrackConfig, track
from model import Subject, fit_pose, load_model
from model.body import BodyModel
from model.built_in import load_built_in_model
from model.posing.transfer import subject_from_body
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.synthetic.people import BodyShape, SyntheticPerson, synthesise_walk
from scanprep.synthetic.scanner import ScannerConfig, scan

CAMERAS = ScannerConfig(views=2, azimuth=30.0, height=0.3, resolution=0.008, noise=0.005)
RATE, FRAMES, SEED = 30.0, 120, 77
GAP = BURST = 10

Frames = list[list[Mesh]]
Change = Callable[[Frames], list]


def record(bodies: np.ndarray, faces: np.ndarray, seed: int) -> Frames:
    """What the cameras see of bodies (T, N, 3)."""
    rng = np.random.default_rng(seed)
    return [[view.mesh for view in scan(Mesh(body, faces), CAMERAS, rng).views] for body in bodies]


def whole(frames: Frames) -> list:
    return list(frames)


def one_camera(frames: Frames) -> list:
    return [views[:1] for views in frames]


def bare_points(frames: Frames) -> list:
    return [[view.vertices for view in views] for views in frames]


def gap(frames: Frames) -> list:
    """Nothing is seen for some frames in the middle."""
    first = len(frames) // 2 - GAP // 2
    return [None if first <= i < first + GAP else views for i, views in enumerate(frames)]


def half_gone(frames: Frames) -> list:
    """For some frames only what is above the middle is seen."""
    first = len(frames) // 2 - BURST // 2

    def upper(view: Mesh) -> np.ndarray:
        height = view.vertices[:, 2]
        return view.vertices[height > 0.5 * (height.min() + height.max())]

    return [[upper(v) for v in views] if first <= i < first + BURST else views for i, views in enumerate(frames)]


def measure(body: BodyModel | Subject, model: BodyModel, frames: list, truth: np.ndarray, faces: np.ndarray,
            kept: np.ndarray, gone: slice | None = None, landmarks: tuple[np.ndarray, np.ndarray] | None = None
            ) -> dict[str, object]:
    """Errors in millimetres of one run; `kept` are the vertices of the truth that the model has."""
    begun = time.process_time()
    motion = track(body, frames, TrackConfig(), landmarks, rate=RATE)
    seconds = (time.process_time() - begun) / len(frames)
    subject = body if isinstance(body, Subject) else model.subject(motion.betas)
    found = motion.vertices(subject)
    surface, seen = [], []
    for t, (vertices, true) in enumerate(zip(found, truth, strict=True)):
        surface.append(Surface(Mesh(true, faces)).closest(vertices).distances.mean())
        points = [] if frames[t] is None else [v.vertices if isinstance(v, Mesh) else v for v in frames[t]]
        if points:
            # the clean places of what was seen: noise would be counted as error
            clean = Surface(Mesh(true, faces)).closest(np.concatenate(points)).points
            seen.append(Surface(subject.template.with_vertices(vertices)).closest(clean).distances.mean())
    corresponding = np.linalg.norm(found - truth[:, kept], axis=2).mean(axis=1)
    surface_, vertex = 1000 * np.array(surface), 1000 * corresponding
    shown = np.ones(len(frames), dtype=bool)
    if gone is not None:
        shown[gone] = False
    return {"surface": surface_[shown].mean(), "surface, worst frame": surface_[shown].max(),
            "seen part": 1000 * np.mean(seen), "vertices": vertex[shown].mean(),
            "vertices, worst frame": vertex[shown].max(),
            "surface in the disturbed frames": surface_[~shown].mean() if gone is not None else None,
            "lost frames with data": int((~motion.converged & np.array([f is not None for f in frames])).sum()),
            "lost frames": int((~motion.converged).sum()), "CPU s a frame": seconds}


def procedural(only: list[str], count: int) -> dict[str, object]:
    """The walk, with everything that may go wrong."""
    model = load_built_in_model()
    kept = np.array(model.info["people_vertices"])
    person = SyntheticPerson(BodyShape.random(np.random.default_rng(SEED)))
    poses, trans = synthesise_walk(count, RATE)
    truth = np.stack([person.in_pose(pose, place) for pose, place in zip(poses, trans, strict=True)])
    frames = record(truth, person.mesh.faces, SEED)
    known = subject_from_body(model, person.mesh.vertices[kept])
    middle = slice(count // 2 - GAP // 2, count // 2 - GAP // 2 + GAP)
    runs: dict[str, tuple[BodyModel | Subject, Change, slice | None]] = {
        "known shape": (known, whole, None), "unknown shape": (model, whole, None),
        "bare points": (model, bare_points, None), "one camera": (model, one_camera, None),
        "gap of 10": (model, gap, middle), "lower half gone for 10": (model, half_gone, middle)}
    out: dict[str, object] = {}
    for name, (body, change, gone) in runs.items():
        if not only or name in only:
            out[name] = measure(body, model, change(frames), truth, person.mesh.faces, kept, gone)
            print(name, out[name], flush=True)
    return out


def real(path: Path, fold: int, step: int) -> dict[str, object]:
    """A motion through held-out poses of the real man, with what the model cannot follow carried along."""
    model, data = load_model(path), load_real()
    held = scape_fold(fold)[1][:6]
    subject = model.subject(None)
    fits = [fit_pose(subject, data.poses[i]) for i in held]
    part = model.skeleton.part_of_vertex(model.template)

    def turns(pose: np.ndarray) -> np.ndarray:
        return model.skeleton.part_rotations(pose)[part]

    left = np.stack([np.einsum("nji,nj->ni", turns(f.pose), data.poses[i] - f.vertices)
                     for f, i in zip(fits, held, strict=True)])
    at = np.arange((len(fits) - 1) * step + 1) / step
    key = np.arange(len(fits))
    ease = np.floor(at) + 0.5 - 0.5 * np.cos(np.pi * (at - np.floor(at)))
    poses = np.stack([Slerp(key, Rotation.from_rotvec([f.pose[j] for f in fits]))(ease).as_rotvec()
                      for j in range(len(model.skeleton.parents))], axis=1)
    trans = np.stack([np.interp(ease, key, [f.trans[d] for f in fits]) for d in range(3)], axis=1)
    low = np.minimum(np.floor(ease).astype(int), len(fits) - 2)
    share = (ease - low)[:, None, None]
    rest = (1 - share) * left[low] + share * left[low + 1]
    truth = np.stack([subject.vertices(p, t) + np.einsum("nij,nj->ni", turns(p), r)
                      for p, t, r in zip(poses, trans, rest, strict=True)])
    frames = record(truth, data.template.faces, SEED)
    out = measure(subject, model, list(frames), truth, data.template.faces, np.arange(truth.shape[1]))
    print("real", out, flush=True)
    return {f"real motion through held-out poses of fold {fold}, known shape": out}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", default="tracking.json")
    parser.add_argument("--quick", action="store_true", help="40 frames")
    parser.add_argument("--only", nargs="*", default=[])
    parser.add_argument("--real", nargs=2, metavar=("MODEL", "FOLD"))
    given = parser.parse_args()
    if given.real:
        runs = real(Path(given.real[0]), int(given.real[1]), 6 if given.quick else 15)
    else:
        runs = procedural(given.only, 40 if given.quick else FRAMES)
    write_report(given.output, {"machine": machine(), "unit": "mm", "runs": runs})


if __name__ == "__main__":
    main()
