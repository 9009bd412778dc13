"""The stages of the demonstration; each runs again only when something that it depends on has changed.

    scans -> template -> registered set with skeleton -> model -> held-out poses, completion, animation
"""
from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from model import BodyModel, LearnConfig, Subject, fit_pose, learn_scape, load_model
from model.motion.files import skeleton_arrays
from scanprep.batch.opening import workspace
from scanprep.batch.room import TaskContext, substeps
from scanprep.batch.workspace import KeptSteps, Task, Workspace
from scanprep.dataset import RegisteredSet
from scanprep.geometry import storage, tables
from scanprep.geometry.farthest_points import spread_indices
from scanprep.geometry.files import read_mesh, write_mesh
from scanprep.geometry.landmarks import match_landmarks, read_landmark_vertices, read_landmarks, write_landmarks
from scanprep.geometry.mesh import Mesh
from scanprep.pipeline.again import Call
from scanprep.pipeline.prepare import SCANS, Prepared, prepare
from scanprep.pipeline.scans import TABLE, find_scans
from scanprep.ranges import Cell, Count, Faces, Positive, Seed, Settings
from scanprep.surfaces.template import template_of_views
from scanprep.synthetic.data_set import (
    SUBJECT,
    GroundTruth,
    SyntheticScan,
    click_landmarks,
    read_views,
    scan_plan,
    stand,
    synthetic_scan,
    write_scan,
)
from scanprep.synthetic.people import MARKERS, SyntheticPerson, random_pose, synthesise_walk
from scanprep.synthetic.scanner import ScannerConfig, scan
from scanprep.threads import one_thread

from ..mocap.files.markers import MarkerSequence, read_markers, write_markers
from ..mocap.marker_sets.layout import DISTANCE, MarkerLayout
from ..mocap.pose.follow import animate
from ..motion import Motion
from ..partial.completion import Completion, complete, load_completion
from .sample import MARKER_NOISE, record_markers
from .truth import TruthMap, distance, surface_error


@dataclass(frozen=True)
class DemoConfig(Settings):
    """How much of everything.

    Attributes
    ----------
    poses, subjects : int
        Scans of one subject in many poses, and of other people.
    faces : int
        Triangles of the template.
    resolution, template_resolution : float, metres
        Spacing of the scanner's rays, for the scans and for the careful one that the template is made of.
    held_out : int
        Poses of the subject that the model never saw.
    frames, rate : int, frames per second
        Of the walk.
    seed : int
    learn : LearnConfig
        How the model is learned.
    """

    poses: Count = 9
    subjects: Count = 4
    faces: Faces = 8000
    resolution: Cell = 0.01
    template_resolution: Cell = 0.0055
    held_out: int = 3
    frames: Count = 66
    rate: Positive = 60.0
    seed: Seed = 0
    learn: LearnConfig = field(default_factory=LearnConfig)


# --full and --quick: more and finer scans for better figures, or fewer for a first look
FULL = DemoConfig(poses=20, subjects=12, faces=14000, resolution=0.0068, template_resolution=0.004, held_out=5,
                  frames=132)
QUICK = DemoConfig(poses=8, subjects=3, faces=7000, resolution=0.011, template_resolution=0.006, held_out=2, rate=30.0)

# files of the stages inside the folder
MODEL, HALF, MOTION = Path("model.npz"), Path("half_view/half_view.ply"), Path("animation/motion.npz")


@dataclass(frozen=True)
class ScanPerson:
    """The work on each scan: make a person and scan it."""

    seed: int
    scanner: ScannerConfig

    def __call__(self, which: tuple[int, bool], context: TaskContext) -> SyntheticScan:
        entry = synthetic_scan(context.folder / "scans", self.seed, *which, self.scanner)
        return replace(entry, folder=Path("scans"))


@dataclass(frozen=True)
class Demo:
    """One run of the demonstration in its folder."""

    space: Workspace
    config: DemoConfig
    # bar(title) is a context manager that yields a progress callback
    bar: Callable[[str], AbstractContextManager[Callable[[int, int], None]]]

    @property
    def folder(self) -> Path:
        """The output folder."""
        return self.space.folder

    @property
    def scanner(self) -> ScannerConfig:
        """The virtual scanner."""
        return ScannerConfig(resolution=self.config.resolution)

    @cached_property
    def scans(self) -> list[SyntheticScan]:
        """Scans of one subject in many poses, and of many subjects."""
        tasks = [Task(f"{SCANS}{'pose' if which[1] else 'person'} {which[0]}", which)
                 for which in scan_plan(self.config.poses, self.config.subjects)]
        with self.bar("scanning people") as progress, one_thread():
            done = self.space.run(ScanPerson(self.config.seed, self.scanner), tasks, progress=progress)
        if done.failures:
            raise ValueError("; ".join(done.failures.values()))
        for name in set(self.space.list_results(SCANS)) - set(done.values):         # left by a run with more scans
            self.space.drop(name)
        scans = [replace(done.values[task.name], folder=self.folder / "scans") for task in tasks]
        rows = [(s.name, s.subject, s.pose, s.sex) for s in scans]

        def write(folder: Path) -> None:
            """Write the settings, and the table of who is in the scans."""
            storage.write_json(folder / "demo.json", storage.as_json(self.config))
            (folder / "scans").mkdir()
            tables.write_table(folder / "scans" / TABLE, ("name", "subject", "pose", "sex"), rows)

        self.space.step("settings", (self.config, rows), write)
        return scans

    @cached_property
    def template(self) -> Mesh:
        """The template: a careful scan of the subject at rest from many sides, merged, holes filled, decimated."""
        # twelve views also from above and below, and deep into narrow places, so that hands get fingers
        scanner = ScannerConfig(views=12, resolution=self.config.template_resolution, height=1.2, blind_reach=0.01)

        def make(folder: Path) -> None:
            """Scan the subject, merge the views and write the template."""
            rng = np.random.default_rng([self.config.seed, 6])
            with self.bar("making the template") as progress:
                careful = scan(self.rest.mesh, scanner, rng)
                marks = click_landmarks(self.rest, rng, seen=careful.merged.vertices)
                place = folder / "template_scan"
                write_scan(place, "rest", careful, self.rest, marks)
                views = read_views(place / "views" / "rest.npz")
                # in the form that `scape prep template` reads: a mesh per view, and the positions of the cameras
                named = {f"view_{k:02d}": view for k, view in enumerate(views)}
                for name, view in named.items():
                    write_mesh(place / "range_views" / f"{name}.ply", view.mesh)
                storage.write_json(place / "range_views" / "cameras.json",
                                   {name: view.camera.tolist() for name, view in named.items()})
                mesh = template_of_views(views, self.config.faces, progress, self.config.template_resolution)
            landmarks = read_landmark_vertices(place / "rest.landmarks.json", mesh)
            write_landmarks(folder / "template.landmarks.json", landmarks)
            write_mesh(folder / "template.ply", mesh)

        self.space.step("template", (self.config.seed, self.config.faces, scanner), make)
        return read_mesh(self.folder / "template.ply")

    @cached_property
    def rest(self) -> GroundTruth:
        """The true subject at rest, whose scan becomes the template."""
        return stand(self.person, np.zeros((len(self.person.parents), 3)))

    @cached_property
    def template_landmarks(self) -> dict[str, int]:
        """Landmark name -> vertex of the template."""
        return read_landmark_vertices(self.folder / "template.landmarks.json", self.template)

    @cached_property
    def prepared(self) -> Prepared:
        """The registered set, with its skeleton."""
        template, marks, _ = self.template, self.template_landmarks, self.scans
        tasks = find_scans(self.folder / "scans")
        with workspace(self.folder / "set", self.space.force) as space:
            stale = set(space.list_results(SCANS)) - {SCANS + task.name for task in tasks}
            if stale:                                           # tables first, as they refer to the scans
                space.drop("tables")
            for name in stale:
                space.drop(name)
            with self.bar("registering scans") as first, self.bar("finding the skeleton") as second:
                done = prepare(tasks, template, marks, space.folder, None, first, second)
            with space.staging("run") as staged:                # the set is mended as one of `scape prep run`
                Call(self.folder / "scans", self.folder / "template.ply").write(staged.folder)
        if done.failures:
            raise ValueError("; ".join(done.failures))
        return done

    @cached_property
    def model(self) -> BodyModel:
        """The body model, learned from the registered set."""
        registered: RegisteredSet = self.prepared.registered
        assert registered.skeleton is not None, "the subject has enough poses for a skeleton"
        bodies = registered.template, registered.poses("subject"), registered.shapes(), registered.skeleton

        def make(folder: Path) -> None:
            with self.bar("learning the model") as progress:
                model = learn_scape(*bodies, self.config.learn, progress, substeps(KeptSteps(self.space), "model"))
            replace(model, info={**model.info, "landmarks": self.template_landmarks}).save(folder / MODEL)

        self.space.step("model", (bodies, self.config.learn, self.template_landmarks), make)
        self.space.drop_others("model/")
        return load_model(self.folder / MODEL)

    @cached_property
    def subject(self) -> Subject:
        """The model's body of the subject."""
        return self.model.subject(None)

    @cached_property
    def off(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """By scan: distances (N,), metres, of every registered vertex to the true surface, and to its true place."""
        registered, truths = self.prepared.registered, {s.name: GroundTruth.load(s.truth) for s in self.scans}
        return {name: (surface_error(self.template.with_vertices(vertices), truths[name]),
                       distance(vertices, self.truth_map.vertices(truths[name])))
                for name, vertices in zip(registered.names, registered.vertices(), strict=True)}

    @cached_property
    def person(self) -> SyntheticPerson:
        """The true subject."""
        return SyntheticPerson(SUBJECT)

    @cached_property
    def held_out(self) -> list[GroundTruth]:
        """Poses of the subject that were never scanned."""
        rng = np.random.default_rng([self.config.seed, 7])
        return [stand(self.person, random_pose(rng)) for _ in range(self.config.held_out)]

    def fit_pose(self, wanted: np.ndarray) -> np.ndarray:
        """Compute the model's vertices (N, 3) in the pose that comes closest to `wanted` (N, 3)."""
        return fit_pose(self.subject, wanted).vertices

    @cached_property
    def half_scan(self) -> tuple[Mesh, dict[str, np.ndarray], GroundTruth]:
        """What one camera sees of the first held-out pose, a few landmarks on it, and the truth."""
        truth, scanner = self.held_out[0], replace(self.scanner, views=1, azimuth=-30.0)

        landmarks = 7  # number that somebody clicks on the half view
        def make(folder: Path) -> None:
            rng = np.random.default_rng([self.config.seed, 8])
            seen = scan(truth.mesh, scanner, rng)
            marks = click_landmarks(truth, rng, seen=seen.merged.vertices)
            chosen = spread_indices(len(marks), landmarks)
            write_scan(folder / HALF.parent, HALF.stem, seen, truth,
                       {name: marks[name] for name in np.array(list(marks))[chosen]}, views=False)

        self.space.step("half view", (self.config.seed, scanner, landmarks), make)
        half = self.folder / HALF
        return read_mesh(half), read_landmarks(half.with_suffix(".landmarks.json")), truth

    @cached_property
    def completion(self) -> Completion:
        """The whole body from the half view."""
        half, marks, _ = self.half_scan
        subject = self.subject

        def make(folder: Path) -> None:
            _, vertices, points = match_landmarks(self.template_landmarks, marks)
            with self.bar("completing a half view") as progress:
                complete(subject, half, (vertices, points), progress=progress).save(folder / "completed")

        self.space.step("completion", (self.folder / MODEL, self.folder / HALF, self.template_landmarks, marks), make)
        return load_completion(self.folder / "completed")

    @cached_property
    def walk(self) -> tuple[MarkerSequence, MarkerLayout, np.ndarray]:
        """Markers of the walking subject, their places on the template, and the true vertices (T, N, 3)."""
        poses, trans = synthesise_walk(self.config.frames, self.config.rate)
        bodies = np.stack([self.person.in_pose(pose, place) for pose, place in zip(poses, trans, strict=True)])
        template, config = self.template, self.config

        def make(folder: Path) -> None:
            with self.bar("recording a walk") as progress:
                record_walk(folder / "markers", bodies, self.rest, template, config, progress)

        self.space.step("markers", (config.seed, config.frames, config.rate, MARKER_NOISE, template), make)
        layout = MarkerLayout.load(self.folder / "markers" / "layout.json", len(template.vertices))
        return read_markers(self.folder / "markers" / "walk.c3d"), layout, bodies

    @cached_property
    def motion(self) -> Motion:
        """The model's motion that follows the markers of the walk."""
        (sequence, layout, _), subject = self.walk, self.subject

        def make(folder: Path) -> None:
            with self.bar("following the markers") as progress:
                motion = animate(subject, sequence, layout, progress=progress)
            motion.save(folder / MOTION, **skeleton_arrays(subject.rest_skeleton))

        self.space.step("animation", (self.folder / MODEL, self.folder / "markers"), make)
        return Motion.load(self.folder / MOTION)

    @cached_property
    def truth_map(self) -> TruthMap:
        """Where the template's vertices truly lie."""
        return TruthMap.of(self.template, self.rest)


def record_walk(folder: Path, bodies: np.ndarray, rest: GroundTruth, template: Mesh, config: DemoConfig,
                report_progress: Callable[[int, int], None]) -> None:
    """Write the markers of a walking person (T, N, 3), and their places on the template."""
    sequence = record_markers(bodies, rest.faces, config.rate, np.random.default_rng([config.seed, 9]), report_progress)
    # as with a real subject, the layout is read from the scan at rest, on which the markers are visible
    _, vertices = cKDTree(template.vertices).query(rest.vertices[list(MARKERS.values())])
    MarkerLayout(tuple(MARKERS), vertices, DISTANCE).save(folder / "layout.json")
    write_markers(folder / "walk.csv", sequence)
    write_markers(folder / "walk.c3d", sequence)
