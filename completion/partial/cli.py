"""The command `scape complete`."""
from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import Annotated

from scanprep.arguments import Place, UsageError
from scanprep.batch.pool import Workers
from scanprep.batch.workspace import Task, Workspace
from scanprep.cli import Output, PersonUnit, Unit
from scanprep.console import Metric, Outcome
from scanprep.folders import do_one, load_results
from scanprep.geometry.landmarks import landmarks_beside
from scanprep.judgement import judge_many
from scanprep.pipeline.scans import find_scans
from scanprep.ranges import Axis, direction_of

from ..cli import ModelOrNone, body_of, marks_of_template, read_model
from .folder import FolderCall
from .settings import CompletionConfig
from .work import CompletionInputs, CompletionTask

ScansArg = Annotated[tuple[Path, ...], Place("SCAN [SCAN ...]")]


def complete_scan(scans: ScansArg = (), *, output: Output, model: ModelOrNone = None, landmarks: Path | None = None,
                  subject: str | None = None, template_landmarks: Path | None = None, mask: tuple[Path, ...] = (),
                  unit: PersonUnit | None = None, up: Axis | None = None, interactive: bool = False,
                  config: CompletionConfig = CompletionConfig(),
                  workers: Workers = Workers(), space: Workspace) -> Outcome:
    """The whole body from a scan of some of it.

    Several scans are views of one body in one frame. A folder is completed scan by scan, each into a folder of its
    name; called again, it goes on where it was, and does anew what has changed.

    Example: scape complete half.ply -m model.npz --landmarks half.landmarks.json -o completed

    Args:
        scans: Mesh or point cloud, the views of one body, or a folder of scans; or one depth picture, a 16-bit PNG in
            millimetres with its camera beside it in NAME.camera.json.
        output: Folder to write completed.ply, predicted.ply, completion.npz and report.html to; completed.glb for a
            scan with a texture; layout.json where markers were clicked too.
        model: Model of `scape learn`; without it that of the built-in people.
        landmarks: 4 to 10 named points on the scan; else the file of the scan's name beside it. Without any the
            search starts from typical poses. For a folder of scans, the folder of such files. Names that are not the
            model's landmarks are markers that the person wears.
        subject: Whose body it is: "template" for the one the model's poses were learned from, betas in JSON or .npz,
            or a mesh in the model's triangles. Without it the shape is found too.
        template_landmarks: Where these landmarks are on the model's template; else those kept in the model.
        mask: Which points are clothing or hair: .json of the numbers of points, or a mesh or cloud in which they are
            painted in a colour. One file, or one for each view; for a folder of
            scans, the folder of such files. Without it, what is 16 mm and more off skin is found, and listed in
            mask.json, to be corrected; a file without points says that all is skin.
        unit: Unit of the scan and landmarks; "unknown": it is found together with the body.
        up: The axis of the scan that points up, where it is known: people mostly stand. Of a depth camera that stands
            upright it is -y, written --up=-y, of one upside down y.
        interactive: In the browser: click landmarks, complete, look at the body from all sides, correct, save. A
            recording of markers beside the scan tells which ones to click. Of a folder, the results that are in the
            output are opened, worst first.
        config: Settings.
        workers: Who completes the scans of a folder.
    """
    if not scans:
        raise UsageError("SCAN: expected at least one scan, or a folder of scans")
    # two flags that are settings
    if unit == "unknown":
        config, unit = replace(config, free_scale=True), None
    if up is not None:
        config = replace(config, up=direction_of(up))
    # a folder: each scan by itself
    if len(scans) == 1 and scans[0].is_dir():
        if len(mask) > 1:
            raise UsageError(f"--mask: expected one folder of masks for a folder of scans, got {len(mask)}")
        call = FolderCall(scans[0], model, landmarks, subject, template_landmarks, next(iter(mask), None), unit, config)
        return _mend(call, space) if interactive else call.carry_out(space, workers)
    if interactive:
        return _in_browser(scans, output, model, subject, template_landmarks, unit, config)
    loaded, name = read_model(model)
    inputs = CompletionInputs(scans, landmarks or landmarks_beside(scans[0]), mask)
    # names of landmarks must be known on the template only if there are any
    marks = {} if inputs.landmarks is None else marks_of_template(loaded, template_landmarks, name)
    work = CompletionTask(body_of(loaded, subject, unit), name, marks, config, unit)
    if inputs.landmarks is None:
        warnings.warn("no landmarks; the search starts from typical poses, look at report.html for limbs mixed up",
                      stacklevel=2)
    return do_one("completing", space, work, Task("completion", inputs), {"complete": config, "model": name},
                  f"open {quote(str(output / 'report.html'))}, then scape measure {quote(str(output))} "
                  f"{'' if model is None else f'-m {quote(str(model))} '}-o measures.csv")


def _mend(call: FolderCall, space: Workspace) -> Outcome:
    """Review and correct the results of a folder in the browser."""
    from scanprep.viewer.server import serve

    from .mend import CompletionsApp

    app = CompletionsApp(call, space.folder)
    serve(app)
    results = load_results(space, list(app.tasks))
    saved = Metric("bodies saved", len(app.fresh))
    if not results.values and not results.failures:
        return Outcome(None, [saved], judgement=None)
    outcome = call.description(space.folder, app.plain.model).outcome(space, results, len(app.tasks))
    return replace(outcome, metrics=[saved, *outcome.metrics])


def _in_browser(scans: tuple[Path, ...], output: Path, model: Path | None, subject: str | None,
                template_landmarks: Path | None, unit: Unit | None, config: CompletionConfig) -> Outcome:
    """Complete scans in the browser."""
    from scanprep.viewer.server import serve

    from .clicked_markers import is_recording, labels_of
    from .interactive import CompleteApp

    loaded, name = read_model(model)
    marks = marks_of_template(loaded, template_landmarks, name)
    # recordings among the files give labels of markers to click; the others are scans
    labels = [label for path in scans for label in labels_of(path)]
    scans = tuple(path for path in scans if not is_recording(path))
    files = [path for one in scans for path in ([task.scan for task in find_scans(one)] if one.is_dir() else [one])]
    if not files:
        raise UsageError("SCAN: expected at least one scan beside the recordings of markers")
    app = CompleteApp(loaded, CompletionTask(body_of(loaded, subject, unit), name, marks, config, unit), files, output,
                      labels)
    serve(app)
    judged = {scan.name: app.made[scan].completion.judgement for scan in app.saved}
    rows = [Metric("bodies saved", len(judged)), *(Metric(name, one.verdict) for name, one in judged.items())]
    return Outcome(output if judged else None, rows, {"complete": config, "model": name},
                   judgement=judge_many(judged) if judged else None)
