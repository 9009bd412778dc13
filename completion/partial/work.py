"""One scan of `scape complete`: read, completed, coloured, written with its page."""
from __future__ import annotations

import time
import warnings
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from model.body import BodyModel
from model.linear import Subject
from scanprep.batch.room import Room
from scanprep.cli import MM, Unit
from scanprep.console import Metric, Outcome, write_report
from scanprep.geometry.landmarks import match_landmarks, read_landmarks
from scanprep.geometry.mesh import Mesh
from scanprep.pictures.sheets import save_png
from scanprep.pictures.textures import bake, write_textured

from .colors import ColorConfig, blend, carry_colors, colored_views
from .completion import Completion, complete, completion_problem
from .masks import read_mask
from .report import completion_page, picture_completion
from .results import save_completion
from .scan import all_points, point_count
from .settings import CompletionConfig
from .views import ScanFiles, read_views


@dataclass(frozen=True, eq=False)
class Work:
    """What the scans of one call have in common."""

    body: BodyModel | Subject  # BodyModel or Subject
    model: str              # name of the model, for the report
    marks: dict[str, int]   # name -> vertex of the template
    config: CompletionConfig  # CompletionConfig
    unit: Unit | None = None  # of the scans and landmarks, where the files cannot tell
    colors: ColorConfig = field(default_factory=ColorConfig)  # ColorConfig
    command: str = field(default="", metadata={"digest": False})

    def __call__(self, inputs: Inputs, room: Room) -> list[Metric]:
        """Complete the scan of some files; the figures."""
        start = time.perf_counter()
        metrics = complete_files(self, inputs, room)
        if self.command:
            write_report(Outcome(room.folder, metrics, {"complete": self.config}), self.command,
                         time.perf_counter() - start)
        return metrics


@dataclass(frozen=True)
class Inputs:
    """The files of one scan: its views, landmarks, and masks for all of them or one for each."""

    scans: tuple[Path, ...]
    landmarks: Path | None = None
    masks: tuple[Path, ...] = ()

    @property
    def name(self) -> str:
        """For the title of the page."""
        return ", ".join(path.name for path in self.scans)


def complete_files(work: Work, inputs: Inputs, room: Room) -> list[Metric]:
    """Complete the scan of some files into the folder of a room, report.html in it; the figures.

    The first is called "problem" where the completion means nothing, and says why.
    """
    with warnings.catch_warnings():
        if work.config.free_scale:
            warnings.filterwarnings("ignore", ".*when read as metres", UserWarning)
        files = read_views(inputs.scans, work.unit)
        landmarks = _landmarks(work, inputs, files)
        masked = read_masks(inputs.masks, files, work.unit)
    views = list(files.views)
    done = room.step("completion", (work.body, work.marks, work.config, work.unit, inputs),
                     lambda: complete(work.body, views, landmarks, work.config, room.tell, masked))
    output = room.folder
    if files.colored:
        done = _with_colors(work, files, done, output)
    save_completion(output, done)
    problem = completion_problem(done, all_points(files.views), work.config.free_scale)
    metrics = [*([Metric("problem", problem)] if problem else []), *figures(work, inputs, done, landmarks, masked)]
    picture = picture_completion(views, done, work.body.template, masked=masked)
    save_png(output / "picture.png", picture)
    rows = [(m.name, m.value, m.unit) for m in metrics]
    page = completion_page(views, done, work.body.template, inputs.name, rows, masked, landmarks, picture)
    page.write(output / "report.html")
    return metrics


def figures(work: Work, inputs: Inputs, done: Completion, landmarks: tuple[np.ndarray, np.ndarray] | None,
            masked: np.ndarray | None) -> list[Metric]:
    """The rows of the closing table."""
    rows = [Metric("distance of the scan to the completed mesh, RMS", MM * done.rms, "mm"),
            Metric("scan points explained", 100 * done.explained, "%"),
            Metric("vertices with data", 100 * float(done.seen.mean()), "%")]
    if landmarks is None:
        rows.append(Metric("landmarks used", "none"))
    else:
        rows += [Metric("landmarks used", len(landmarks[0])),
                 Metric("distance of landmarks, predicted mesh, RMS", MM * done.landmark_rms, "mm")]
    if len(inputs.scans) > 1:
        rows.append(Metric("views", len(inputs.scans)))
    if masked is not None:
        rows.append(Metric("scan points masked", 100 * float(masked.mean()), "%"))
    if work.config.free_scale:
        rows.append(Metric("unit of the scan", float(done.scale), "m"))
    return [*rows, Metric("converged", "yes" if done.converged else "no"), Metric("rounds", done.iterations),
            Metric("model", work.model)]


def read_masks(paths: tuple[Path, ...], files: ScanFiles, unit: Unit | None) -> np.ndarray | None:
    """Which points (n,) are clothing or hair, all views one after the other, from one file or one for each view."""
    if not paths:
        return None
    if len(paths) == 1:
        return read_mask(paths[0], all_points(files.views), unit)
    if len(paths) != len(files.views):
        raise ValueError(f"--mask: expected one file, or one for each of the {len(files.views)} views, "
                         f"got {len(paths)}")
    starts = np.cumsum([0, *map(point_count, files.views)])
    points = all_points(files.views)
    return np.concatenate([read_mask(path, points[a:b], unit)
                           for path, a, b in zip(paths, starts[:-1], starts[1:], strict=True)])


def _landmarks(work: Work, inputs: Inputs, files: ScanFiles) -> tuple[np.ndarray, np.ndarray] | None:
    if inputs.landmarks is None:
        return None
    found = read_landmarks(inputs.landmarks, files.mesh, work.unit)
    try:
        _, vertices, points = match_landmarks(work.marks, found)
    except ValueError as error:
        raise ValueError(f"{inputs.landmarks}: {error}") from None
    return vertices, points


def _with_colors(work: Work, files: ScanFiles, done: Completion, output: Path) -> Completion:
    """The completion with colours on its mesh; a textured scan gives completed.glb besides."""
    mesh, views = done.completed, list(files.views)
    colors = carry_colors(mesh, done.seen, views, work.colors, work.config.viewpoint, done.scale, files.textures)
    if any(texture is not None for texture in files.textures):
        known = colored_views(views, work.config.viewpoint, done.scale, files.textures)
        write_textured(output / "completed.glb",
                       bake(mesh, lambda places, normals: blend(known, places, normals, work.colors), colors))
    return replace(done, completed=Mesh(mesh.vertices, mesh.faces, colors))
