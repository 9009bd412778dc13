"""What a command prints: progress bars, notes, the closing table of figures; and `report.json`."""
from __future__ import annotations

import contextlib
import dataclasses
import importlib.metadata
import math
import os
import platform
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .words import printable

if TYPE_CHECKING:               # imported where used, so that help answers at once
    from .batch.workspace import Workspace
    from .judgement import Judgement

Progress = Callable[[int, int], None]
LOG_EVERY = 60.0            # seconds between lines of progress in a log file: a night's work stays readable


@dataclasses.dataclass(frozen=True)
class Metric:
    """One row of the closing table; a `detail` is shown only on the page and in report.json."""

    name: str
    value: float | int | str
    unit: str = ""
    detail: bool = False

    def text(self) -> str:
        """Format the value: three significant digits for a fraction, "none" where there is no value."""
        if isinstance(self.value, float) and not math.isfinite(self.value):
            return "none"
        if isinstance(self.value, float):
            return f"{self.value:.0f}" if abs(self.value) >= 1000 else f"{self.value:.3g}"
        return str(self.value)


@dataclasses.dataclass(frozen=True)
class Outcome:
    """The result of a command: where it wrote, its figures, and what failed on the way.

    `judgement` says how good the result is; the files are written in any case. It is None for commands that compute
    nothing, only show or record what the user does. `following` is the next step, in one sentence. `scans` are the
    judgements on the single scans of a set, by name, for report.json.
    """

    output: Path | None
    metrics: list[Metric]
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    failures: list[str] = dataclasses.field(default_factory=list)
    judgement: Judgement | None = dataclasses.field(kw_only=True)
    following: str = ""
    scans: Mapping[str, Judgement] = dataclasses.field(default_factory=dict)


def details(metrics: Iterable[Metric]) -> list[Metric]:
    """Return the same rows, shown only on the page and in report.json."""
    return [dataclasses.replace(m, detail=True) for m in metrics]


JUDGEMENT = "judgement"              # name of the row that says how good the result is


def judgement_row(judgement: Judgement) -> Metric:
    """Return the row of the closing table that says how good the result is."""
    return Metric(JUDGEMENT, str(judgement))


def judgement_of(metrics: Iterable[Metric]) -> Judgement | None:
    """Read the judgement from the rows of a result; None where they have none."""
    from .judgement import Judgement

    return next((Judgement.read(str(m.value)) for m in metrics if m.name == JUDGEMENT), None)


@contextlib.contextmanager
def bar(what: str) -> Iterator[Progress]:
    """Show a progress bar on standard error, from its first call on; yield the callback that moves it.

    Bars that are open at the same time are below each other. In a log file they are lines, one now and then.
    """
    from rich import progress
    from rich.console import Console

    if not Console(stderr=True).is_terminal:
        with _progress_lines(printable(what)) as report_progress:
            yield report_progress
        return
    with contextlib.ExitStack() as stack:
        if not _open_displays:
            columns = (progress.TextColumn("{task.description:<34}", markup=False), progress.BarColumn(),
                       progress.MofNCompleteColumn(), progress.TimeElapsedColumn(), progress.TextColumn("left"),
                       progress.TimeRemainingColumn())
            _open_displays.append(stack.enter_context(progress.Progress(*columns, console=Console(stderr=True))))
            stack.callback(_open_displays.pop)
        shown = _open_displays[-1]
        task = shown.add_task(printable(what), total=None, start=False, visible=False)

        def report_progress(done: int, total: int) -> None:
            shown.start_task(task)
            shown.update(task, completed=done, total=total, visible=True)

        yield report_progress


@contextlib.contextmanager
def _progress_lines(what: str) -> Iterator[Progress]:
    """Say how far the work is: when it begins, now and then, and when the block ends."""
    line, begun, last = "", 0.0, 0.0

    def report_progress(done: int, total: int) -> None:
        nonlocal line, begun, last
        now = time.monotonic()
        begun = begun or now
        line = f"{what}: {done} of {total} after {now - begun:.0f} s"
        if not last or now - last > LOG_EVERY:
            say(line)
            line, last = "", now

    try:
        yield report_progress
    finally:
        if line:
            say(line)


_open_displays: list[Any] = []       # the display that bars share, while one is open


def split_figures(metrics: Iterable[Metric]) -> tuple[list[Metric], list[Metric]]:
    """Split rows into those of the closing table, at most twelve, as many as one reads at a glance, and the rest."""
    metrics = list(metrics)
    main = [m for m in metrics if not m.detail][:12]
    return main, [m for m in metrics if m not in main]


def say(text: str) -> None:
    """Print a line on standard error."""
    sys.stderr.write(printable(text) + "\n")


def show(metrics: list[Metric]) -> None:
    """Print the closing table of figure, value and unit, and how many more figures there are."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table("figure", "value", "unit")
    table.columns[1].justify = "right"
    main, more = split_figures(metrics)
    for metric in main:          # as plain text: rich would read [brackets] in names as markup
        table.add_row(*(Text(printable(cell)) for cell in (metric.name, metric.text(), metric.unit)))
    if more:
        table.caption = f"{len(more)} more in report.json"
    Console().print(table)


def library_versions() -> dict[str, str]:
    """Return the versions of Python, the platform and the libraries that figures depend on."""
    versions = {"python": platform.python_version(), "machine": f"{platform.machine()}, {os.cpu_count()} cores"}
    for name in ("scapekit", "numpy", "scipy", "libigl", "cholespy", "embreex"):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[name] = importlib.metadata.version(name)
    return versions


def write_report(outcome: Outcome, command: str, seconds: float, notes: Sequence[str] = (),
                 written: Mapping[str, str] | None = None) -> Path | None:
    """Write `report.json` beside the output; return its path, or None without output.

    It holds command, settings, versions, figures, notes and the digests of all files written.
    """
    from .batch.ownership import report_path
    from .geometry import storage

    if outcome.output is None:
        return None
    path = report_path(outcome.output)
    storage.write_json(path, {
        "command": command, "seconds": round(seconds, 2), "versions": library_versions(),
        "settings": outcome.settings, "failures": outcome.failures, "notes": list(notes),
        "judgement": None if outcome.judgement is None else dataclasses.asdict(outcome.judgement),
        "metrics": [{"metric": m.name, "value": m.value, "unit": m.unit} for m in outcome.metrics],
        **({"scans": [{"name": name, **dataclasses.asdict(judgement)} for name, judgement in outcome.scans.items()]}
           if outcome.scans else {}),
        **({} if written is None else {"written": dict(written)})})
    return path


def keep_report(space: Workspace, outcome: Outcome, command: str, seconds: float, notes: Sequence[str] = ()) -> Path:
    """Write the report of an open output folder; return its path."""
    with space.staging("report") as staged:
        write_report(dataclasses.replace(outcome, output=staged.folder), command, seconds, notes)
    return space.folder / "report.json"
