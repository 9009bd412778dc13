"""The command `scape sample`: raw scans of unlike people, a half view, a walk and a table, as a laboratory has them.

The people are the built-in ones. No file has a landmark or says what is true: `scape demo` measures errors.
"""
from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from shlex import quote

import numpy as np

from model.export.bvh import write_bvh
from scanprep.console import Metric, Outcome, Progress, bar
from scanprep.geometry import tables
from scanprep.geometry.files import PointCloud, name_of, write_mesh, write_points
from scanprep.geometry.mesh import Mesh
from scanprep.judgement import Judgement
from scanprep.pipeline.scans import TABLE
from scanprep.skeleton.roles import part_kind
from scanprep.synthetic.data_set import near_rest, stand
from scanprep.synthetic.people import (
    LANDMARKS,
    MARKERS,
    NAMED_POSES,
    BodyShape,
    SyntheticPerson,
    compose_pose,
    find_pose,
    synthesise_walk,
)
from scanprep.synthetic.scanner import ScannerConfig, scan

from ..cli import Out
from ..mocap.files.markers import MarkerSequence, write_markers
from ..mocap.marker_sets.layout import DISTANCE

MARKER_NOISE = 0.001                     # metres: standard deviation per axis, as optical motion capture has
# Unlike people, as far as the statistics go. Weights are standard deviations from the average at that stature.
PEOPLE = {"anna": BodyShape.like("female", 1.66, 0.0), "bob": BodyShape.like("male", 1.76, 2.5),        # 69, 117 kg
          "carol": BodyShape.like("female", 1.80, -2.0), "dora": BodyShape.like("female", 1.50, 0.8),   # 64, 62 kg
          "emil": BodyShape.like("male", 1.98, 0.5), "frank": BodyShape.like("male", 1.80, -2.5)}       # 115, 59 kg
# a careful scanner with cameras high and low, for the template; then plainer ones, with more holes and noise
CAREFUL = ScannerConfig(views=12, resolution=0.0055, noise=0.001, blind_reach=0.01)
USUAL, COARSE = ScannerConfig(views=8, resolution=0.007), ScannerConfig(resolution=0.008, noise=0.003)
ONE_CAMERA = ScannerConfig(views=1, resolution=0.007, azimuth=-30.0)
# an old person stands with a bent back and knees
STOOP = compose_pose(back={"bend": 25}, neck={"nod": -12}, left_leg={"knee": 8}, right_leg={"knee": 8})
FEET = (12, 15)                                                         # parts of a pose, after thigh and shin
Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])                   # many scanners write y up


@dataclass(frozen=True)
class SampleScan:
    """One scan: its file, who is on it in which pose, the scanner, and units and axes of the file."""

    file: str
    person: str
    pose: str
    scanner: ScannerConfig = USUAL
    per_metre: float = 1.0
    y_up: bool = False


# the fewest scans that show both how a person moves and how people differ: registered and learned in four minutes
SCANS = (SampleScan("anna.ply", "anna", "standing", CAREFUL), SampleScan("anna_boxer.ply", "anna", "boxer"),
         SampleScan("anna_lunge.ply", "anna", "lunge_left"),
         SampleScan("bob.obj", "bob", "standing", per_metre=1000, y_up=True),
         SampleScan("carol.stl", "carol", "standing", COARSE, 1000), SampleScan("dora.ply.gz", "dora", "stooped"),
         SampleScan("emil.xyz", "emil", "standing", COARSE))
HALF_VIEW = SampleScan("half_view.ply", "frank", "wave_right", ONE_CAMERA)
# colours painted on the figure, by kind of part; what is left is skin
CLOTHES = {"pelvis": (0.25, 0.24, 0.28), "thigh": (0.25, 0.24, 0.28), "shin": (0.25, 0.24, 0.28),
           "abdomen": (0.20, 0.35, 0.60), "chest": (0.20, 0.35, 0.60), "upper_arm": (0.20, 0.35, 0.60)}
WALKER, FRAMES, RATE = "frank", 96, 60.0                                # a gait cycle takes 1.1 seconds


def write_sample(out: Out = Path("sample")) -> Outcome:
    """Files to try every command with: raw scans of women and men, a half view, a walk, a figure and a table.

    They are made up from the built-in people, always the same. Nobody clicked a landmark.

    Example: scape sample

    Args:
        out: Folder to write to. Work inside it: the commands of the README run there as they stand.
    """
    people = {name: SyntheticPerson(shape) for name, shape in PEOPLE.items()}
    with bar("scanning people") as progress:
        for number, one in enumerate((*SCANS, HALF_VIEW)):
            scan_to_file(out if one is HALF_VIEW else out / "scans", one, people[one.person], number)
            progress(number + 1, len(SCANS) + 1)
    tables.write_table(out / "scans" / TABLE, ("name", "subject", "pose", "sex"),
                       [(name_of(one.file), one.person, one.pose, PEOPLE[one.person].sex) for one in SCANS])
    poses, trans = synthesise_walk(FRAMES, RATE)
    bodies = np.stack([people[WALKER].in_pose(pose, place) for pose, place in zip(poses, trans, strict=True)])
    with bar("recording a walk") as progress:
        walk = record_markers(bodies, people[WALKER].mesh.faces, RATE, np.random.default_rng(len(SCANS) + 1), progress)
    write_markers(out / "walk.c3d", walk)
    write_figure(out, people[WALKER], poses, trans)
    write_markers(out / "unnamed.c3d", replace(walk, labels=tuple(f"*{i}" for i in range(len(walk.labels)))))
    sexes = [PEOPLE[name].sex for name in {one.person for one in SCANS}]
    return Outcome(out, [Metric("scans", len(SCANS)), Metric("women on them", sexes.count("female")),
                         Metric("men on them", sexes.count("male")), Metric("frames of the walk", len(poses)),
                         Metric("markers on the walker", len(walk.labels))],
                   judgement=Judgement.of(), following=f"cd {quote(str(out))}, then scape mosh walk.c3d -o out")


def write_figure(out: Path, person: SyntheticPerson, poses: np.ndarray, trans: np.ndarray) -> None:
    """Write a figure as modelling programs do, figure.glb with painted clothes and eyes of their own, and walk.bvh."""
    import trimesh

    paint = np.array([CLOTHES.get(part_kind(name), (0.85, 0.66, 0.55)) for name in person.skeleton.names])
    mesh = person.mesh
    vertices, faces, colors = mesh.vertices, mesh.faces, paint[person.skeleton.part_of_vertex(mesh)]
    for name in ("left eye", "right eye"):
        eye = trimesh.creation.icosphere(2, 0.012)
        faces = np.vstack([faces, eye.faces + len(vertices)])
        vertices = np.vstack([vertices, eye.vertices + mesh.vertices[LANDMARKS[name]]])
        colors = np.vstack([colors, np.full(eye.vertices.shape, 0.95)])
    write_mesh(out / "figure.glb", Mesh(vertices, faces, colors), "single")
    write_bvh(out / "walk.bvh", person.skeleton, poses, trans, RATE, body=person.mesh)


def scan_to_file(folder: Path, one: SampleScan, person: SyntheticPerson, seed: int) -> None:
    """Scan a person and write the file as its scanner would: a mesh, or points where the ending says so."""
    rng = np.random.default_rng(seed)
    seen = scan(stand(person, sample_pose(one.pose, rng)).mesh, one.scanner, rng).merged
    vertices = one.per_metre * (seen.vertices @ Y_UP.T if one.y_up else seen.vertices)
    if one.file.endswith(".xyz"):
        write_points(folder / one.file, PointCloud(vertices))
    else:
        write_mesh(folder / one.file, seen.with_vertices(vertices), "single")


def sample_pose(name: str, rng: np.random.Generator) -> np.ndarray:
    """Return the pose (16, 3) of a scan: a named one, or somebody who stands as well as people do."""
    if name in NAMED_POSES:
        return find_pose(name)
    pose = near_rest(rng) + (STOOP if name == "stooped" else 0)
    for foot in FEET:                                        # flat on the floor, whatever the leg does
        pose[foot] = -pose[foot - 1] - pose[foot - 2]
    return pose


def record_markers(bodies: np.ndarray, faces: np.ndarray, rate: float, rng: np.random.Generator,
                   report_progress: Progress) -> MarkerSequence:
    """Record 41 markers on the bodies (T, N, 3) of a motion, with noise and gaps."""
    labels, places = tuple(MARKERS), np.array(list(MARKERS.values()))
    exact_markers = []
    for i, body in enumerate(bodies):
        exact_markers.append(body[places] + DISTANCE * Mesh(body, faces).vertex_normals[places])
        report_progress(i + 1, len(bodies))
    positions = np.stack(exact_markers) + rng.normal(0, MARKER_NOISE, (len(bodies), len(labels), 3))
    # 3% of the markers are missing at any time, as behind an arm
    positions[rng.random(positions.shape[:2]) < 0.03] = np.nan
    return MarkerSequence(positions, labels, rate)
