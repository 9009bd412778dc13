"""A folder of scans for `scape complete`: what it was called with, its tasks, its page."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import ClassVar

import numpy as np

from model.body import BodyModel
from model.linear import Subject
from scanprep.arguments import UsageError
from scanprep.batch.calls import KeptCall
from scanprep.batch.workspace import HOME, Results, Task, Workspace
from scanprep.cli import Unit
from scanprep.console import Metric, Outcome, failures_of, judgement_of, judgement_of_many
from scanprep.geometry.files import name_of
from scanprep.pictures.page import Page, link_to
from scanprep.pictures.scene import SCENE, worst_that_turn
from scanprep.pictures.sheets import small_picture
from scanprep.pipeline.scans import find_scans
from scanprep.words import number_of

from ..cli import read_model
from .colors import ColorConfig
from .settings import CompletionConfig
from .work import EXPLAINED, MEANS, Inputs, Work, marks_of_template

GRAVEST = ("failed", "check", "good", "new")                          # verdicts, and what was not completed yet
PAGE = "page"                        # name of the result that keeps what failed, beside the page


@dataclass(frozen=True)
class FolderCall(KeptCall):
    """What `scape complete` was called with for a folder of scans."""

    command: ClassVar[str] = "scape complete"
    may_be_files: ClassVar[tuple[str, ...]] = ("subject",)
    scans: Path
    model: Path | None = None
    landmarks: Path | None = None
    subject: str | None = None
    template_landmarks: Path | None = None
    masks: Path | None = None
    unit: Unit | None = None
    config: CompletionConfig = field(default_factory=CompletionConfig)

    def tasks(self) -> dict[str, Task]:
        """The scans as they are now, by name."""
        found = folder_inputs(self.scans, self.landmarks, self.masks)
        return {name: Task(name, inputs, name) for name, inputs in found.items()}

    def work(self, wanted: bool) -> tuple[BodyModel, Work]:
        """The model, and the work on each scan; `wanted`: landmarks of the template must be known."""
        loaded, name = read_model(self.model)
        marks = marks_of_template(loaded, self.template_landmarks, name, wanted)
        return loaded, Work(body_of(loaded, self.subject, self.unit), name, marks, self.config, self.unit,
                            ColorConfig(fill=self.config.fill_colors), f"scape complete {self.scans}")


def body_of(model: BodyModel, subject: str | None, unit: Unit | None) -> BodyModel | Subject:
    """The model where the person's shape is to be found, else a body of known shape."""
    if subject is None and model.n_betas:
        return model
    from model.posing.cli import read_subject  # with all that makes models

    return read_subject(model, None if subject in (None, "template") else Path(str(subject)), unit)


def folder_inputs(folder: Path, landmarks: Path | None, masks: Path | None) -> dict[str, Inputs]:
    """The scans of a folder by name, with their landmarks, in their folder or its own, and masks of their names."""
    if masks is not None and not masks.is_dir():
        raise UsageError(f"--mask: expected a folder of masks for a folder of scans, there is none at {masks}")
    found = {}
    for task in find_scans(folder, landmarks):
        mine = sorted(p for p in masks.iterdir() if name_of(p) == task.name) if masks else []
        found[task.name] = Inputs((task.scan,), task.landmarks, tuple(mine[:1]))
    return found


def written(call: FolderCall, model: str, results: Results, space: Workspace, count: int) -> Outcome:
    """The page of what became of so many scans into a folder that is open, and what was called there."""
    with space.staging(PAGE) as staged:
        folder_page(results.values, list(results.failures.values()), space.folder, call).write(
            staged.folder / "report.html")
        call.write(staged.folder / HOME)
        staged.value = results.failures
    return told(call, model, results, space, count)


def told(call: FolderCall, model: str, results: Results, space: Workspace, count: int) -> Outcome:
    """The figures of so many scans; `model` is its name."""
    return Outcome(space.folder, summary(results.values, len(results.fresh), count),
                   {"complete": call.config, "model": model}, failures_of(results),
                   judgement=judgement_of_many(results))


def kept_results(space: Workspace, names: Sequence[str]) -> Results:
    """What is known of scans by their names, from a folder that need not be open."""
    kept = set(space.kept(""))
    failures = (space.value(PAGE) if PAGE in kept else None) or {}
    values = {name: space.value(name) for name in names if name in kept}
    return Results(values, {name: line for name, line in failures.items() if name in names and name not in values}, ())


def summary(metrics: Mapping[str, Sequence[Metric]], fresh: int, count: int) -> list[Metric]:
    """The rows of the closing table."""
    rows = [Metric("scans completed", f"{len(metrics)} of {count}"), Metric("of them in this run", fresh)]
    for name in MEANS:
        found = [m for of_one in metrics.values() for m in of_one if m.name == name]
        if found:
            rows.append(Metric(f"{name}, mean", float(np.mean([float(m.value) for m in found])), found[0].unit))
    return rows


def folder_page(metrics: Mapping[str, Sequence[Metric]], failures: Sequence[str], folder: Path, call: FolderCall
                ) -> Page:
    """The page of all scans, worst first; what is told of them lies in the folder."""
    page = Page(f"{number_of(len(metrics), 'scan')} completed", "Worst first; each name leads to the page of its scan.")
    page.text("To mend some, run the same command with --interactive: it opens these results in the browser, worst "
              f"first (scape complete {call.scans} ... -o {folder} --interactive).")
    if failures:
        page.section("Failed").table([(line,) for line in failures])
    names = sorted(metrics, key=lambda name: gravity(metrics[name]))
    turning = worst_that_turn([folder / name / SCENE for name in names])
    for name, scene in zip(names, turning, strict=True):
        told = "".join(f"<p>{escape(f'{m.name}: {m.text()} {m.unit}')}</p>" for m in metrics[name][:3])
        shown = f'<img src="{link_to(name)}/picture.png" alt="{escape(name)}, completed">' if scene is None else \
            page.turning(scene, small_picture(folder / name / "picture.png"), height=300)
        title = f'<a href="{link_to(name)}/report.html"><b>{escape(name)}</b></a>'
        page.markup(f'<div class="entry"><div>{title}{told}</div>{shown}</div>')
    return page


def gravity(metrics: Sequence[Metric]) -> tuple[int, float]:
    """By which scans are sorted: failed ones first, and among equals those whose points the body explains worst."""
    judgement = judgement_of(metrics)
    explained = next((float(m.value) for m in metrics if m.name == EXPLAINED), 0.0)
    return GRAVEST.index("new" if judgement is None else judgement.verdict), explained
