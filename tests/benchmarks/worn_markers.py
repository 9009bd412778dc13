"""Markers clicked on a scan of the person who wears them: how far from where they belong they come back on the model.

    SCAPEKIT_DATA=... python tests/benchmarks/worn_markers.py [-m MODEL.npz] [--poses 2,17] [--men 2] [--people 4]
        [--register] [-o FILE]

The 41 markers of `cmu41` are at vertices of a body, are clicked without error on a virtual scan of it (four views all
around, or one half view), and carried to the model by completing the scan from seven landmarks. Only markers in sight
count. Errors are distances on the model's template. Bodies: held-out poses of the SCAPE man as a known and as an
unknown person, held-out SPRING men, whose own registration is good to about a centimetre along the skin, and synthetic
people with the model of `scape complete`, whose every vertex is true.

Without a model it is learned first: 182 SPRING men and the SCAPE poses of the other folds. `--register` carries the
markers by registration too: of the model's template, and of the body at rest that the completion found.
"""
from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from protocols import RealData, half_view, load_real, machine, scape_fold, spring_split, write_report
from scans import HELD_MEN, HELD_POSES, test_scan

from completion.mocap.marker_sets.layout import MarkerLayout
from completion.mocap.marker_sets.named import layout_on, load_layout
from completion.partial.completion import complete
from model import LearnConfig, learn_scape
from model.body import BodyModel
from model.built_in import load_built_in_model
from model.files import load_model
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.registration.nonrigid import register
from scanprep.skeleton.find import find_skeleton
from scanprep.synthetic.people import BodyShape, SyntheticPerson, random_pose
from scanprep.synthetic.scanner import ScannerConfig, scan

CLICKABLE = 0.005                    # metres from the place of a marker to the scan


class Case(NamedTuple):
    """A scan of somebody whose markers are known."""

    what: str
    name: str
    model: BodyModel
    known: bool
    layout: MarkerLayout
    truth: Mesh                          # in the model's triangles
    scan: Mesh | np.ndarray
    landmarks: tuple[np.ndarray, np.ndarray]
    counted: np.ndarray                  # (L,) bool


def views_of(what: str, name: str, model: BodyModel, known: bool, layout: MarkerLayout, truth: Mesh, whole: Mesh,
             landmarks: tuple[np.ndarray, np.ndarray], k: int, names: dict[str, int]) -> Iterator[Case]:
    """All around, and from one side."""
    yield Case(f"{what}, all around", name, model, known, layout, truth, whole, landmarks,
               in_sight(layout, truth, whole))
    half = half_view(truth, k, names, np.random.default_rng(k))
    yield Case(f"{what}, half view", name, model, known, layout, truth, half.points, half.landmarks,
               half.seen[layout.nearest])


def in_sight(layout: MarkerLayout, truth: Mesh, scan: Mesh) -> np.ndarray:
    """(L,) whether the scan shows the place of a marker, and not the skin of something that touches it."""
    there = Surface(scan).closest(layout.skin_points(truth.vertices))
    facing = np.einsum("ld,ld->l", scan.face_normals[there.faces], truth.vertex_normals[layout.nearest])
    return (there.distances < CLICKABLE) & (facing > 0)


def real_cases(data: RealData, model: BodyModel, kind: str, numbers: list[int]) -> Iterator[Case]:
    """Held-out poses, as a known and as an unknown man, or held-out men."""
    layout = load_layout("cmu41", data.template)
    for k in numbers:
        item = test_scan(data, kind, k)
        landmarks = item.landmarks(data, "7")
        assert landmarks is not None
        for known in ((True, False) if kind == "pose" else (False,)):
            what = "SPRING man" if kind == "man" else "SCAPE man, " + ("known" if known else "unknown")
            yield from views_of(what, item.name, model, known, layout, item.truth, item.scan, landmarks, k,
                                data.landmarks)


def synthetic_cases(count: int) -> Iterator[Case]:
    """Women and men in turn, none of whom the model was learned from, in random poses."""
    model = load_built_in_model()
    kept = np.array(model.info["people_vertices"])
    layout, marks = load_layout("cmu41", model.template, kept), model.info["landmarks"]
    chosen = np.array([v for name, v in marks.items() if name in (
        "left toe", "right toe", "left knee", "left middle finger", "right middle finger", "top of head", "navel")])
    for k in range(count):
        rng = np.random.default_rng(1000 + k)
        person = SyntheticPerson(BodyShape.random(rng, "male" if k % 2 else "female"))
        posed = person.mesh.with_vertices(person.in_pose(0.6 * random_pose(rng)))
        truth = model.template.with_vertices(posed.vertices[kept])
        whole = scan(posed, ScannerConfig(), rng).merged
        yield from views_of("synthetic person", f"person {k}", model, False, layout, truth, whole,
                            (chosen, truth.vertices[chosen]), k, marks)


def off(case: Case, body: np.ndarray) -> np.ndarray:
    """(L,) millimetres on the template, of the markers as a body (N, 3) in the model's triangles carries them."""
    template, surface = case.model.template, case.scan
    true = case.layout.skin_points(case.truth.vertices)
    clicked = Surface(surface).closest(true).points if isinstance(surface, Mesh) else true
    found, _ = layout_on(template.with_vertices(body), dict(zip(case.layout.labels, clicked, strict=True)))
    apart = found.skin_points(template.vertices) - case.layout.skin_points(template.vertices)
    return 1e3 * np.linalg.norm(apart, axis=1)[case.counted]


def measure(case: Case, registering: bool) -> dict[str, object]:
    """A row of the table."""
    start = time.process_time()
    done = complete(case.model.subject(None) if case.known else case.model, case.scan, case.landmarks)
    row: dict[str, object] = {"what": case.what, "scan": case.name, "cpu_s": time.process_time() - start,
                              "verdict": done.judgement.verdict}
    carried = {"completed": done.completed.vertices}
    if registering and isinstance(case.scan, Mesh):
        own = case.model.template.with_vertices(case.model.vertices(np.zeros_like(done.pose), done.betas))
        for name, body in (("template registered", case.model.template), ("own body registered", own)):
            carried[name] = register(body, case.scan, case.landmarks).mesh.vertices
    row["off_mm"] = {name: off(case, body).tolist() for name, body in carried.items()}
    return row


def summed(rows: list[dict]) -> list[dict[str, object]]:
    """Over the scans of a kind, by the way that markers were carried."""
    out: list[dict[str, object]] = []
    for what in dict.fromkeys(row["what"] for row in rows):
        mine = [row for row in rows if row["what"] == what]
        for way in mine[0]["off_mm"]:
            every = np.concatenate([row["off_mm"][way] for row in mine])
            out.append({"what": what, "way": way, "scans": len(mine), "markers": len(every),
                        "mean_mm": float(every.mean()), "median_mm": float(np.median(every)),
                        "nine_of_ten_mm": float(np.quantile(every, 0.9)), "worst_mm": float(every.max()),
                        "cpu_s": float(np.mean([row["cpu_s"] for row in mine])),
                        "flagged": sum(row["verdict"] != "good" for row in mine)})
    return out


def learned(data: RealData) -> BodyModel:
    """The SCAPE poses of the other folds, and 182 men."""
    train = scape_fold(2)[0]
    return learn_scape(data.template, data.poses[train], data.shapes[spring_split(len(data.shapes))[0]],
                       find_skeleton(data.template, data.poses[train]), LearnConfig(components=40))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-m", "--model", help="of the training part; learned when not given")
    parser.add_argument("--poses", default=",".join(map(str, HELD_POSES[:5])))
    parser.add_argument("--men", default=",".join(map(str, HELD_MEN[:3])))
    parser.add_argument("--people", type=int, default=5)
    parser.add_argument("--register", action="store_true", help="by registration too: five times as long")
    parser.add_argument("-o", "--output")
    args = parser.parse_args()
    data = load_real()
    model = load_model(args.model) if args.model else learned(data)
    poses, men = ([int(k) for k in given.split(",") if k] for given in (args.poses, args.men))
    rows = []
    for cases in (real_cases(data, model, "pose", poses), real_cases(data, model, "man", men),
                  synthetic_cases(args.people)):
        for case in cases:
            rows.append(measure(case, args.register))
            print(rows[-1]["what"], rows[-1]["scan"], rows[-1]["verdict"], {
                way: f"{np.mean(mm):.1f}, worst {max(mm):.1f}" for way, mm in rows[-1]["off_mm"].items()}, flush=True)
    for row in summed(rows):
        print(row)
    if args.output:
        write_report(args.output, {"machine": machine(), "means": summed(rows), "rows": rows})


if __name__ == "__main__":
    main()
