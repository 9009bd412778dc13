"""`scape complete` on a folder of scans: its arguments, its tasks, its page."""
from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from model.body import BodyModel
from scanprep.arguments import UsageError
from scanprep.batch.pool import Workers
from scanprep.batch.workspace import Results, Task, Workspace
from scanprep.cli import Unit
from scanprep.console import Metric, Outcome
from scanprep.folders import FolderCommand, figure
from scanprep.geometry.files import name_of
from scanprep.pipeline.scans import find_scans

from ..cli import body_of, marks_of_template, read_model
from .settings import CompletionConfig
from .work import EXPLAINED, MEANS, CompletionInputs, CompletionTask


@dataclass(frozen=True)
class FolderCall:
    """The arguments of `scape complete` for a folder of scans."""

    scans: Path
    model: Path | None = None
    landmarks: Path | None = None
    subject: str | None = None
    template_landmarks: Path | None = None
    masks: Path | None = None
    unit: Unit | None = None
    config: CompletionConfig = field(default_factory=CompletionConfig)

    def tasks(self) -> dict[str, Task]:
        """Return a task for each scan that is there now, by name, with its landmarks and mask."""
        if self.masks is not None and not self.masks.is_dir():
            raise UsageError("--mask: expected a folder of masks for a folder of scans, there is none at "
                             f"{self.masks}")
        masks = {name_of(path): path for path in sorted(self.masks.iterdir(), reverse=True)} if self.masks else {}
        return {scan.name: Task(scan.name, CompletionInputs((scan.scan,), scan.landmarks, tuple(
            masks[name] for name in [scan.name] if name in masks)), scan.name)
                for scan in find_scans(self.scans, self.landmarks)}

    def work(self, wanted: bool) -> tuple[BodyModel, CompletionTask]:
        """Load the model and the shared settings; `wanted`: landmarks of the template must be known."""
        loaded, name = read_model(self.model)
        marks = marks_of_template(loaded, self.template_landmarks, name, wanted)
        return loaded, CompletionTask(body_of(loaded, self.subject, self.unit), name, marks, self.config, self.unit,
                                      f"scape complete {self.scans}")

    def carry_out(self, space: Workspace, workers: Workers) -> Outcome:
        """Complete the scans of the folder."""
        tasks = list(self.tasks().values())
        _, work = self.work(any(task.given.landmarks for task in tasks))
        return self.description(space.folder, work.model).carry_out("completing scans", space, work, tasks, workers)

    def description(self, output: Path, model: str) -> FolderCommand:
        """Return the wording of table and page for an output; `model` is the model's name."""
        return FolderCommand(
            ("scan",), "{} completed", summary, lambda rows: -figure(rows, EXPLAINED),
            {"complete": self.config, "model": model},
            hint="To mend some, run the same command with --interactive: it opens these results in the browser, worst "
            f"first (scape complete {self.scans} ... -o {output} --interactive).")


def summary(results: Results, count: int) -> list[Metric]:
    """Return the rows of the closing table: counts, and means over the scans."""
    rows = [Metric("scans completed", f"{len(results.values)} of {count}"),
            Metric("of them in this run", len(results.fresh))]
    for name in MEANS:
        found = [m for of_one in results.values.values() for m in of_one if m.name == name]
        if found:
            rows.append(Metric(f"{name}, mean", float(np.mean([float(m.value) for m in found])), found[0].unit))
    return rows
