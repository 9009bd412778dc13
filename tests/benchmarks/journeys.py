"""The README's three journeys as commands, on scans as a user has them; nothing is edited by hand between them.

    python tests/benchmarks/journeys.py WORK [--fresh] [-o FILE]

Synthetic people are scanned by the virtual scanner (2 mm noise, holes, four views that overlap) and written as scanners
write them: in millimetres, with dots in the names, with triangles of no area, doubled points and points of no triangle.
Ten landmarks of each are clicked in MeshLab, the best scan becomes the template. With `--fresh` the package is
installed into an environment of its own first. Told are the minutes and the verdict of each command, the minutes to the
first measures and to the model, and every command that failed, with its last line.
"""
from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from protocols import machine, write_report

from completion.mocap.files.markers import MarkerSequence, write_markers
from completion.mocap.marker_sets.layout import DISTANCE
from completion.mocap.marker_sets.named import read_layout
from scanprep import write_landmarks
from scanprep.geometry.files import write_mesh
from scanprep.geometry.mesh import Mesh
from scanprep.synthetic.data_set import SUBJECT, GroundTruth, click_landmarks, near_rest, stand, subject_pose
from scanprep.synthetic.people import BodyShape, SyntheticPerson, random_pose, synthesise_walk
from scanprep.synthetic.scanner import ScannerConfig, scan

MM = 1000.0
# As README asks for them, and where they are on the synthetic people
CLICKED = {"left hand": "left middle finger", "right hand": "right middle finger", "left foot": "left toe",
           "right foot": "right toe", "left elbow": "left elbow outside", "right elbow": "right elbow outside",
           "left knee": "left knee", "right knee": "right knee", "crown": "top of head", "navel": "navel"}
POSES, PEOPLE = 8, 3                 # as few as README allows: they bend every joint
BEST = "2024.05.01 anna rest"


class Step(NamedTuple):
    """One command of a journey."""

    command: str
    minutes: float
    code: int
    verdict: str
    last: str


def as_scanned(mesh: Mesh, rng: np.random.Generator) -> Mesh:
    """A scan in millimetres with what scanners leave in it."""
    vertices, faces = MM * mesh.vertices, mesh.faces
    doubled = rng.choice(len(vertices), 200, replace=False)              # points twice, each in some of the triangles
    corner = np.isin(faces, doubled) & (rng.random(faces.shape) < 0.5)
    twin = np.full(len(vertices), -1)
    twin[doubled] = len(vertices) + np.arange(len(doubled))
    faces = np.where(corner, twin[faces], faces)
    alone = vertices[:1] + rng.normal(0, 5, (50, 3))
    a, b = faces[rng.choice(len(faces), 100, replace=False), :2].T
    flat = np.stack([a, b, b], axis=1)
    return Mesh(np.concatenate([vertices, vertices[doubled], alone]), np.concatenate([faces, flat]))


def write_user_scan(folder: Path, name: str, truth: GroundTruth, config: ScannerConfig, rng: np.random.Generator,
                    ending: str = ".ply") -> None:
    """A scan of a person, and what was clicked on it."""
    seen = scan(truth.mesh, config, rng).merged
    write_mesh(folder / f"{name}{ending}", as_scanned(seen, rng))
    places = click_landmarks(truth, rng, seen=seen.vertices)
    clicked = {said: places[ours] for said, ours in CLICKED.items() if ours in places}
    write_landmarks(folder / f"{name}.pp", clicked, "mm")


def write_user_files(work: Path) -> None:
    """Scans with their table, half a view, and a recording of a walk."""
    rng, person, config = np.random.default_rng(0), SyntheticPerson(SUBJECT), ScannerConfig(resolution=0.009)
    scans = work / "scans"
    scans.mkdir(parents=True, exist_ok=True)
    rows = ["name,subject,pose,sex"]
    for k in range(POSES):
        label, pose = subject_pose(k, rng)
        name = BEST if k == 0 else f"2024.05.{k + 1:02d} anna {label}"
        write_user_scan(scans, name, stand(person, pose), config, rng, (".ply", ".obj", ".stl")[k % 3])
        rows.append(f"{name},anna,{label},male")
    for k in range(PEOPLE):
        other = SyntheticPerson(BodyShape.random(rng, sex="female" if k % 2 else "male"))
        name = f"2024.06.{k + 1:02d} person"
        write_user_scan(scans, name, stand(other, near_rest(rng)), config, rng)
        rows.append(f"{name},person {k},rest,{'female' if k % 2 else 'male'}")
    (scans / "scans.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    write_user_scan(work, "half.view", stand(person, random_pose(rng)), ScannerConfig(views=1, resolution=0.009), rng)
    # a walk in a laboratory that has the CMU marker set, 120 frames a second
    layout, (poses, trans) = read_layout("cmu41", person.mesh), synthesise_walk(240, 120.0)
    bodies = [person.in_pose(pose, place) for pose, place in zip(poses, trans, strict=True)]
    markers = np.stack([body[layout.vertices] + DISTANCE * Mesh(body, person.mesh.faces).vertex_normals[layout.vertices]
                        for body in bodies])
    markers += rng.normal(0, 0.001, markers.shape)
    write_markers(work / "walk.c3d", MarkerSequence(markers, layout.labels, 120.0))


JOURNEYS = (
    # 1: my scans -> my model
    ("prep", "template", f"scans/{BEST}.ply", "--unit", "mm", "--faces", "8000", "-o", "template.ply"),
    ("measure", "template.ply", "-o", "template_measures.csv"),
    ("prep", "run", "scans", "--template", "template.ply", "--unit", "mm", "-o", "set"),
    ("learn", "--poses", "set", "--shapes", "set", "-o", "model.npz"),
    ("model", "mesh", "model.npz", "--betas", "1.5", "-o", "bigger.ply"),
    # 2: half a scan -> the whole body, and a measuring tape
    ("complete", "half.view.ply", "-m", "model.npz", "--subject", "template", "--unit", "mm", "-o", "completed"),
    ("measure", "completed", "-m", "model.npz", "-o", "measures.csv"),
    # 3: recordings -> people in motion
    ("layout", "transfer", "cmu41", "--target", "model.npz", "-o", "layout.json"),
    ("animate", "walk.c3d", "-m", "model.npz", "--layout", "layout.json", "-o", "walk"),
    ("mosh", "walk.c3d", "-m", "model.npz", "--layout", "layout.json", "-o", "person"),
    ("animate", "walk.c3d", "-m", "model.npz", "--layout", "layout.json", "--retarget-to", "bigger.ply", "-o",
     "walk_of_two"),
    ("model", "export", "model.npz", "--motion", "walk/motion.npz", "--root", "pelvis", "--names", "mixamo", "--ground",
     "--fps", "30", "-o", "walk.glb"),
    ("statue", "fit", f"scans/{BEST}.ply", "--unit", "mm", "-o", "statue"),
    ("mosh", "walk.c3d", "-o", "person_of_no_model"))


def carried_out(python: str, words: tuple[str, ...], work: Path) -> Step:
    """One command in the folder of the journeys."""
    begun = time.perf_counter()
    done = subprocess.run([python, "-m", "completion", *words], cwd=work, capture_output=True, text=True, check=False)
    minutes = (time.perf_counter() - begun) / 60
    output = work / words[words.index("-o") + 1]
    report = output / "report.json" if output.is_dir() else output.with_name(f"{output.name}.report.json")
    judged = json.loads(report.read_text(encoding="utf-8"))["judgement"] if report.exists() else None
    verdict = f"{judged['verdict']}: {'; '.join(judged['reasons'])}" if judged else ""
    last = (done.stderr.strip().splitlines() or [""])[-1]
    command = " ".join(f'"{word}"' if " " in word else word for word in ("scape", *words))
    return Step(command, minutes, done.returncode, verdict, last)


def fresh_python(work: Path) -> tuple[str, float]:
    """The Python of a new environment with the package in it, and the minutes that took."""
    begun = time.perf_counter()
    subprocess.run([sys.executable, "-m", "venv", work / "environment"], check=True)
    python = str(work / "environment" / "bin" / "python")
    subprocess.run([python, "-m", "pip", "install", "--quiet", str(Path(__file__).parents[2])], check=True)
    return python, (time.perf_counter() - begun) / 60


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--fresh", action="store_true")
    parser.add_argument("-o", "--output", type=Path)
    asked = parser.parse_args()
    asked.work.mkdir(parents=True, exist_ok=True)
    python, install = fresh_python(asked.work) if asked.fresh else (sys.executable, 0.0)
    if not asked.fresh:
        os.environ["PYTHONPATH"] = str(Path(__file__).parents[2])
    write_user_files(asked.work)
    steps, minutes = [], install
    to: dict[str, float] = {}
    for words in JOURNEYS:
        step = carried_out(python, words, asked.work)
        steps.append(step)
        minutes += step.minutes
        if step.code == 0:
            to.setdefault(words[0], minutes)
        print(f"{step.minutes:5.1f} min  {'done' if step.code == 0 else f'EXIT {step.code}':7}  {step.command}\n"
              f"           {step.verdict or step.last}", flush=True)
    told = {"installed": install, "to the first measures": to.get("measure"), "to the model": to.get("learn")}
    print(told, f"{sum(step.code != 0 for step in steps)} of {len(steps)} commands failed")
    if asked.output:
        write_report(asked.output, {"machine": machine(), "minutes": told, "steps": [step._asdict() for step in steps]})


if __name__ == "__main__":
    main()
