"""The stages of the demonstration; each runs again only when something that it depends on has changed.

    scans -> template -> registered set with skeleton -> model -> held-out poses, completion, animation
"""
from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from model import BodyModel, Subject, fit_pose, learn_scape, load_model
from model.motion.files import skeleton_arrays
from scanprep.batch.opening import workspace
from scanprep.batch.room import TaskContext, substeps
from scanprep.batch.workspace import KeptSteps, Task, Workspace
from scanprep.dataset import RegisteredSet
from scanprep.geometry import tables
from scanprep.geometry.farthest_points import spread_indices
from scanprep.geometry.files import read_mesh, write_mesh
from scanprep.geometry.landmarks import match_landmarks, read_landmark_vertices, read_landmarks, write_landmarks
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface, SurfacePoints
from scanprep.pipeline.again import Call
from scanprep.pipeline.prepare import SCANS, Prepared, prepare
from scanprep.pipeline.scans import TABLE, find_scans
from scanprep.surfaces.template import template_of_views
from scanprep.synthetic.data_set import (
    SUBJECT,
    GroundTruth,
    SyntheticScan,
    click_landmarks,
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
from .sample import record_markers
from .truth import distance, surface_error


@dataclass(frozen=True)
class Amounts:
    """How much of everything."""

    poses: int                           # scans of one subject in many poses
    subjects: int                        # scans of other people
    faces: int                           # triangles of the template
    resolution: float                    # metres: spacing of the scanner's rays
    template_resolution: float           # the same of the careful scan that the template is made of
    held_out: int                        # poses of the subject that the model never saw
    frames: int = 66                     # of the walk
    rate: float = 60.0                   # frames per second of the walk


# about three minutes on two cores; --full and --quick: more and finer scans, or fewer for a first look
USUAL = Amounts(poses=9, subjects=4, faces=8000, resolution=0.01, template_resolution=0.0055, held_out=3)
FULL = Amounts(poses=20, subjects=12, faces=14000, resolution=0.0068, template_resolution=0.004, held_out=5, frames=132)
QUICK = Amounts(poses=8, subjects=3, faces=7000, resolution=0.011, template_resolution=0.006, held_out=2, rate=30.0)

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
    amounts: Amounts
    seed: int
    # bar(title) is a context manager that yields a progress callback
    bar: Callable[[str], AbstractContextManager[Callable[[int, int], None]]]

    @property
    def folder(self) -> Path:
        """The output folder."""
        return self.space.folder

    @property
    def scanner(self) -> ScannerConfig:
        """The virtual scanner."""
        return ScannerConfig(resolution=self.amounts.resolution)

    @cached_property
    def scans(self) -> list[SyntheticScan]:
        """Scans of one subject in many poses, and of many subjects."""
        tasks = [Task(f"{SCANS}{'pose' if which[1] else 'person'} {which[0]}", which)
                 for which in scan_plan(self.amounts.poses, self.amounts.subjects)]
        with self.bar("scanning people") as progress, one_thread():
            done = self.space.run(ScanPerson(self.seed, self.scanner), tasks, progress=progress)
        if done.failures:
            raise ValueError("; ".join(done.failures.values()))
        for name in set(self.space.list_results(SCANS)) - set(done.values):         # left by a run with more scans
            self.space.drop(name)
        scans = [replace(done.values[task.name], folder=self.folder / "scans") for task in tasks]
        rows = [(s.name, s.subject, s.pose, s.sex) for s in scans]

        def write(folder: Path) -> None:
            (folder / "scans").mkdir()
            tables.write_table(folder / "scans" / TABLE, ("name", "subject", "pose", "sex"), rows)

        self.space.step("table", rows, write)
        return scans

    @cached_property
    def template(self) -> Mesh:
        """The template: a careful scan of the subject at rest from many sides, merged, holes filled, decimated."""
        # twelve views also from above and below, and deep into narrow places, so that hands get fingers
        scanner = ScannerConfig(views=12, resolution=self.amounts.template_resolution, height=1.2, blind_reach=0.01)

        def make(folder: Path) -> None:
            """Scan the subject, merge the views and write the template."""
            rng = np.random.default_rng([self.seed, 6])
            with self.bar("making the template") as progress:
                careful = scan(self.rest.mesh, scanner, rng)
                marks = click_landmarks(self.rest, rng, seen=careful.merged.vertices)
                place = folder / "template_scan"
                write_scan(place, "rest", careful, self.rest, marks)
                mesh = template_of_views(careful.views, self.amounts.faces, progress, self.amounts.template_resolution)
            landmarks = read_landmark_vertices(place / "rest.landmarks.json", mesh)
            write_landmarks(folder / "template.landmarks.json", landmarks)
            write_mesh(folder / "template.ply", mesh)

        self.space.step("template", (self.seed, self.amounts.faces, scanner), make)
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
            for name in ["tables", *stale] if stale else []:    # tables first, as they refer to the scans
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
                model = learn_scape(*bodies, None, progress, substeps(KeptSteps(self.space), "model"))
            replace(model, info={**model.info, "landmarks": self.template_landmarks}).save(folder / MODEL)

        self.space.step("model", (bodies, self.template_landmarks), make)
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
                       distance(vertices, self.true_places(truths[name])))
                for name, vertices in zip(registered.names, registered.vertices(), strict=True)}

    @cached_property
    def person(self) -> SyntheticPerson:
        """The true subject."""
        return SyntheticPerson(SUBJECT)

    @cached_property
    def held_out(self) -> list[GroundTruth]:
        """Poses of the subject that were never scanned."""
        rng = np.random.default_rng([self.seed, 7])
        return [stand(self.person, random_pose(rng)) for _ in range(self.amounts.held_out)]

    def fit_pose(self, wanted: np.ndarray) -> np.ndarray:
        """Compute the model's vertices (N, 3) in the pose that comes closest to `wanted` (N, 3)."""
        return fit_pose(self.subject, wanted).vertices

    @cached_property
    def unseen(self) -> Path:
        """The folder, with what the model makes of people whom it never saw: a half view completed, a walk followed."""
        self.space.step("unseen", (self.folder / MODEL, self.template_landmarks, self.amounts, self.seed),
                        self._make_unseen)
        return self.folder

    def _make_unseen(self, folder: Path) -> None:
        """Scan a held-out pose from one side, complete it, record a walk and follow its markers."""
        # what one camera sees of the first held-out pose, with seven landmarks that somebody clicks
        truth, rng = self.held_out[0], np.random.default_rng([self.seed, 8])
        seen = scan(truth.mesh, replace(self.scanner, views=1, azimuth=-30.0), rng)
        marks = click_landmarks(truth, rng, seen=seen.merged.vertices)
        chosen = np.array(list(marks))[spread_indices(len(marks), 7)]
        write_scan(folder / HALF.parent, HALF.stem, seen, truth, {name: marks[name] for name in chosen})
        # the whole body from it
        half, marks = _read_half(folder)
        _, vertices, points = match_landmarks(self.template_landmarks, marks)
        with self.bar("completing a half view") as progress:
            complete(self.subject, half, (vertices, points), progress=progress).save(folder / "completed")
        # a walk; as with a real subject, the layout is read from the scan at rest, on which the markers are visible
        with self.bar("recording a walk") as progress:
            sequence = record_markers(self.walking, self.rest.faces, self.amounts.rate,
                                      np.random.default_rng([self.seed, 9]), progress)
        _, vertices = cKDTree(self.template.vertices).query(self.rest.vertices[list(MARKERS.values())])
        MarkerLayout(tuple(MARKERS), vertices, DISTANCE).save(folder / "markers" / "layout.json")
        write_markers(folder / "markers" / "walk.c3d", sequence)
        # the motion that follows its markers
        with self.bar("following the markers") as progress:
            motion = animate(self.subject, read_markers(folder / "markers" / "walk.c3d"),
                             MarkerLayout.load(folder / "markers" / "layout.json"), progress=progress)
        motion.save(folder / MOTION, **skeleton_arrays(self.subject.rest_skeleton))

    @cached_property
    def half_scan(self) -> tuple[Mesh, dict[str, np.ndarray], GroundTruth]:
        """What one camera sees of the first held-out pose, a few landmarks on it, and the truth."""
        return *_read_half(self.unseen), self.held_out[0]

    @cached_property
    def completion(self) -> Completion:
        """The whole body from the half view."""
        return load_completion(self.unseen / "completed")

    @cached_property
    def walking(self) -> np.ndarray:
        """The true vertices (T, N, 3) of the walk."""
        poses, trans = synthesise_walk(self.amounts.frames, self.amounts.rate)
        return np.stack([self.person.in_pose(pose, place) for pose, place in zip(poses, trans, strict=True)])

    @cached_property
    def walk(self) -> MarkerSequence:
        """The markers of the walking subject."""
        return read_markers(self.unseen / "markers" / "walk.c3d")

    @cached_property
    def motion(self) -> Motion:
        """The model's motion that follows the markers of the walk."""
        return Motion.load(self.unseen / MOTION)

    @cached_property
    def places(self) -> SurfacePoints:
        """The true surface points nearest to the template's vertices; all people share one triangulation."""
        return Surface(self.rest.mesh).closest(self.template.vertices)

    def true_places(self, truth: GroundTruth) -> np.ndarray:
        """Compute the true places (N, 3) of the template's vertices on a person, metres."""
        return self.places.transfer(truth.vertices, truth.faces)


def _read_half(folder: Path) -> tuple[Mesh, dict[str, np.ndarray]]:
    """Read the half view and its landmarks."""
    return read_mesh(folder / HALF), read_landmarks((folder / HALF).with_suffix(".landmarks.json"))
