"""The command `scape label`."""
from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from shlex import quote
from typing import Annotated, Any

import numpy as np

from model.linear import Subject
from scanprep.arguments import Place, UsageError
from scanprep.batch.opening import AnyWorkspace
from scanprep.batch.pool import Workers
from scanprep.batch.room import TaskContext
from scanprep.batch.workspace import Results, Task
from scanprep.cli import Output, Unit
from scanprep.console import JUDGEMENT, Metric, Outcome, bar, judgement_of
from scanprep.folders import FolderCommand, as_line, do_one, figure
from scanprep.geometry.files import list_files
from scanprep.ranges import Positive

from ...cli import ModelOrNone, body_of, read_model
from ..files.markers import READERS, WRITTEN
from ..marker_sets.named import layout_or_file
from .work import DOUBTFUL, LABELLED_SHARE, LabelWork

MarkersArg = Annotated[Path, Place("MARKERS")]


def label_recordings(markers: MarkersArg, output: Output, model: ModelOrNone = None, layout: str | None = None,
                     subject: str | None = None, people: int = 1, labels: Path | None = None,
                     relabel: bool = False, unit: Unit | None = None, rate: Positive | None = None,
                     workers: Workers = Workers(), *, space: AnyWorkspace) -> Outcome:
    """Labels for markers without names: which point of every frame is which marker of a layout.

    Example: scape label raw.c3d --layout cmu41 -o labelled.c3d

    Points may be broken tracks (*12, U_1), or shuffled in every frame. The written recording has the markers of the
    layout first, then as *1, *2, ... all points that are none; a C3D keeps its analog channels, events and parameters.
    Beside it come labelled.labels.csv, the label of every track, and labelled.report.html, with what is unsure on top.
    Into a folder labelled.c3d, labels.csv and report.html are written; of a folder of recordings each into a folder of
    its name, and called again, the command goes on where it was.

    To correct: change labels in the table, write yes into its column fixed, and run again with the table.

    Example: scape label raw.c3d --layout cmu41 --labels labelled.labels.csv -o labelled.c3d

    Then go on with scape mosh labelled.c3d --layout cmu41 -o out, or do both at once with scape mosh raw.c3d
    --unlabelled --layout cmu41 -o out.

    Args:
        markers: C3D, TRC, CSV or TSV of points, or a folder of these.
        output: Recording to write, .c3d, .trc or .csv; or a folder.
        model: Model of `scape learn`; without it that of the built-in people.
        layout: Which markers are worn: one of `scape layout list`, a JSON file, or a marker set of OpenSim (.xml).
        subject: Whose body it is, where that is known: betas in JSON or .npz, or a mesh in the model's triangles; the
            layout is then as worn. Without it, or with "markers", the person is found from the points.
        people: How many people are in the recording; all wear the layout.
        labels: Table of labels with corrections.
        relabel: Labels of the recording are not believed. Else those of the layout are.
        unit: Unit of the points, where the file cannot tell.
        rate: Frames a second, where the file does not say or says it wrongly.
        workers: Who works through the files of a folder.
    """
    if people < 1:
        raise UsageError(f"--people: expected one at least, got {people}")
    if output.suffix and output.suffix.lower() not in WRITTEN:
        raise UsageError(f"--output: expected a file ending in {', '.join(WRITTEN)}, or a folder, got {output.name}")
    if markers.is_dir() and (output.suffix or labels is not None):
        raise UsageError(f"{markers}: of a folder of recordings a folder is written, without an ending, and a table of "
                         "--labels is that of one recording")
    loaded, name = read_model(model)
    body = loaded if subject == "markers" else body_of(loaded, subject, unit)
    # what all recordings share, then a folder of recordings, one recording into a folder, or into a file
    work = LabelWork(loaded, name, body if isinstance(body, Subject) else None,
                     None if layout is None else layout_or_file(layout), people, labels, relabel, unit, rate)
    settings = {"model": name, "layout": layout, "people": people, "relabel": relabel}
    if markers.is_dir():
        return _label_folder(markers, work, space, workers, settings)
    if not output.suffix:
        return do_one("labelling", space, work, Task("labels", markers), settings,
                      f"open {quote(str(output / 'report.html'))}")
    with bar("labelling") as report_progress:
        table, page = output.with_suffix(".labels.csv"), output.with_suffix(".report.html")
        metrics = work.write(markers, TaskContext(output.parent, report_progress=report_progress), output.name,
                             table.name, page.name)
    return Outcome(output, metrics, settings, judgement=judgement_of(metrics), following=f"open {quote(str(page))}")


def _label_folder(markers: Path, work: LabelWork, space: AnyWorkspace, workers: Workers, settings: Mapping[str, Any]
                  ) -> Outcome:
    """Label every recording of a folder into a folder of its name."""
    found = list_files(markers, lambda path: path.suffix.lower() in READERS, f"files ending in {', '.join(READERS)}")
    names = [path.stem for path in found]
    if twice := sorted({name for name in names if names.count(name) > 1}):      # written over each other
        raise ValueError(f"{markers}: expected files of different names, {twice[0]} comes with several endings")
    return FolderCommand(
        ("recording",), "{} labelled", _summary, lambda rows: figure(rows, DOUBTFUL), settings,
        lambda name, rows: [as_line(m) for m in rows if m.name in (JUDGEMENT, LABELLED_SHARE, DOUBTFUL)],
    ).carry_out("recordings", space, work, [Task(path.stem, path, path.stem) for path in found], workers)


def _summary(results: Results, count: int) -> list[Metric]:
    """Return the rows of the closing table."""
    rows = [Metric("recordings", count), Metric("done before", len(results.values) - len(results.fresh)),
            Metric("failed", len(results.failures))]
    for name in (LABELLED_SHARE, DOUBTFUL) if results.values else ():
        shares = [figure(metrics, name) for metrics in results.values.values()]
        rows.append(Metric(f"{name}, mean of the recordings", float(np.mean(shares)), "%"))
    return rows
