"""Co-registration of virtual four-view scans of one man: errors before, and after each round.

    SCAPEKIT_DATA=... python tests/benchmarks/coregistration.py [--landmarks 4|7|10] [--again 0|4|7|10] [--rounds 2]
        [--faces 5000] [--held] [--beside 10] [--clickless 0] [-o coregistration.json]

1. The template is registered to every scan without a model, with few landmarks.
2. Skeleton and model are learned from those whose scan they explain; the truth is not asked.
3. All scans are registered with the model and it is learned again, round by round.
4. With the last model, the scans are registered once more without start and landmarks (--clickless N of them).

A registration whose vertices are wrong by more than 25 mm on average has failed. Copies of the bodies with few
triangles, made by one vertex map, keep it short; --faces 0 takes the bodies as they are.
"""
from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from protocols import RealData, load_real, machine, write_report
from scans import HELD_POSES, MARKS, TUNING_POSES, TestScan, test_scan
from scipy.spatial import cKDTree

from model import learn_scape
from model.coregistration.config import CoregistrationConfig
from model.coregistration.rounds import coregister, task_name
from model.coregistration.single import EXPLAINED, apart, register_with_model
from model.learning.config import LearnConfig
from scanprep.batch.opening import workspace
from scanprep.batch.pool import Workers
from scanprep.decimation.decimate import decimate
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.geometry.target import orient_by_mesh, target_of
from scanprep.registration.nonrigid import register
from scanprep.skeleton.find import find_skeleton

TOO_FAR = 25.0                       # mm
BESIDE = (45, 20, 54, 16, 1, 5, 11, 35, 40, 66)     # poses that are scanned too, besides ten to look at


def coarse(data: RealData, faces: int) -> RealData:
    """The poses on fewer triangles, all by one map; landmarks on the nearest vertices."""
    if not faces:
        return data
    small = decimate(data.template, faces)
    on = Surface(data.template).closest(small.vertices)
    poses = np.stack([on.transfer(p, data.template.faces) for p in data.poses])
    near = cKDTree(poses[0]).query(data.template.vertices[list(data.landmarks.values())])[1]
    return RealData(Mesh(poses[0], small.faces), poses, poses[:0],
                    dict(zip(data.landmarks, near.tolist(), strict=True)))


class Story:
    """The scans, their truth, and the rows of the report."""

    def __init__(self, data: RealData, scans: list[TestScan], poses: tuple[int, ...], shown: tuple[int, ...]) -> None:
        self.data, self.scans, self.poses = data, scans, poses
        self.truth = data.poses[list(poses)]
        self.shown = np.isin(poses, shown)
        self.seen = [cKDTree(s.scan.vertices).query(t)[0] < 0.012 for s, t in zip(scans, self.truth, strict=True)]
        self.rows: list[dict[str, Any]] = []
        self.begun = time.process_time()

    def marks(self, which: str) -> list[tuple[np.ndarray, np.ndarray] | None]:
        vertices = np.array([self.data.landmarks[name] for name in MARKS[which]], dtype=np.int64)
        return [(vertices, body[vertices]) if len(vertices) else None for body in self.truth]

    def tell(self, what: str, found: dict[int, np.ndarray], inverted: int = -1) -> None:
        """Measure vertices (N, 3) of some scans, by number, and print a row."""
        which = np.array(list(found))
        apart = [1e3 * np.linalg.norm(found[i] - self.truth[i], axis=1) for i in which]
        off = [1e3 * Surface(self.data.template.with_vertices(self.truth[i])).closest(found[i]).distances[self.seen[i]]
               for i in which]
        mean, shown = np.array([a.mean() for a in apart]), self.shown[which]
        row = {"what": what, "scans": len(which), "failed": int((mean > TOO_FAR).sum()), "all_mm": float(mean.mean()),
               "median_mm": float(np.median(mean)), "worst_mm": float(mean.max()),
               "shown_mm": float(mean[shown].mean()), "shown_failed": int((mean[shown] > TOO_FAR).sum()),
               "surface_seen_mm": float(np.mean([o.mean() for o in off])),
               "beyond_50mm": float(np.mean([(a > 50).mean() for a in apart])), "inverted": inverted,
               "cpu_s": time.process_time() - self.begun,
               "each_mm": {self.poses[i]: float(m) for i, m in zip(which, mean, strict=True)}}
        self.rows.append(row)
        print(" ".join(f"{k}={v:.2f}" if isinstance(v, float) else f"{k}={v}" for k, v in row.items()
                       if k != "each_mm"), flush=True)


def explained_share(mesh: Mesh, scan: Mesh | np.ndarray) -> float:
    """Share of the points of a scan that lie near a registered mesh and do not face away from it."""
    size = float(np.sqrt(mesh.face_areas.sum()))
    target = orient_by_mesh(target_of(scan).thin(0.01 * size), mesh, 0.05 * size)
    return float((apart(mesh, target, EXPLAINED * size) < EXPLAINED * size).mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--landmarks", choices=MARKS, default="7")
    parser.add_argument("--again", choices=MARKS, help="landmarks of the later rounds; as the first without")
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--faces", type=int, default=5000)
    parser.add_argument("--held", action="store_true", help="show the held-out poses instead of those for tuning")
    parser.add_argument("--beside", type=int, default=10, help="how many further poses are scanned and learned from")
    parser.add_argument("--clickless", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("-o", "--output", default="coregistration.json")
    args = parser.parse_args()
    whole = load_real()
    shown = HELD_POSES if args.held else TUNING_POSES
    poses = (*shown, *BESIDE[:args.beside])
    data = coarse(whole, args.faces)
    story = Story(data, [test_scan(whole, "pose", i) for i in poses], poses, shown)
    config = CoregistrationConfig(rounds=args.rounds, workers=Workers(args.workers), learn=LearnConfig(refinements=1))

    plain = [register(data.template, s.scan, m) for s, m in zip(story.scans, story.marks(args.landmarks), strict=True)]
    first = np.stack([r.mesh.vertices for r in plain])
    story.tell("without a model", dict(enumerate(first)), sum(r.inverted for r in plain))
    good = np.array([explained_share(r.mesh, s.scan) >= 1 - config.failed
                     for r, s in zip(plain, story.scans, strict=True)])
    story.tell("those that explain their scan", {int(i): first[i] for i in np.flatnonzero(good)})
    bodies = np.concatenate([data.template.vertices[None], first[good]])
    skeleton = find_skeleton(data.template, bodies)
    model = learn_scape(data.template, bodies, None, skeleton, config.learn)
    names = [str(pose) for pose in poses]
    with tempfile.TemporaryDirectory() as folder, workspace(folder) as space:
        done = coregister(model, [s.scan for s in story.scans], story.marks(args.again or args.landmarks), config,
                          list(first), names=names, space=space)
        for turn in range(done.rounds):
            now = {i: space.value(task_name(turn, name)) for i, name in enumerate(names) if name not in done.failures}
            story.tell(f"round {turn + 1}", {i: r.mesh.vertices for i, r in now.items()},
                       sum(r.inverted for r in now.values()))
            story.tell(f"round {turn + 1}, predicted", {i: r.predicted.vertices for i, r in now.items()})
    if args.clickless:
        free = replace(config, fit=replace(config.fit, up=(0.0, 0.0, 1.0)))
        person = done.model.subject()
        story.tell("no start, no landmark", {i: register_with_model(person, story.scans[i].scan, config=free
                                                                    ).mesh.vertices for i in range(args.clickless)})
    settings = {name: value for name, value in vars(args).items() if name != "output"}
    write_report(Path(args.output), {"protocol": __doc__, "machine": machine(), "settings": settings, "poses": poses,
                                  "shown": shown, "parts": len(skeleton.parents), "rows": story.rows,
                                  "converged": done.converged})


if __name__ == "__main__":
    main()
