"""What the verdict is on wrong inputs, and on right ones: no wrong one may be good, few right ones anything else.

    python tests/benchmarks/wrong_inputs.py --folder WORK [-o FILE] [--only WORDS ...]

Everything is made of the synthetic people, of seeds that chose no limit when they were run first; then registration's
limits on parts of a body, exchanged sides and stretch were set by seeds 100 and 209, which test them no longer. Each
case is a command of `scape` on files in a folder of its own; one that was run before is not run again. `mean_mm` and
`part_mm` are how far the vertices of the body that was written are from where they belong, on average and for the worst
part: a wrong input may be mended, and may then be called good.
"""
from __future__ import annotations

import argparse
import contextlib
import io
import json
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from protocols import machine, write_report

from completion.__main__ import main as scape
from completion.mocap.files.markers import MarkerSequence, write_markers
from completion.mocap.marker_sets.named import choose_layout
from model.built_in import load_built_in_model
from scanprep import Mesh, write_landmarks, write_mesh
from scanprep.geometry import rotations
from scanprep.geometry.files import read_mesh
from scanprep.synthetic.people import MARKERS, BodyShape, SyntheticPerson, random_pose, synthesise_walk
from scanprep.synthetic.scanner import ScannerConfig, scan

MARKS = ("left toe", "right toe", "left knee", "right knee", "left middle finger", "right middle finger",
         "left elbow outside", "right elbow outside", "top of head", "nose tip")
SIDES = {"left": "right", "right": "left"}
OFF, PART_OFF = 15.0, 50.0             # millimetres on average, and of a part: a body that is farther off is not right
RATE, FRAMES = 60.0, 90


@dataclass(frozen=True, eq=False)
class Subject:
    """A synthetic person in a pose, as scanned, with landmarks and the vertices (N, 3) that the template has there."""

    scan: Mesh
    marks: dict[str, np.ndarray]
    truth: np.ndarray


@dataclass(frozen=True)
class Case:
    """One command on files that `make` writes into a folder; `wrong` inputs may not end as good."""

    name: str
    command: str
    make: Callable[[Path], np.ndarray | None]           # returns the true vertices where there are any
    wrong: bool = True
    body: str = ""                                       # file that the command writes, to compare with the truth


@cache
def subject(seed: int, posed: bool = True, views: int = 4) -> Subject:
    """A person of some seed, who stands at rest where not `posed`."""
    rng = np.random.default_rng([seed, 77])
    person, model = SyntheticPerson(BodyShape.random(rng)), load_built_in_model()
    pose = random_pose(rng) if posed else np.zeros((16, 3))
    body = Mesh(person.in_pose(pose), person.mesh.faces)
    kept = np.array(model.info["people_vertices"])
    seen = scan(body, ScannerConfig(resolution=0.01, views=views), rng).merged
    truth = body.vertices[kept]
    return Subject(seen, {name: truth[model.info["landmarks"][name]] for name in MARKS}, truth)


def write(folder: Path, mesh: Mesh, marks: dict[str, np.ndarray] | None = None) -> None:
    """The scan, the template and landmarks of a case."""
    model = load_built_in_model()
    write_mesh(folder / "scan.ply", mesh)
    write_mesh(folder / "template.ply", model.template)
    write_landmarks(folder / "template.landmarks.json", {n: int(v) for n, v in model.info["landmarks"].items()})
    if marks is not None:
        write_landmarks(folder / "scan.landmarks.json", marks)


def together(*meshes: Mesh) -> Mesh:
    """Several meshes as one."""
    starts = np.cumsum([0, *(len(m.vertices) for m in meshes)])
    return Mesh(np.vstack([m.vertices for m in meshes]),
                np.vstack([m.faces + at for m, at in zip(meshes, starts, strict=False)]))


def box(low: tuple[float, ...], high: tuple[float, ...]) -> Mesh:
    """A box of about 1,000 triangles."""
    steps = np.linspace(0, 1, 10)
    u, v = (a.ravel() for a in np.meshgrid(steps, steps))
    k = np.arange(90)[np.arange(90) % 10 < 9]
    quad = np.vstack([np.stack([k, k + 1, k + 10], 1), np.stack([k + 1, k + 11, k + 10], 1)])
    sides = []
    for axis in range(3):
        for end in (0.0, 1.0):
            points = np.insert(np.stack([u, v], 1), axis, end, axis=1)
            flip = (end == 0.0) ^ (axis == 1)
            sides.append(Mesh(np.array(low) + points * np.subtract(high, low), quad[:, ::-1] if flip else quad))
    return together(*sides)


def chair() -> Mesh:
    """Seat, back and four legs."""
    legs = [box((x, y, 0.0), (x + 0.05, y + 0.05, 0.45)) for x in (0, 0.4) for y in (0, 0.4)]
    return together(box((0, 0, 0.45), (0.45, 0.45, 0.5)), box((0, 0.4, 0.5), (0.45, 0.45, 1.0)), *legs)


def cylinder() -> Mesh:
    """As high as a person."""
    turns = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    around, up = (a.ravel() for a in np.meshgrid(turns, np.linspace(0, 1.7, 50)))
    k = np.arange(49 * 40)
    right = k - k % 40 + (k % 40 + 1) % 40
    return Mesh(np.stack([0.18 * np.cos(around), 0.18 * np.sin(around), up], 1),
                np.vstack([np.stack([k, right, k + 40], 1), np.stack([right, right + 40, k + 40], 1)]))


def horse() -> Mesh:
    """Barrel, neck and legs of boxes."""
    legs = [box((x, y, 0.0), (x + 0.12, y + 0.12, 0.8)) for x in (-0.7, 0.5) for y in (-0.25, 0.13)]
    return together(box((-0.75, -0.25, 0.8), (0.65, 0.25, 1.4)), box((0.6, -0.1, 1.3), (0.9, 0.1, 2.0)), *legs)


def exchange_sides(marks: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Left and right exchanged."""
    return {name: marks[" ".join(SIDES.get(word, word) for word in name.split())] for name in marks}


def shuffle(marks: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Every landmark at the place of another."""
    names = list(marks)
    return dict(zip(names, [marks[n] for n in names[3:] + names[:3]], strict=True))


def cut(mesh: Mesh, keep: np.ndarray) -> Mesh:
    """The triangles whose corners are all kept."""
    faces = mesh.faces[keep[mesh.faces].all(axis=1)]
    used = np.unique(faces)
    return Mesh(mesh.vertices[used], np.searchsorted(used, faces))


def changes(seed: int, posed: bool) -> dict[str, tuple[Mesh, dict[str, np.ndarray] | None, np.ndarray | None]]:
    """Wrong scans: what is wrong, the scan, its landmarks, and the body (N, 3) that is right for it all the same."""
    one, other = subject(seed, posed), subject(seed + 1, posed)
    v, marks = one.scan.vertices, one.marks
    middle = v.mean(axis=0)

    def scaled(factor: float) -> tuple[Mesh, dict[str, np.ndarray], None]:
        return one.scan.with_vertices(factor * v), {n: factor * p for n, p in marks.items()}, None

    mirror = np.array([-1.0, 1, 1])
    half = v[:, 0] > middle[0]
    low = v[:, 2] < 0.5 * middle[2]
    inner = {n: p for n, p in marks.items() if p[0] > middle[0]}
    beside, behind = (other.scan.with_vertices(other.scan.vertices + at) for at in ([0.9, 0, 0], [0, 1.2, 0]))
    few = np.zeros(len(v), dtype=bool)
    few[np.argsort(np.linalg.norm(v - marks["left middle finger"], axis=1))[: len(v) // 50]] = True
    over, wide = rotations.exp(np.array([np.pi, 0, 0])).T, np.array([1.6, 1.6, 1])
    wall = together(one.scan, box((-1.5, 0.6, 0), (1.5, 0.7, 2)), box((-1.5, -1.5, -0.1), (1.5, 0.6, -0.02)))
    return {"inch told as m": scaled(39.37), "0.5 of the size": scaled(0.5), "child of 0.65": scaled(0.65),
            "giant of 1.4": scaled(1.4),
            "wide by 1.6": (one.scan.with_vertices(v * wide), {n: p * wide for n, p in marks.items()}, None),
            "left and right exchanged": (one.scan, exchange_sides(marks), one.truth),
            "landmarks shuffled": (one.scan, shuffle(marks), one.truth),
            "mirrored, marks not": (one.scan.with_vertices(v * mirror), marks, None),
            "landmarks of another": (one.scan, {n: p + [0.3, 0.1, 0.2] for n, p in other.marks.items()}, one.truth),
            "two people": (together(one.scan, beside), marks, one.truth),
            "one behind another": (together(one.scan, behind), marks, one.truth),
            "wall and floor": (wall, marks, one.truth),
            "chair": (chair(), None, None), "cylinder": (cylinder(), None, None), "horse": (horse(), None, None),
            "left half": (cut(one.scan, half), inner, one.truth),
            "shins and feet": (cut(one.scan, low), None, one.truth), "a hand": (cut(one.scan, few), None, one.truth),
            "upside down": (one.scan.with_vertices(v @ over), None, one.truth @ over)}


def scan_cases() -> Iterator[Case]:
    """Wrong and right scans for register and complete."""
    commands = {"register": ("prep register scan.ply --template template.ply -o out.ply", "out.ply"),
                "complete": ("complete scan.ply -o out", "out/completed.ply")}
    for number, (verb, (command, body)) in enumerate(commands.items()):
        for what in changes(100, True):
            def make(folder: Path, what: str = what) -> np.ndarray | None:
                mesh, marks, truth = changes(100, True)[what]
                write(folder, mesh, marks)
                return truth
            unit = " --unit m" if what == "inch told as m" else ""
            yield Case(f"{verb}: {what}", command + unit, make, body=body)
        for seed in range(200 + 10 * number, 210 + 10 * number):
            views = 1 if verb == "complete" and seed % 2 else 4
            def right(folder: Path, seed: int = seed, views: int = views) -> np.ndarray:
                one = subject(seed, True, views)
                write(folder, one.scan, one.marks)
                return one.truth
            yield Case(f"{verb}: person {seed}, {views} views", command, right, False, body)


def statue_cases() -> Iterator[Case]:
    """Wrong and right scans for a statue; they stand, and nobody clicks."""
    for what in ("0.5 of the size", "two people", "one behind another", "left half", "chair", "cylinder", "horse",
                 "shins and feet"):
        def make(folder: Path, what: str = what) -> None:
            write(folder, changes(300, False)[what][0])
        yield Case(f"statue: {what}", "statue fit scan.ply -o out --unit m --size 512", make)
    for seed in (310, 311):
        def right(folder: Path, seed: int = seed) -> None:
            write(folder, subject(seed, False).scan)
        yield Case(f"statue: person {seed}", "statue fit scan.ply -o out --size 512", right, False)


def measured_cases() -> Iterator[Case]:
    """Bodies that are measured or made: of another unit, of another size, of a report that failed."""
    def body(folder: Path, scale: float | np.ndarray, told: str = "") -> None:
        model = load_built_in_model()
        betas = np.random.default_rng(401).normal(size=model.n_betas)
        standing = model.vertices(np.zeros((16, 3)), betas)
        write_mesh(folder / "scan.ply", model.template.with_vertices(standing * scale))
        if told:
            (folder / "scan.ply.report.json").write_text(json.dumps({"judgement": {
                "verdict": told, "reasons": ["79% of the scan lies off the template"]}}))
    for what, scale, told in (("0.5 of the size", 0.5, ""), ("1.5 of the size", 1.5, ""), ("inch told as m", 39.4, ""),
                              ("flat", np.array([1, 0.4, 1]), ""), ("wide by 1.6", np.array([1.6, 1.6, 1]), ""),
                              ("its report failed", 1.0, "failed"), ("its report doubts", 1.0, "check")):
        yield Case(f"measure: {what}", "measure scan.ply -o out.csv --unit m",
                   lambda folder, scale=scale, told=told: body(folder, scale, told))
    yield Case("measure: a person", "measure scan.ply -o out.csv", lambda folder: body(folder, 1.0), False)
    def model_file(folder: Path) -> None:
        load_built_in_model().save(folder / "model.npz")
    for what, betas, wrong in (("betas of 20", "20", True), ("betas of 9 and -9, -9", "9 -9 -9", True),
                               ("betas of 2 and -1", "2 -1", False)):
        yield Case(f"model mesh: {what}", f"model mesh model.npz --betas {betas} -o out.ply", model_file, wrong)


def recording(seed: int) -> tuple[MarkerSequence, np.ndarray]:
    """A person who walks, with the 41 markers where their layout has them, some on bars; the vertices (T, N, 3)."""
    rng, model = np.random.default_rng([seed, 78]), load_built_in_model()
    person, kept = SyntheticPerson(BodyShape.random(rng)), np.array(model.info["people_vertices"])
    bodies = np.stack([person.in_pose(pose, trans)[kept] for pose,
                       trans in zip(*synthesise_walk(FRAMES, RATE), strict=True)])
    layout = choose_layout(model, None, tuple(MARKERS))[0]
    places = np.stack([layout.place(model.template.with_vertices(body)) for body in bodies])
    return MarkerSequence(places + rng.normal(0, 0.001, places.shape), layout.labels, RATE), bodies


def marker_cases() -> Iterator[Case]:
    """Recordings that are scaled, out of order, of another rate, with other labels."""
    def swapped(one: MarkerSequence) -> MarkerSequence:
        return MarkerSequence(one.positions, tuple(
            {"L": "R", "R": "L"}.get(label[0], label[0]) + label[1:] if label not in ("RBAC",) else label
            for label in one.labels), one.rate)

    def changed(how: str) -> tuple[MarkerSequence, np.ndarray | None]:
        """The recording, and the bodies that are right for it all the same."""
        rng, (one, bodies) = np.random.default_rng(5), recording(500)
        p, order = one.positions, rng.permutation(len(bodies))

        def of(positions: np.ndarray, rate: float = one.rate) -> MarkerSequence:
            return MarkerSequence(positions, one.labels, rate)

        return {
            "scaled by 1.6": (of(1.6 * p), None),
            "scaled by 2.54": (of(2.54 * p), None),
            "scaled by 0.5": (of(0.5 * p), None),
            "frames shuffled": (of(p[order]), bodies[order]),
            "rate ten times": (of(p, 10 * one.rate), bodies),
            "left and right exchanged": (swapped(one), bodies),
            "labels shuffled": (MarkerSequence(p, tuple(rng.permutation(one.labels).tolist()), one.rate), bodies),
            "mirrored": (of(p * [-1, 1, 1]), None)}[how]

    def put(folder: Path, markers: MarkerSequence, bodies: np.ndarray | None) -> np.ndarray | None:
        write_markers(folder / "walk.c3d", markers)
        return bodies

    for verb, body in (("animate", "out/motion.npz"), ("mosh", "out/walk/walk/motion.npz")):
        for how in ("scaled by 1.6", "scaled by 2.54", "scaled by 0.5", "frames shuffled", "rate ten times",
                    "left and right exchanged", "labels shuffled", "mirrored"):
            yield Case(f"{verb}: {how}", f"{verb} walk.c3d -o out", lambda folder, how=how: put(folder, *changed(how)),
                       body=body)
        for seed in (510, 511, 512):
            yield Case(f"{verb}: person {seed}", f"{verb} walk.c3d -o out",
                       lambda folder, seed=seed: put(folder, *recording(seed)), False, body)


def run(case: Case, folder: Path) -> dict[str, object]:
    """One case in its folder: the verdict, its first reason, how far the body is from the truth."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    truth, start, said = case.make(folder), time.perf_counter(), io.StringIO()
    with contextlib.chdir(folder), contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        code = scape(case.command.split())
    reports = [p for p in (folder / "out" / "report.json", *sorted(folder.glob("out*.report.json"))) if p.exists()]
    row: dict[str, object] = {"case": case.name, "wrong": case.wrong, "code": code,
                              "seconds": time.perf_counter() - start}
    if reports:
        judgement = json.loads(reports[0].read_text())["judgement"]
        row.update(verdict=judgement["verdict"], reasons=judgement["reasons"])
    else:
        last = [line for line in said.getvalue().splitlines() if line.strip()][-1:]
        row.update(verdict="refused", reasons=last)
    if case.body and truth is not None and (folder / case.body).exists():
        row.update(errors(folder / case.body, truth))
    return row


def errors(body: Path, truth: np.ndarray) -> dict[str, float]:
    """Millimetres that vertices (N, 3), or (T, N, 3) of a motion, are off on average, and those of the worst part."""
    model = load_built_in_model()
    if body.suffix == ".npz":
        with np.load(body) as a:             # `Motion.load` refuses the betas of bodies that nobody has
            found = model.subject(a["betas"]).vertices(a["poses"].reshape(len(truth), -1, 3), a["trans"])
    else:
        found = read_mesh(body).vertices[None]
    off = 1000 * np.linalg.norm(found - truth, axis=2).mean(axis=0)
    part = model.skeleton.part_of_vertex(model.template)
    return {"mean_mm": float(off.mean()), "part_mm": float((np.bincount(part, off) / np.bincount(part)).max())}


def summary(rows: list[dict[str, object]]) -> dict[str, object]:
    """Wrong inputs that are called good, good bodies that are off, and right ones that are not called good."""
    def right(row: dict[str, object]) -> bool:
        mean, part = (row.get(name, np.inf if row["wrong"] else 0.0) for name in ("mean_mm", "part_mm"))
        return float(mean) <= OFF and float(part) <= PART_OFF                                         # type: ignore

    wrong, others = [r for r in rows if r["wrong"]], [r for r in rows if not r["wrong"]]
    fine = [r for r in others if right(r)]
    return {"wrong inputs": len(wrong), "called good": [
                r["case"] for r in wrong if r["verdict"] == "good" and not right(r)],
            "mended and called good": [r["case"] for r in wrong if r["verdict"] == "good" and right(r)],
            "right inputs": len(others), "called good and off": [
                r["case"] for r in others if r["verdict"] == "good" and not right(r)],
            "right results": len(fine), "right and not good": [r["case"] for r in fine if r["verdict"] != "good"]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--only", nargs="*", default=[], help="words of which the name of a case has one")
    parser.add_argument("-o", "--output")
    args = parser.parse_args()
    rows = []
    for case in (*measured_cases(), *marker_cases(), *scan_cases(), *statue_cases()):
        if args.only and not any(word in case.name for word in args.only):
            continue
        folder = args.folder / case.name.replace(" ", "_").replace(":", "").replace(",", "")
        kept = folder / "row.json"
        if not kept.exists():
            kept.parent.mkdir(parents=True, exist_ok=True)
            row = run(case, folder)
            kept.write_text(json.dumps(row))
        rows.append(json.loads(kept.read_text()))
        row = rows[-1]
        print(f"{row['case']}: {row['verdict']}: {(row['reasons'] or [''])[0]} "
              f"{row.get('mean_mm', '')} {row.get('part_mm', '')}", flush=True)
    told = summary(rows)
    print(json.dumps(told, indent=1))
    if args.output:
        write_report(args.output, {"machine": machine(), "summary": told, "rows": rows})


if __name__ == "__main__":
    main()
