"""Recognise files and folders by their contents, and how each is shown."""
from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from model.body import BodyModel
from model.files import load_model
from model.motion.files import betas_for, read_motion_file
from model.motion.onto import read_motion
from model.statue.files import ABOUT, CONTROL
from scanprep.cli import Unit
from scanprep.dataset import RegisteredSet
from scanprep.depth_camera.picture import CAMERA, is_camera
from scanprep.geometry.files import read_mesh
from scanprep.geometry.landmarks import landmarks_beside, read_landmarks
from scanprep.viewer.clicked import read_shown_surface

from ..mocap.files.markers import MarkerSequence
from ..motion import Motion
from ..partial.completion import load_completion
from .contents import Content, collect_warnings, from_camera, mark_places, of_completion, of_mesh, of_model
from .kinds import DEEP, layout_places, model_of_report, viewable_kind, worst_first
from .motions import of_markers, of_motion, read_recording
from .soft import soft_tissue_of, with_soft_tissue
from .statues import read_statue

# files by which folders of commands are recognised
COMPLETION, MOTION, SET = "completion.npz", "motion.npz", "set.json"


@dataclass(frozen=True, eq=False)
class Entry:
    """A thing that can be shown; it is read only then. `first`: shown at the start."""

    name: str
    load: Callable[[], Content]
    first: bool = True


class Files:
    """The things in files and folders that were named.

    Parameters
    ----------
    paths : tuple of Path
        Files and folders.
    model : Path, optional
        Model of motions that do not name theirs.
    unit : str, optional
        Unit of meshes, points, landmarks and markers.
    over : bool
        Show recordings of markers with the motions made from them, not by themselves.
    rate : float, frames per second, optional
        Of motions and markers, where files do not say or say it wrongly.
    """

    # endings of files that belong to a mesh or model: landmarks and marker layouts
    PLACES = (".pp", ".json", ".lnd", ".landmarks.txt", ".landmarks.csv", ".fcsv")
    # kinds of files that are shown from a folder
    SHOWN = ("surface", "picture", "model", "motion", "markers")

    def __init__(self, paths: tuple[Path, ...] = (), model: Path | None = None, unit: Unit | None = None,
                 over: bool = False, rate: float | None = None) -> None:
        self.paths, self.model, self.unit, self.over, self.rate = paths, model, unit, over, rate
        self._models: dict[Path, BodyModel] = {}
        self._known: dict[str, list[Path]] = {"model": [], "markers": []}      # models and recordings among the files

    def entries(self) -> list[Entry]:
        """List all things in order; ValueError for a missing file, or one that cannot be shown."""
        entries: list[Entry] = []
        for path in self.paths:
            if not path.exists():
                raise ValueError(f"{path}: no such file or folder")
            if is_camera(path):                          # it is read with its picture
                picture = path.with_name(path.name[:-len(CAMERA)] + ".png")
                if not picture.exists():
                    raise ValueError(f"{path}: expected its depth picture, {picture.name}, beside it; there is none")
                if picture in self.paths:
                    continue
                path = picture
            if path.name in (ABOUT, CONTROL) and (path.parent / ABOUT).is_file():   # a file of a statue: show it all
                path = path.parent
            if path.name.lower().endswith(self.PLACES):
                self._lay_on(entries, path)
            else:
                entries += self._of_folder(path) if path.is_dir() else [self._of_file(path, path.name)]
        # leave out a folder name that all entries share
        shared = f"{entries[0].name.split('/')[0]}/" if entries else ""
        if len(entries) > 1 and all(entry.name.startswith(shared) for entry in entries):
            entries = [replace(entry, name=entry.name.removeprefix(shared)) for entry in entries]
        return entries

    def read_model(self, path: Path) -> BodyModel:
        """Read a model, a file or the name of a built-in one, each once."""
        if (known := path.resolve()) not in self._models:
            self._models[known] = load_model(path)
        return self._models[known]

    # files

    def _of_file(self, path: Path, name: str) -> Entry:
        """Make the entry of a file, by its kind."""
        kind = viewable_kind(path)
        loads: dict[str, Callable[[], Content]] = {
            "model": lambda: of_model(name, self.read_model(path)),
            "motion": lambda: collect_warnings(lambda: self._motion(path, name)),
            "completion": lambda: of_completion(name, load_completion(path.parent)),
            "markers": lambda: collect_warnings(lambda: of_markers(name, read_recording(path, self.unit, self.rate))),
            "surface": lambda: collect_warnings(lambda: self._surface(path, name)),
            "picture": lambda: from_camera(self._surface(path, name))}
        if kind not in loads:
            raise ValueError(f"{path}: expected a mesh, points, markers, a model, a motion, landmarks, a depth picture "
                             f"or a folder, found {kind}")
        if kind in self._known:
            self._known[kind].append(path)
        return Entry(name, loads[kind], kind != "markers" or not self.over)

    def _surface(self, path: Path, name: str) -> Content:
        """Read a mesh or points with the landmarks beside them."""
        shape, file = read_shown_surface(path, self.unit), landmarks_beside(path)
        if file is None:
            return of_mesh(name, shape)
        try:
            return of_mesh(name, shape, read_landmarks(file, shape, self.unit))
        except ValueError as problem:                    # a file of another kind with a name like landmarks
            return replace(of_mesh(name, shape), notes=(f"no landmarks beside {name}: {problem}",))

    def _lay_on(self, entries: list[Entry], path: Path) -> None:
        """Put landmarks, or a marker layout, on the thing named before them."""
        if not entries:
            raise ValueError(f"{path}: landmarks and layouts are shown on a mesh or model; name that before them")
        last = entries.pop()

        def load() -> Content:
            content = last.load()
            mesh = getattr(content.shapes[0], "mesh", None)
            places = layout_places(path, mesh) or read_landmarks(path, mesh, self.unit)
            dots = [mark_places(places, content.stance, path.name)] if places else []
            still = (f"{path.name}: shown on the body at rest, without sliders",) * (content.model is not None)
            return replace(content, shapes=[*content.shapes, *dots], model=None, notes=(*content.notes, *still))

        entries.append(replace(last, load=load))

    # folders

    def _of_folder(self, folder: Path) -> list[Entry]:
        """List the things of a folder."""
        entries = list(self._inside(folder, folder.resolve().name, DEEP))
        if not entries:
            raise ValueError(f"{folder}: expected meshes, a registered set, or what a command wrote; found none")
        return entries

    def _inside(self, folder: Path, name: str, deep: int) -> Iterator[Entry]:
        """Yield the things of a folder: what a command wrote, else its files and folders."""
        if (folder / SET).is_file():
            yield from self._of_set(folder, name)
        elif (folder / ABOUT).is_file() and (folder / CONTROL).is_file():
            yield Entry(name, lambda: read_statue(name, folder))
        elif (folder / COMPLETION).is_file():
            yield Entry(name, lambda: of_completion(name, load_completion(folder)))
        elif (folder / MOTION).is_file():
            yield Entry(name, lambda: collect_warnings(lambda: self._motion(folder / MOTION, name)))
            if (folder / "onto.npz").is_file():
                yield Entry(f"{name}, other person",
                            lambda: collect_warnings(lambda: self._motion(folder / "onto.npz", name)))
        else:
            for path in sorted(folder.iterdir()):
                if path.name.startswith("."):
                    continue
                if path.is_dir() and deep:
                    yield from self._inside(path, f"{name}/{path.name}", deep - 1)
                # not by themselves: tables hold anything, and a BVH needs a model
                elif path.is_file() and path.suffix.lower() not in (".csv", ".tsv", ".txt", ".bvh") \
                        and viewable_kind(path) in self.SHOWN:
                    yield self._of_file(path, f"{name}/{path.name}")

    def _of_set(self, folder: Path, name: str) -> Iterator[Entry]:
        """Yield the meshes of a registered set, worst first, of which the first is shown; then the template."""
        registered = RegisteredSet.load(folder)

        def load(label: str, path: Path) -> Content:
            return of_mesh(label, read_mesh(path, "m"))

        for i, (scan, why) in enumerate(worst_first(registered)):
            path = folder / next(entry.file for entry in registered.entries if entry.name == scan)
            label = f"{name}/{scan}" + (f": {why}" if why else "")
            yield Entry(label, lambda label=label, path=path: load(label, path), i == 0)  # type: ignore[misc]
        yield Entry(f"{name}/template", lambda: load(f"{name}/template", folder / "template.ply"), False)

    # motions

    def _motion(self, path: Path, name: str) -> Content:
        """Read a motion with its model, markers and soft tissue."""
        motion, model, notes = self._on_model(path)
        subject, markers = model.subject(motion.betas, np.float32), self._markers_of(path, motion)
        soft = soft_tissue_of(path, motion)
        if soft is None:
            content = of_motion(name, motion, subject, markers)
            return replace(content, notes=(*content.notes, *notes))
        return with_soft_tissue(of_motion(name, motion, subject), soft, model, markers)

    def _on_model(self, path: Path) -> tuple[Motion, BodyModel, tuple[str, ...]]:
        """Read a motion and its model; a motion of another skeleton is transferred, with notes about it."""
        if path.suffix.lower() == ".bvh" or read_motion_file(path, rate=self.rate).of_family:
            model = self._model_of(path)
            transferred = read_motion(path, model, unit=self.unit, rate=self.rate)
            return Motion.of(transferred), model, tuple(
                f"{path.name}: {note}" for note in (*(f"{m.name} {m.value}" for m in transferred.told),
                                                    *transferred.doubts))
        motion = Motion.load(path, self.rate)
        model = self._model_of(path, motion)
        parts = len(model.skeleton.parents)
        if motion.poses.shape[1] != parts:
            raise ValueError(f"{path}: expected a motion of the model's {parts} parts, found {motion.poses.shape[1]}; "
                             "name its own model with -m")
        try:
            return replace(motion, betas=betas_for(path, motion.betas, model)), model, ()
        except ValueError as problem:
            raise ValueError(f"{problem}; name its own model with -m") from None

    def _markers_of(self, path: Path, motion: Motion) -> MarkerSequence | None:
        """Find the recording of a motion: the mended one beside it, or one among the files, laid over it."""
        virtual = path.with_name("virtual.c3d")
        candidates = [(virtual, None)] if virtual.is_file() and path.name == MOTION else []
        for file, unit in [*candidates, *((one, self.unit) for one in self._known["markers"] if self.over)]:
            markers = read_recording(file, unit, self.rate)
            # a recording of the same length that shares three labels or more
            if len(markers.positions) == len(motion.poses) and len({*markers.labels} & {*motion.labels}) >= 3:
                return markers
        return None

    def _model_of(self, path: Path, motion: Motion | None = None) -> BodyModel:
        """Find the model of a motion: the named one, that of the report beside it, or one among the files."""
        if self.model is not None:
            return self.read_model(self.model)
        for folder in list(path.resolve().parents)[:DEEP]:
            name = model_of_report(folder / "report.json")
            if name is not None:
                return self.read_model(name)
        fitting = [m for m in map(self.read_model, self._known["model"])
                   if motion is None or len(m.skeleton.parents) == motion.poses.shape[1]]
        if not fitting:
            raise ValueError(f"{path}: a motion needs its model; name it with -m")
        return fitting[0]
