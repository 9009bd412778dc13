"""The stages of the demonstration; each leaves files behind and is skipped when they are there.

    scans -> template -> registered set with skeleton -> model -> held-out poses, completion, animation
"""
from __future__ import annotations

import csv
import io
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from model import BodyModel, LearnConfig, Subject, fit_pose, learn_scape, load_model
from scanprep.cleaning.template import TemplateConfig, make_template
from scanprep.console import read_json
from scanprep.dataset import RegisteredSet
from scanprep.geometry import storage
from scanprep.geometry.files import read_mesh, write_mesh
from scanprep.geometry.landmarks import match_landmarks, read_landmark_vertices, read_landmarks, write_landmarks
from scanprep.geometry.mesh import Mesh
from scanprep.pipeline import TABLE, PrepareConfig, Prepared, find_scans, prepare
from scanprep.ranges import Cell, Count, Faces, Positive, Seed, Settings
from scanprep.scanning.embedded import (
    SUBJECT,
    EmbeddedScan,
    GroundTruth,
    click_landmarks,
    embedded_dataset,
    read_views,
    stand,
    write_scan,
)
from scanprep.scanning.people import MARKERS, Person, random_pose, walk
from scanprep.scanning.scanner import ScannerConfig, scan
from scanprep.skeleton.find import SkeletonConfig

from ..animation.follow import animate
from ..markers.files import MarkerSequence, read_markers, write_markers
from ..markers.layout import DISTANCE, MarkerLayout
from ..motion import Motion
from ..partial.completion import Completion, complete
from ..partial.results import load_completion, save_completion
from .truth import TruthMap

Bar = Callable[[str], AbstractContextManager[Callable[[int, int], None]]]


@dataclass(frozen=True)
class DemoConfig(Settings):
    """How much of everything.

    Attributes
    ----------
    poses, subjects : int
        Scans of one subject in many poses, and of other people.
    faces : int
        Triangles of the template.
    parts : int
        Of the skeleton. Left to itself, the search finds rings at the shoulders too, which move with the skin.
    resolution, template_resolution : float, metres
        Spacing of the scanner's rays, for the scans and for the careful one that the template is made of.
    template_views : int
        Sides from which the careful scan is taken.
    held_out : int
        Poses of the subject that the model never saw.
    landmarks : int
        That are marked on the half view.
    frames, rate : int, frames per second
        Of the walk.
    marker_noise : float, metres
    seed : int
    """

    poses: Count = 20
    subjects: Count = 12
    faces: Faces = 14000
    parts: Count = 16
    resolution: Cell = 0.0068
    template_resolution: Cell = 0.004
    template_views: Count = 12
    held_out: int = 5
    landmarks: Count = 7
    frames: Count = 132
    rate: Positive = 60.0
    marker_noise: float = 0.001
    seed: Seed = 0
    learn: LearnConfig = field(default_factory=LearnConfig)


QUICK = DemoConfig(poses=8, subjects=3, faces=7000, resolution=0.011, template_resolution=0.006, held_out=2, frames=66,
                   rate=30.0)


@dataclass(frozen=True)
class Demo:
    """One run of the demonstration in its folder.

    Attributes
    ----------
    folder : Path
    config : DemoConfig
    bar : callable
        `bar(title)` is a context manager that yields a progress callback.
    """

    folder: Path
    config: DemoConfig
    bar: Bar

    def begin(self) -> None:
        """Claim the folder, or make sure that it holds a run with the same settings.

        Raises
        ------
        ValueError
            A run with other settings.
        """
        path, settings = self.folder / "demo.json", storage.as_json(asdict(self.config))
        if path.exists() and read_json(path, "settings of a demo") != settings:
            raise ValueError(f"{self.folder}: holds a demo with other settings; name another folder with --out, "
                             "or remove it")
        self.folder.mkdir(parents=True, exist_ok=True)
        storage.write_json(path, settings)

    @cached_property
    def scanner(self) -> ScannerConfig:
        """The virtual scanner."""
        return ScannerConfig(resolution=self.config.resolution)

    @cached_property
    def scans(self) -> list[EmbeddedScan]:
        """Scans of one subject in many poses and of many subjects."""
        folder = self.folder / "scans"
        with self.bar("scanning embedded people") as progress:
            scans = embedded_dataset(folder, self.config.seed, self.config.poses, self.config.subjects, self.scanner,
                                     progress=progress)
        text = io.StringIO()
        table = csv.writer(text, lineterminator="\n")
        table.writerow(["name", "subject", "pose", "sex"])
        table.writerows([s.name, s.subject, s.pose, s.sex] for s in scans)
        with storage.writing(folder / TABLE) as beside:
            beside.write_text(text.getvalue(), encoding="utf-8")
        return scans

    @cached_property
    def template(self) -> Mesh:
        """A careful scan of the subject at rest from more sides, merged, its holes filled, decimated."""
        folder, path = self.folder / "template_scan", self.folder / "template.ply"
        if not path.exists():
            rng = np.random.default_rng([self.config.seed, 6])
            with self.bar("making the template") as progress:
                # from above and below too, and into places that a fixed scanner does not reach: hands have fingers
                scanner = ScannerConfig(views=self.config.template_views, resolution=self.config.template_resolution,
                                        height=1.2, blind_reach=0.01)
                careful = scan(self.rest.mesh, scanner, rng)
                marks = click_landmarks(self.rest, rng, seen=careful.merged.vertices)
                write_scan(folder, "rest", careful, self.rest, marks)
                settings = TemplateConfig()
                settings = replace(settings, merge=replace(settings.merge, voxel=self.config.template_resolution))
                views = read_views(folder / "views" / "rest.npz")
                mesh = make_template(views, self.config.faces, settings, progress)
            landmarks = read_landmark_vertices(folder / "rest.landmarks.json", mesh)
            write_landmarks(self.folder / "template.landmarks.json", landmarks)
            write_mesh(path, mesh)
        return read_mesh(path)

    @cached_property
    def rest(self) -> GroundTruth:
        """The true subject at rest, of whom the template is made."""
        return stand(self.person, np.zeros((len(self.person.parents), 3)))

    @cached_property
    def template_landmarks(self) -> dict[str, int]:
        """Name -> vertex of the template."""
        return read_landmark_vertices(self.folder / "template.landmarks.json", self.template)

    @cached_property
    def prepared(self) -> Prepared:
        """The registered set, with its skeleton.

        Raises
        ------
        ValueError
            A scan that could not be registered.
        """
        # registration slides some millimetres along the skin: less than that is not motion. The value was chosen
        # on these very scans, so the agreement with the true parts shows what can be reached, not what to expect.
        config = PrepareConfig(skeleton=SkeletonConfig(parts=self.config.parts, tolerance=0.003))
        template, marks, _ = self.template, self.template_landmarks, self.scans
        tasks = find_scans(self.folder / "scans")
        with self.bar("registering scans") as first, self.bar("finding the skeleton") as second:
            done = prepare(tasks, template, marks, self.folder / "set", config, first, second)
        if done.failures:
            raise ValueError("; ".join(done.failures))
        return done

    @cached_property
    def model(self) -> BodyModel:
        """The body model."""
        path = self.folder / "model.npz"
        if not path.exists():
            registered: RegisteredSet = self.prepared.registered
            assert registered.skeleton is not None, "the subject has enough poses for a skeleton"
            with self.bar("learning the model") as progress:
                model = learn_scape(registered.template, registered.poses("subject"), registered.shapes(),
                                    registered.skeleton, self.config.learn, progress)
            replace(model, info={**model.info, "landmarks": self.template_landmarks}).save(path)
        return load_model(path)

    @cached_property
    def subject(self) -> Subject:
        """The subject's body, of the model."""
        return self.model.subject(None)

    @cached_property
    def truths(self) -> dict[str, GroundTruth]:
        """What stood in the scanner, by the name of the scan."""
        return {s.name: GroundTruth.load(s.truth) for s in self.scans}

    @cached_property
    def person(self) -> Person:
        """The true subject."""
        return Person(SUBJECT)

    @cached_property
    def held_out(self) -> list[GroundTruth]:
        """Poses of the subject that were never scanned."""
        rng = np.random.default_rng([self.config.seed, 7])
        return [stand(self.person, random_pose(rng)) for _ in range(self.config.held_out)]

    def fitted(self, wanted: np.ndarray) -> np.ndarray:
        """The model's vertices (N, 3) in the pose that comes closest to `wanted` (N, 3)."""
        return fit_pose(self.subject, wanted).vertices

    @cached_property
    def half_scan(self) -> tuple[Mesh, dict[str, np.ndarray], GroundTruth]:
        """What one camera sees of the first held-out pose, a few landmarks on it, and the truth."""
        folder, truth = self.folder / "half_view", self.held_out[0]
        path = folder / "half_view.ply"
        if not path.exists():
            rng = np.random.default_rng([self.config.seed, 8])
            seen = scan(truth.mesh, replace(self.scanner, views=1, azimuth=-30.0), rng)
            marks = click_landmarks(truth, rng, seen=seen.merged.vertices)
            few = np.unique(np.linspace(0, len(marks) - 1, self.config.landmarks).round().astype(int))
            write_scan(folder, "half_view", seen, truth, {name: marks[name] for name in np.array(list(marks))[few]},
                       views=False)
        return read_mesh(path), read_landmarks(folder / "half_view.landmarks.json"), truth

    @cached_property
    def completion(self) -> Completion:
        """The whole body from the half view."""
        folder = self.folder / "completed"
        if not (folder / "completion.npz").exists():
            half, marks, _ = self.half_scan
            _, vertices, points = match_landmarks(self.template_landmarks, marks)
            subject = self.subject
            with self.bar("completing a half view") as progress:
                save_completion(folder, complete(subject, half, (vertices, points), progress=progress))
        return load_completion(folder)

    @cached_property
    def walk(self) -> tuple[MarkerSequence, MarkerLayout, np.ndarray]:
        """Markers of a walking subject, where they sit on the template, and the true vertices (T, N, 3)."""
        folder = self.folder / "markers"
        poses, trans = walk(self.config.frames, self.config.rate)
        bodies = np.stack([self.person.posed(pose, place) for pose, place in zip(poses, trans, strict=True)])
        if not (folder / "walk.c3d").exists():
            with self.bar("recording a walk") as progress:
                self._record(folder, bodies, progress)
        layout = MarkerLayout.load(folder / "layout.json", len(self.template.vertices))
        return read_markers(folder / "walk.c3d"), layout, bodies

    def _record(self, folder: Path, bodies: np.ndarray, progress: Callable[[int, int], None]) -> None:
        rng = np.random.default_rng([self.config.seed, 9])
        labels, places = tuple(MARKERS), np.array(list(MARKERS.values()))
        faces, out = self.person.mesh.faces, []
        for i, body in enumerate(bodies):
            out.append(body[places] + DISTANCE * Mesh(body, faces).vertex_normals[places])
            progress(i + 1, len(bodies))
        positions = np.stack(out) + rng.normal(0, self.config.marker_noise, (len(bodies), len(labels), 3))
        positions[rng.random(positions.shape[:2]) < 0.03] = np.nan
        # as on a real subject: the layout is read off the scan at rest, on which the markers can be seen
        _, vertices = cKDTree(self.template.vertices).query(self.rest.vertices[places])
        MarkerLayout(labels, vertices, DISTANCE).save(folder / "layout.json")
        sequence = MarkerSequence(positions, labels, self.config.rate)
        write_markers(folder / "walk.csv", sequence)
        write_markers(folder / "walk.c3d", sequence)

    @cached_property
    def motion(self) -> Motion:
        """The walk followed by the model."""
        path = self.folder / "animation" / "motion.npz"
        if not path.exists():
            sequence, layout, _ = self.walk
            subject = self.subject
            with self.bar("following the markers") as progress:
                animate(subject, sequence, layout, progress=progress).save(path)
        return Motion.load(path)

    @cached_property
    def truth_map(self) -> TruthMap:
        """Where the template's vertices truly lie."""
        return TruthMap.of(self.template, self.rest)
