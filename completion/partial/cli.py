"""The command `scape complete`."""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from model.body import BodyModel
from model.linear import Subject
from model.posing.cli import read_subject
from scanprep.batch.pool import Workers
from scanprep.batch.workspace import Task, Workspace
from scanprep.cli import Output, Unit
from scanprep.console import Metric, Outcome, bar, failures_of, judgement_of, say
from scanprep.geometry.landmarks import landmarks_beside
from scanprep.pipeline.scans import find_scans

from ..cli import ModelOrNone, read_model
from .colors import ColorConfig
from .settings import CompletionConfig
from .work import Inputs, Work, folder_inputs, folder_page, marks_of_template, summary

ScansArg = Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="SCAN [SCAN ...]")]
AXES = {"x": (1.0, 0.0, 0.0), "-x": (-1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "-y": (0.0, -1.0, 0.0),
        "z": (0.0, 0.0, 1.0), "-z": (0.0, 0.0, -1.0)}


def complete_scan(scans: ScansArg = (), *, output: Output, model: ModelOrNone = None, landmarks: Path | None = None,
                  subject: str | None = None, template_landmarks: Path | None = None, mask: tuple[Path, ...] = (),
                  unit: Unit | Literal["unknown"] | None = None,
                  up: Literal["x", "-x", "y", "-y", "z", "-z"] | None = None, interactive: bool = False,
                  config: CompletionConfig = CompletionConfig(),  # noqa: B008
                  workers: Workers = Workers(), space: Workspace) -> Outcome:                    # noqa: B008
    """The whole body from a scan of some of it.

    Several scans are views of one body in one frame. A folder is completed scan by scan, each into a folder of its
    name; called again, it goes on where it was, and does anew what has changed.

    Example: scape complete half.ply -m model.npz --landmarks half.landmarks.json -o completed

    Args:
        scans: Mesh or point cloud, the views of one body, or a folder of scans; or one depth picture, a 16-bit PNG in
            millimetres with its camera beside it in NAME.camera.json.
        output: Folder to write completed.ply, predicted.ply, completion.npz and report.html to; completed.glb for a
            scan with a texture; layout.json where markers were clicked too.
        model: Model of `scape learn`; without it that of the synthetic people, which is made on first use.
        landmarks: 4 to 10 named points on the scan; else the file of the scan's name beside it. Without any the
            search starts from typical poses. For a folder of scans, the folder of such files. Names that are not the
            model's landmarks are markers that the person wears.
        subject: Whose body it is: "template" for the one the model's poses were learned from, betas in JSON or .npz,
            or a mesh in the model's triangles. Without it the shape is found too.
        template_landmarks: Where these landmarks are on the model's template; else those kept in the model.
        mask: Which points are clothing or hair: .npy, .json or .txt of booleans or of the numbers of points, or a
            mesh or cloud in which they are painted in a colour. One file, or one for each view; for a folder of
            scans, the folder of such files.
        unit: Unit of the scan and landmarks; "unknown": it is found together with the body.
        up: The axis of the scan that points up, where it is known: people mostly stand. Of a depth camera that stands
            upright it is -y, written --up=-y, of one upside down y.
        interactive: In the browser: click landmarks, complete, look at the body from all sides, correct, save. A scan
            can also be dropped on the page. A recording of markers, named or dropped, tells which ones to click.
        config: Settings.
        workers: Who completes the scans of a folder.
    """
    if not scans and not interactive:
        raise ValueError("SCAN: expected at least one scan, or a folder of scans")
    if unit == "unknown":
        config, unit = replace(config, free_scale=True), None
    if up is not None:
        config = replace(config, up=AXES[up])
    if interactive:
        return _in_browser(scans, output, model, subject, template_landmarks, unit, config)
    folder = scans[0] if len(scans) == 1 and scans[0].is_dir() else None
    found = folder_inputs(folder, landmarks, _only(mask)) if folder else {}
    loaded, name = read_model(model)
    body = _body(loaded, subject, unit)
    inputs = Inputs(scans, landmarks or landmarks_beside(scans[0]), mask)
    wanted = any(one.landmarks for one in found.values()) if folder else inputs.landmarks is not None
    marks = marks_of_template(loaded, template_landmarks, name) if wanted else {}
    work = Work(body, name, marks, config, unit, ColorConfig(fill=config.fill_colors))
    settings = {"complete": config, "model": name}
    if folder is None:
        if inputs.landmarks is None:
            say("note: no landmarks; the search starts from typical poses, look at report.html for limbs mixed up")
        with bar("completing") as progress:
            done = space.run(work, [Task("completion", inputs)], inside=progress).only
        return Outcome(output, done, settings, judgement=judgement_of(done))
    work = replace(work, command=f"scape complete {folder}")
    with bar("completing scans") as progress:
        results = space.run(work, [Task(name, one, name) for name, one in found.items()], workers, progress)
    with space.staging("page") as staged:
        folder_page(results.values, list(results.failures.values()), space.folder).write(staged.folder / "report.html")
    return Outcome(output, summary(results.values, len(results.fresh), len(found)), settings, failures_of(results))


def _in_browser(scans: tuple[Path, ...], output: Path, model: Path | None, subject: str | None,
                template_landmarks: Path | None, unit: Unit | None, config: CompletionConfig) -> Outcome:
    """Complete scans by hand in the browser."""
    from scanprep.viewer.server import serve

    from .interactive import CompleteApp
    from .worn import is_recording, labels_of

    loaded, name = read_model(model)
    marks = marks_of_template(loaded, template_landmarks, name)
    labels = [label for path in scans for label in labels_of(path)]
    scans = tuple(path for path in scans if not is_recording(path))
    files = [path for one in scans for path in ([task.scan for task in find_scans(one)] if one.is_dir() else [one])]
    app = CompleteApp(loaded, Work(_body(loaded, subject, unit), name, marks, config, unit), files, output, labels)
    serve(app)
    if not app.saved:
        return Outcome(None, [Metric("bodies saved", 0)], {"complete": config, "model": name})
    return Outcome(output, [Metric("bodies saved", len(app.saved)),
                            *(Metric(scan.name, app.made[scan].completion.judgement.verdict) for scan in app.saved)],
                   {"complete": config, "model": name})


def _body(model: BodyModel, subject: str | None, unit: Unit | None) -> BodyModel | Subject:
    """The model where the person's shape is to be found, else a body of known shape."""
    if subject is None and model.n_betas:
        return model
    return read_subject(model, None if subject in (None, "template") else Path(str(subject)), unit)


def _only(masks: tuple[Path, ...]) -> Path | None:
    if len(masks) > 1:
        raise ValueError(f"--mask: expected one folder of masks for a folder of scans, got {len(masks)}")
    return masks[0] if masks else None
