"""A recording that is labelled before a command goes on with it: a step that is kept."""
from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from model.body import BodyModel
from model.linear import Subject
from scanprep.batch.room import Room
from scanprep.judgement import Judgement

from ..marker_sets.layout import MarkerLayout
from .page import label_page
from .recording import label_recording, read_unlabelled

LABELLED = "labelled.c3d"


@dataclass(frozen=True)
class LabelledFile:
    """A labelled recording that was written, how it is to be read, and what its labels are worth."""

    path: Path
    unit: str | None
    rate: float | None
    judgement: Judgement


def label_first(room: Room, name: str, path: Path, model: BodyModel | Subject, layout: MarkerLayout,
                  unit: str | None, rate: float | None) -> LabelledFile:
    """The recording with labels, NAME/labelled.c3d in the folder of a room.

    Beside it come labels.csv and labels.html. A step that is kept: what is done is not done again.
    """
    def make(folder: Path) -> str:
        found = label_recording(path, read_unlabelled(path, unit, rate), model, layout, progress=room.tell)
        place = folder / name
        place.mkdir(parents=True, exist_ok=True)
        found.write(place / LABELLED)
        found.write_table(place / "labels.csv")
        label_page(found, found.metrics(), "labels.csv").write(place / "labels.html")
        return str(found.judgement)

    told = Judgement.read(room.files(f"labels {name}", (path, model, layout, unit, rate), make))
    where = room.folder / name / LABELLED
    if told.problems:
        raise ValueError(f"{path}: no labels that could be used: {told.why}; look at {where.with_name('labels.html')}")
    # a C3D of a C3D says of itself what that one said, rightly or wrongly
    kept = path.suffix.lower() == ".c3d"
    return LabelledFile(where, unit if kept else None, rate if kept else None, told)
