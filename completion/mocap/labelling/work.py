"""The work of `scape label` on one recording: read, label, write the recording, the table and the page."""
from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from model.body import BodyModel
from model.linear import Subject
from scanprep.batch.room import TaskContext
from scanprep.console import Metric

from ..files.markers import read_marker_points
from ..marker_sets.layout import MarkerLayout
from ..marker_sets.named import choose_layout, layout_names
from .labelled_file import LABELLED, TABLE
from .page import label_page
from .recording import DOUBTFUL, LABELLED_SHARE, label_recording

__all__ = ["DOUBTFUL", "LABELLED_SHARE", "LabelWork"]


@dataclass(frozen=True, eq=False)
class LabelWork:
    """Settings that all recordings of a call of `scape label` share."""

    model: BodyModel
    name: str                            # name of the model, for the output
    subject: Subject | None              # None: found from the points
    layout: str | Path | None            # a name or a file; None: the one that the recording's labels suggest
    people: int
    labels: Path | None                  # table of corrections
    relabel: bool
    unit: str | None
    rate: float | None

    def __call__(self, path: Path, context: TaskContext) -> list[Metric]:
        """Label a recording into the folder of a task; return the figures, the judgement first."""
        return self.write(path, context, LABELLED, TABLE, "report.html")

    def write(self, path: Path, context: TaskContext, recording: str, table: str, page: str) -> list[Metric]:
        """Label a recording, with given names of the three files."""
        points = read_marker_points(path, self.unit, self.rate)
        layout, name = self._layout(points.labels)
        found = label_recording(path, points, self.subject or self.model, layout, self.people, self.labels,
                                self.relabel, context.report_progress)
        metrics = [*found.metrics(), Metric("model", self.name), Metric("layout", name)]
        found.write(context.folder / recording)
        found.write_table(context.folder / table)
        label_page(found, metrics, table, f"run the same command with `--labels {table}`").write(context.folder / page)
        return metrics

    def _layout(self, labels: tuple[str, ...]) -> tuple[MarkerLayout, str]:
        """Return the named layout, or the one that labels of the recording suggest, and its name."""
        if self.layout is not None:
            return choose_layout(self.model, self.layout, ())
        bare = [label.rpartition(":")[2] for label in labels]
        try:
            return choose_layout(self.model, None, list(dict.fromkeys(bare)))
        except ValueError:
            raise ValueError(f"layout: expected one, the recording has no labels of a marker set; one of "
                             f"{', '.join(layout_names())} (scape layout list), or a file") from None
