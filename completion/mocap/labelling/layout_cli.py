"""The command `scape layout find`."""
from __future__ import annotations

from pathlib import Path
from shlex import quote
from typing import Annotated

from model.fitting.bodies import at_rest
from scanprep.arguments import Place
from scanprep.cli import MM, Output, Unit
from scanprep.console import Metric, Outcome, bar, judgement_row
from scanprep.pictures.page import Page
from scanprep.ranges import Positive

from ...cli import ModelOrNone, read_model

MarkersArg = Annotated[Path, Place("MARKERS")]


def find_in_recording(markers: MarkersArg, output: Output, model: ModelOrNone = None, unit: Unit | None = None,
                      rate: Positive | None = None) -> Outcome:
    """The marker layout of a recording: where on the body each of its tracks sits, and what it may be called.

    Example: scape layout find raw.c3d -o mine.layout.json

    One person has to move in the recording, and each marker to have a track of its own for a third of it at least; a
    marker with several tracks is joined. Names are those of the usual set that explains the markers, else of parts of
    the body. Beside the layout come a page, and a picture of it. It takes one to two minutes.

    Then: scape label raw.c3d --layout mine.layout.json -o labelled.c3d

    Args:
        markers: C3D, TRC, CSV or TSV of tracks.
        output: Layout file to write.
        model: Model of `scape learn`; without it that of the built-in people.
        unit: Unit of the markers, where the file cannot tell.
        rate: Frames a second, where the file does not say or says it wrongly.
    """
    from scanprep.pictures.shading import save_png

    from ..files.markers import read_marker_points
    from ..marker_sets.pictures import picture_layout
    from .unknown_layout import find_layout

    points = read_marker_points(markers, unit, rate)
    loaded, name = read_model(model)
    with bar("finding the layout") as progress:
        found = find_layout(loaded, points, progress)
    found.layout.save(output)
    picture = picture_layout(at_rest(loaded), found.layout)
    save_png(output.with_suffix(".png"), picture)
    metrics = [judgement_row(found.judgement), Metric("markers", len(found.layout.labels)),
               Metric("markers to the body", MM * found.person.residual, "mm"),
               Metric("expected distance from the true place, mean", MM * float(found.uncertainty.mean()), "mm"),
               Metric("what the next best body leaves, over this", found.margin), Metric("model", name)]
    page = Page(f"{markers.name}: its marker layout", "Where on the body each track sits.").verdict(found.judgement)
    page.picture(picture, "the layout on the mean person, from four sides")
    page.section("Markers").table(
        [(label, ", ".join(found.tracks[label]), MM * float(off)) for label, off
         in zip(found.layout.labels, found.uncertainty, strict=True)], ("name", "tracks", "uncertain by (mm)"))
    if found.left_out:
        page.section("Left out").table(list(found.left_out.items()), ("track", "why"))
    page.section("Figures").figures(metrics).write(output.with_suffix(".report.html"))
    return Outcome(output, metrics, {"model": name}, judgement=found.judgement,
                   following=f"look at {quote(str(output.with_suffix('.png')))}; "
                   f"then scape label --layout {quote(str(output))}")
