"""Label a recording as a first, kept step of another command."""
from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from model.body import BodyModel
from model.linear import Subject
from scanprep.batch.room import TaskContext
from scanprep.judgement import Judgement
from scanprep.pictures.page import Page

from ..files.markers import MarkerSequence, read_marker_points, read_markers
from ..marker_sets.layout import MarkerLayout
from .page import label_page
from .recording import drop_unnamed, label_recording

LABELLED, TABLE, PAGE = "labelled.c3d", "labels.csv", "labels.html"


@dataclass(frozen=True)
class LabelledFile:
    """A labelled recording: its file and markers, the unit to read it with, and the judgement of its labels."""

    path: Path
    markers: MarkerSequence
    unit: str | None
    judgement: Judgement


def label_first(context: TaskContext, name: str, path: Path, model: BodyModel | Subject, layout: MarkerLayout,
                unit: str | None, rate: float | None) -> LabelledFile:
    """Label a recording into NAME/labelled.c3d in the folder of a task, with labels.csv and labels.html.

    This is a kept step, which is not repeated for the same input.
    """
    def make(folder: Path) -> str:
        found = label_recording(path, read_marker_points(path, unit, rate), model, layout,
                                progress=context.report_progress)
        place = folder / name
        place.mkdir(parents=True, exist_ok=True)
        found.write(place / LABELLED)
        found.write_table(place / TABLE)
        again = f"run `scape label {path.name} --labels {TABLE}`, with the same layout, and go on with what it writes"
        label_page(found, found.metrics(), TABLE, again).write(place / PAGE)
        return str(found.judgement)

    told = Judgement.read(context.files(f"labels {name}", (path, model, layout, unit, rate), make))
    if told.problems:
        raise ValueError(f"{path}: no labels that could be used: {told.why}; `scape label` shows them")
    labelled = context.folder / name / LABELLED
    return LabelledFile(labelled, read_labelled(labelled, path, unit, rate), _own_unit(path, unit), told)


def read_labelled(labelled: Path, source: Path, unit: str | None, rate: float | None) -> MarkerSequence:
    """Read the markers of a labelled C3D that was made from a source, without other points."""
    return drop_unnamed(read_markers(labelled, _own_unit(source, unit), None, rate))


def show_labels(page: Page) -> None:
    """Add a link to the page of the labels, in the same folder."""
    page.section("Labels", "The markers had no names. Which point is which marker was found first:")
    page.markup(f'<p><a href="{PAGE}">the labels, and where they are unsure</a></p>')


def _own_unit(source: Path, unit: str | None) -> str | None:
    """Return the unit for reading a labelled C3D: a copy of a C3D has the same unit, right or wrong."""
    return unit if source.suffix.lower() == ".c3d" else None
