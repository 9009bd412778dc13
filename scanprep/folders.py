"""Commands that process many things, each into a folder of its own, with one page and report about all.

    OUTPUT/NAME/...               one of them: its files, its page, its report
    OUTPUT/report.html            all of them, worst first
    OUTPUT/.scapekit/run.json     the call of the command, where results can be corrected
"""
from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from .batch.calls import KeptCall
from .batch.pool import Workers
from .batch.workspace import HOME, Results, Task, Workspace
from .console import Metric, Outcome, bar, judgement_of
from .judgement import Judgement, judge_many
from .pictures.page import Page, link_to
from .pictures.scene import SCENE, worst_that_turn
from .pictures.sheets import small_picture
from .words import number_of

PAGE = "page"                        # name of the result that keeps the failures, with the page
PICTURE = "picture.png"              # picture of one thing, in its folder


@dataclass(frozen=True)
class FolderCommand:
    """How a command reports about the things that it processes.

    Attributes
    ----------
    things : tuple of str
        The singular, and the plural where it is not formed with s.
    title : str
        Title of the page; {} stands for the number of things.
    figures : callable
        Returns the rows of the closing table from the results and the number of things.
    error : callable
        Returns a number from the rows of one thing: the largest come first among equal verdicts.
    settings : mapping
        For the report.
    lines : callable, optional
        Returns what the page says of one thing, from its name and rows.
    hint : str
        What the page says about all.
    call : KeptCall, optional
        The call of the command, where results can be corrected.
    """

    things: tuple[str, ...]
    title: str
    figures: Callable[[Results, int], list[Metric]]
    error: Callable[[Sequence[Metric]], float]
    settings: Mapping[str, Any]
    lines: Callable[[str, Sequence[Metric]], Iterable[str]] = lambda name, rows: map(as_line, rows[:3])
    hint: str = ""
    call: KeptCall | None = None

    def carry_out(self, doing: str, space: Workspace, work: Any, tasks: Sequence[Task], workers: Workers) -> Outcome:
        """Process the things, with a progress bar, and write the page about all."""
        with bar(doing) as progress:
            results = space.run(work, tasks, workers, progress)
        return self.write(space, results, len(tasks))

    def write(self, space: Workspace, results: Results, count: int, failed: Sequence[str] = ()) -> Outcome:
        """Write the page and the call into an open output; return the outcome for `count` things.

        `failed` are lines about failures within results that exist.
        """
        outcome = self.outcome(space, results, count, failed)
        with space.staging(PAGE) as staged:
            self.page(results, outcome.failures, space.folder).write(staged.folder / "report.html")
            if self.call is not None:
                self.call.write(staged.folder / HOME)
            staged.value = results.failures
        return outcome

    def outcome(self, space: Workspace, results: Results, count: int, failed: Sequence[str] = ()) -> Outcome:
        """Return the outcome for `count` things."""
        judged = {name: judgement_of(rows) or Judgement() for name, rows in results.values.items()}
        worthless = [f"{name}: {one.why}" for name, one in judged.items() if one.problems]
        return Outcome(space.folder, self.figures(results, count), self.settings,
                       [*results.failures.values(), *worthless, *failed],
                       judgement=judge_many(judged, len(results.failures)))

    def page(self, results: Results, failures: Sequence[str], folder: Path) -> Page:
        """Build the page of all results, worst first, each with a link to its own page."""
        page = Page(self.title.format(number_of(len(results.values), *self.things)),
                    f"Worst first; each name leads to the page of its {self.things[0]}.").text(self.hint)
        if failures:
            page.section("Failed").table([(line,) for line in failures]).section("Results")
        names = self.worst_first(results, results.values)
        for name, scene in zip(names, worst_that_turn([folder / name / SCENE for name in names]), strict=True):
            picture = folder / name / PICTURE
            shown = "" if not picture.exists() else None if scene is None else \
                page.turning(scene, small_picture(picture), height=300)
            add_entry(page, name, self.lines(name, results.values[name]), shown)
        return page

    def worst_first(self, results: Results, names: Iterable[str]) -> list[str]:
        """Sort names: failures first, then by verdict and error, last what was not done yet."""
        def gravity(name: str) -> tuple[int, float, str]:
            """Return the sort key of one thing."""
            judgement = judgement_on(name, results)
            error = self.error(results.values[name]) if name in results.values else np.inf
            return (("failed", "check", "good", "new").index("new" if judgement is None else judgement.verdict),
                    -np.inf if np.isnan(error) else -error, name)

        return sorted(names, key=gravity)


def do_one(doing: str, space: Workspace, work: Any, task: Task, settings: Mapping[str, Any], following: str) -> Outcome:
    """Process one thing alone, directly into the output, where the work writes its page."""
    with bar(doing) as progress:
        rows = space.run(work, [task], inside=progress).only
    return Outcome(space.folder, rows, settings, judgement=judgement_of(rows), following=following)


def as_line(metric: Metric) -> str:
    """Return a figure as text."""
    return f"{metric.name}: {metric.text()} {metric.unit}"


def figure(rows: Sequence[Metric], *names: str) -> float:
    """Return the first figure with one of these names; 0 where there is none."""
    return next((float(m.value) for m in rows if m.name in names), 0.0)


def add_entry(page: Page, name: str, lines: Iterable[str], shown: str | None = None) -> None:
    """Add one result to the page, with a link to its own page; `shown` is HTML, by default its picture."""
    address = f"{link_to(name)}/report.html"
    text = "".join(f"<p>{escape(line)}</p>" for line in lines)
    if shown is None:
        shown = f'<a href="{address}"><img src="{link_to(name)}/{PICTURE}" alt="{escape(name)}"></a>'
    page.markup(f'<div class="entry"><div><a href="{address}"><b>{escape(name)}</b></a>{text}</div>{shown}</div>')


def load_results(space: Workspace, names: Sequence[str]) -> Results:
    """Load results by name from an output that need not be open."""
    kept = set(space.list_results(""))
    failures = (space.value(PAGE) if PAGE in kept else None) or {}
    values = {name: space.value(name) for name in names if name in kept}
    return Results(values, {name: line for name, line in failures.items() if name in names and name not in values}, ())


def judgement_on(name: str, results: Results) -> Judgement | None:
    """Return the judgement on one result; None for what was not done yet."""
    if name in results.failures:
        return Judgement("failed", (results.failures[name],))
    return judgement_of(results.values[name]) or Judgement() if name in results.values else None
