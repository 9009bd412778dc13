"""The work of `scape complete` on one scan: read files, complete, colour, write results and page."""
from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from model.body import BodyModel
from model.fitting.scan import all_points, point_count, prepare_picture
from model.linear import Subject
from scanprep.arguments import UsageError
from scanprep.batch.room import TaskContext
from scanprep.cli import MM, Unit
from scanprep.console import Metric, Outcome, details, judgement_of, judgement_row, write_report
from scanprep.depth_camera.picture import DepthPicture, read_depth
from scanprep.geometry import storage
from scanprep.geometry.files import PointCloud, common_unit, read_view
from scanprep.geometry.format_common import UNITS
from scanprep.geometry.landmarks import read_landmarks, try_match_landmarks
from scanprep.geometry.mesh import Mesh
from scanprep.judgement import size
from scanprep.pictures.scene import SCENE, small_scene
from scanprep.pictures.sheets import save_png
from scanprep.pictures.textures import Texture, bake_body_texture, read_texture, write_textured
from scanprep.registration.ground import soles_row

from .clicked_markers import extra_markers, write_clicked_markers
from .colors import blend, carry_colors, views_with_colors
from .completion import Completion
from .masks import read_mask
from .report import completion_page, completion_panes, picture_completion
from .settings import CompletionConfig
from .wrong_landmarks import complete_named

EXPECTED, EXPLAINED = "expected error of the body, mean", "share of the scan that lies on the body"
MEASURED = "share of the body that was measured"
LEFT = "what the scan leaves beside the body that was bent onto it, RMS"
MEANS = (EXPECTED, EXPLAINED, MEASURED, LEFT)


@dataclass(frozen=True, eq=False)
class CompletionTask:
    """Settings and body that all scans of one call share."""

    body: BodyModel | Subject
    model: str = field(metadata={"digest": False})                   # name of the model, for the report
    marks: dict[str, int]            # name -> vertex of the template
    config: CompletionConfig
    unit: Unit | None = None         # of the scans and landmarks, where the files cannot tell
    command: str = field(default="", metadata={"digest": False})     # for the report of each scan of a folder

    def __call__(self, inputs: CompletionInputs, context: TaskContext) -> list[Metric]:
        """Complete one scan and return its figures."""
        start = time.perf_counter()
        metrics = complete_files(self, inputs, context)
        if self.command:
            write_report(Outcome(context.folder, metrics, {"complete": self.config}, judgement=judgement_of(metrics)),
                         self.command, time.perf_counter() - start)
        return metrics


@dataclass(frozen=True)
class CompletionInputs:
    """The files of one scan: views, landmarks, and one mask for all views or one for each."""

    scans: tuple[Path, ...]
    landmarks: Path | None = None
    masks: tuple[Path, ...] = ()


@dataclass(frozen=True, eq=False)
class ScanFiles:
    """The views of one scan, and the texture of each, if any."""

    views: tuple[Mesh | PointCloud, ...]
    textures: tuple[Texture | None, ...]

    @property
    def colored(self) -> bool:
        """Tell whether any view has colours or a texture."""
        return any(t is not None or v.colors is not None for v, t in zip(self.views, self.textures, strict=True))

    @property
    def mesh(self) -> Mesh | None:
        """The only view if it is a mesh: vertex and face numbers in a landmark file refer to it."""
        only = self.views[0] if len(self.views) == 1 else None
        return only if isinstance(only, Mesh) else None


def complete_files(work: CompletionTask, inputs: CompletionInputs, context: TaskContext) -> list[Metric]:
    """Complete one scan into the folder of a task, with its report.html; return the figures, the judgement first."""
    unit = "m" if work.config.free_scale else work.unit            # "m": numbers as they are in the files
    depth = read_picture(inputs.scans, work.unit)
    files = read_scan_views(inputs.scans, unit) if depth is None else ScanFiles((), ())
    # landmarks by name, and masks, both in the unit of the scan
    surface = files.mesh or (all_points(files.views) if files.views else None)
    named = read_landmarks(inputs.landmarks, surface, unit) if inputs.landmarks else {}
    landmarks = try_match_landmarks(inputs.landmarks, work.marks, named) if inputs.landmarks else None
    masked = read_masks(inputs.masks, files, unit) if depth is None else None
    if depth is not None:
        if inputs.masks:
            raise UsageError("--mask: expected none with a depth picture; set the depth of what is not skin to 0")
        files = person_in(depth, work.body.template, landmarks)
    # complete, which is kept for a later run, and write everything
    scan = list(files.views) if depth is None else depth
    done = context.step("completion", (work.body, work.marks, work.config, work.unit, inputs),
                        lambda: complete_named(work.body, scan, landmarks, work.marks, work.config,
                                               context.report_progress, masked))
    masked = done.not_skin if masked is None else masked
    return [*write_results(work, inputs, files, done, landmarks, masked, context.folder),
            *write_clicked_markers(context.folder, done, extra_markers(named, work.marks))]


def write_results(work: CompletionTask, inputs: CompletionInputs, files: ScanFiles, done: Completion,
                  landmarks: tuple[np.ndarray, np.ndarray] | None, masked: np.ndarray | None, output: Path
                  ) -> list[Metric]:
    """Write a completion with its colours, pictures and page into a folder and return the figures."""
    views, mesh, viewpoint = list(files.views), done.completed, work.config.viewpoint
    # colours of the vertices, and a texture where a view has one
    if files.colored:
        colors = carry_colors(mesh, done.seen, views, work.config.fill_colors, viewpoint, done.scale, files.textures)
        if any(texture is not None for texture in files.textures):
            known = views_with_colors(views, viewpoint, done.scale, files.textures)
            write_textured(output / "completed.glb", bake_body_texture(
                mesh, lambda places, normals: blend(known, places, normals), colors))
        done = replace(done, completed=Mesh(mesh.vertices, mesh.faces, colors))
    done.save(output)
    metrics = [judgement_row(done.judgement), *completion_figures(work, inputs, done, landmarks, masked)]
    # the picture and the page, and a small scene for the page of the folder
    name = ", ".join(path.name for path in inputs.scans)
    panes = completion_panes(views, done, work.body.template, masked, landmarks,
                             {vertex: name for name, vertex in work.marks.items()})
    picture = picture_completion(panes, done, work.body.template)
    save_png(output / "picture.png", picture)
    hidden = masked is not None and bool(masked.any())
    completion_page(panes, name, metrics, picture, hidden).write(output / "report.html")
    if work.command:
        storage.write_file(output / SCENE, small_scene(panes))
    return metrics


def completion_figures(work: CompletionTask, inputs: CompletionInputs, done: Completion,
                       landmarks: tuple[np.ndarray, np.ndarray] | None,
                       masked: np.ndarray | None) -> list[Metric]:
    """The rows of the closing table."""
    rows = [Metric(EXPLAINED, 100 * done.explained, "%"),
            Metric(MEASURED, 100 * done.measured, "%"),
            Metric("landmarks used", "none" if landmarks is None else len(landmarks[0]))]
    if done.expected_error is not None:
        error = float(np.average(done.expected_error, weights=done.completed.vertex_areas))
        rows.insert(0, Metric(EXPECTED, MM * error, "mm"))
    if landmarks is not None:
        rows.append(Metric("landmarks to the model's own body, RMS", MM * done.landmark_rms, "mm"))
    if len(inputs.scans) > 1:
        rows.append(Metric("views", len(inputs.scans)))
    if masked is not None:
        rows.append(Metric("scan points masked", 100 * float(masked.mean()), "%"))
    if done.worn:
        rows.append(Metric("not skin", "; ".join(done.worn)))
    elif inputs.scans[0].suffix.lower() == ".png":
        rows.append(Metric("not skin", "not looked for in a depth picture"))
    if work.config.free_scale:
        rows.append(Metric("unit of the scan", float(done.scale), "m"))
    return [*rows, *soles_row(done.soles), Metric(LEFT, MM * done.rms, "mm"),
            Metric("model", work.model), *details([Metric("settled", "yes" if done.converged else "no"),
                                                   Metric("rounds", done.iterations)])]


def read_masks(paths: tuple[Path, ...], files: ScanFiles, unit: Unit | None) -> np.ndarray | None:
    """Read which points (n,) are clothing or hair, one view after the other, from one file or one for each view."""
    if not paths:
        return None
    if len(paths) == 1:
        return read_mask(paths[0], all_points(files.views), unit)
    if len(paths) != len(files.views):
        raise UsageError(f"--mask: expected one file, or one for each of the {len(files.views)} views, "
                         f"got {len(paths)}")
    starts = np.cumsum([0, *map(point_count, files.views)])
    points = all_points(files.views)
    return np.concatenate([read_mask(path, points[a:b], unit)
                           for path, a, b in zip(paths, starts[:-1], starts[1:], strict=True)])


def read_scan_views(paths: Sequence[Path], unit: str | None = None) -> ScanFiles:
    """Read the views of a scan, which share one unit."""
    unit = common_unit(paths, unit) if len(paths) > 1 else unit
    views = tuple(read_view(path, unit) for path in paths)
    return ScanFiles(views, tuple(read_texture(path, unit) if isinstance(view, Mesh) else None
                                  for path, view in zip(paths, views, strict=True)))


def read_picture(paths: Sequence[Path], unit: str | None = None) -> DepthPicture | None:
    """Read the depth picture among the files, in millimetres unless a unit is given; None without one."""
    pictures = [path for path in paths if path.suffix.lower() == ".png"]
    if not pictures:
        return None
    if len(paths) > 1:
        raise ValueError(f"SCAN: expected one depth picture alone, got {len(paths)} files")
    return read_depth(pictures[0], UNITS[unit or "mm"])


def person_in(picture: DepthPicture, template: Mesh, landmarks: tuple[np.ndarray, np.ndarray] | None) -> ScanFiles:
    """Return the person in a depth picture as a view; `landmarks` are those of `complete`."""
    person = prepare_picture(picture, size(template), np.zeros((0, 3)) if landmarks is None else landmarks[1])
    return ScanFiles((PointCloud(person.points, person.normals),), (None,))
