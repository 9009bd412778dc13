"""The command `scape label`."""
from __future__ import annotations

from pathlib import Path
from typing import Annotated

from model.body import BodyModel
from scanprep.arguments import Place, UsageError
from scanprep.cli import Output, Unit
from scanprep.console import Metric, Outcome, bar
from scanprep.ranges import Positive

from ...cli import ModelOrNone, body_of, read_model
from ..files.markers import WRITTEN
from ..marker_sets.layout import MarkerLayout
from ..marker_sets.named import choose_layout, layout_names

MarkersArg = Annotated[Path, Place("MARKERS")]


def label_file(markers: MarkersArg, output: Output, model: ModelOrNone = None, layout: str | None = None,
               subject: str | None = None, people: int = 1, labels: Path | None = None,
               relabel: bool = False, unit: Unit | None = None, rate: Positive | None = None) -> Outcome:
    """Labels for markers without names: which point of every frame is which marker of a layout.

    Example: scape label raw.c3d --layout cmu41 -o labelled.c3d

    Points may be broken tracks (*12, U_1), or shuffled in every frame. The written recording has the markers of the
    layout first, then as *1, *2, ... all points that are none; a C3D keeps its analog channels, events and parameters.
    Beside it come labelled.labels.csv, the label of every track, and labelled.report.html, with what is unsure on top.

    To correct: change labels in the table, write yes into its column fixed, and run again with the table.

    Example: scape label raw.c3d --layout cmu41 --labels labelled.labels.csv -o labelled.c3d

    Then go on with scape mosh labelled.c3d --layout cmu41 -o out, or do both at once with scape mosh raw.c3d
    --unlabelled --layout cmu41 -o out.

    Args:
        markers: C3D, TRC, CSV or TSV of points.
        output: Recording to write, .c3d, .trc or .csv.
        model: Model of `scape learn`; without it that of the built-in people.
        layout: Which markers are worn: one of `scape layout list`, a JSON file, or a marker set of OpenSim (.xml).
        subject: Whose body it is, where that is known: betas in JSON or .npz, or a mesh in the model's triangles; the
            layout is then as worn. Without it the person is found from the points.
        people: How many people are in the recording; all wear the layout.
        labels: Table of labels with corrections.
        relabel: Labels of the recording are not believed. Else those of the layout are.
        unit: Unit of the points, where the file cannot tell.
        rate: Frames a second, where the file does not say or says it wrongly.
    """
    from .page import label_page
    from .recording import label_recording, read_unlabelled

    if output.suffix.lower() not in WRITTEN:
        raise UsageError(f"--output: expected a file ending in {', '.join(WRITTEN)}, got {output.name}")
    if people < 1:
        raise UsageError(f"--people: expected one at least, got {people}")
    points = read_unlabelled(markers, unit, rate)
    loaded, name = read_model(model)
    worn = layout_worn(loaded, layout, points.labels)
    body = body_of(loaded, subject, unit)
    with bar("labelling") as progress:
        found = label_recording(markers, points, body, worn, people, labels, relabel, progress)
    found.write(output)
    table = output.with_suffix(".labels.csv")
    found.write_table(table)
    metrics = [*found.metrics(), Metric("model", name), Metric("layout", layout or "by the labels that are there")]
    label_page(found, metrics, table.name).write(output.with_suffix(".report.html"))
    return Outcome(output, metrics, {"layout": layout, "people": people}, judgement=found.judgement,
                   following=f"open {output.with_suffix('.report.html')}")


def layout_worn(model: BodyModel, layout: str | None, labels: tuple[str, ...]) -> MarkerLayout:
    """The layout that is named, or the one that some labels of a recording tell."""
    if layout is not None:
        return choose_layout(model, layout, labels)[0]
    try:
        return choose_layout(model, None, labels)[0]
    except ValueError:
        raise UsageError(f"--layout: expected one, the recording has no labels of a marker set; one of "
                         f"{', '.join(layout_names())} (scape layout list), or a file") from None
