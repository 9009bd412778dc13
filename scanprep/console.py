"""What a command tells: progress bars, notes, the closing table of its figures, and `report.json`."""
from __future__ import annotations

import contextlib
import dataclasses
import importlib.metadata
import math
import os
import platform
import sys
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:               # imported where it is used: help answers at once
    from .batch.workspace import Workspace
    from .judgement import Judgement

Progress = Callable[[int, int], None]



@dataclasses.dataclass(frozen=True)
class Metric:
    """One row of the closing table; a `detail` stands in the page and in report.json only."""

    name: str
    value: float | int | str
    unit: str = ""
    detail: bool = False

    def text(self) -> str:
        """The value as printed: three significant digits for a fraction, "none" where there is no value."""
        if isinstance(self.value, float) and not math.isfinite(self.value):
            return "none"
        if isinstance(self.value, float):
            return f"{self.value:.0f}" if abs(self.value) >= 1000 else f"{self.value:.3g}"
        return str(self.value)


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What a command did: where it wrote, the figures, and what failed on the way.

    `judgement` says what the result is worth; the files are there whatever it says. None is for commands that make
    none, and show or write down only what a user does. `following` is what to do next, in one sentence.
    """

    output: Path | None
    metrics: list[Metric]
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    failures: list[str] = dataclasses.field(default_factory=list)
    judgement: Judgement | None = dataclasses.field(kw_only=True)
    following: str = ""


def details(metrics: Iterable[Metric]) -> list[Metric]:
    """The same rows for the page and report.json only."""
    return [dataclasses.replace(m, detail=True) for m in metrics]


JUDGEMENT = "judgement"              # name of the row of figures that says what they are worth


def judgement_row(judgement: Judgement) -> Metric:
    """The row of the closing table that says what the result is worth."""
    return Metric(JUDGEMENT, str(judgement))


def judgement_of(metrics: Iterable[Metric]) -> Judgement | None:
    """What a result is worth, where its figures say so."""
    from .judgement import Judgement

    return next((Judgement.read(str(m.value)) for m in metrics if m.name == JUDGEMENT), None)


@contextlib.contextmanager
def bar(what: str) -> Iterator[Progress]:
    """A progress bar on standard error that appears with its first news; yields the callback that moves it.

    Bars that are open at the same time stand below each other.
    """
    from rich import progress
    from rich.console import Console

    with contextlib.ExitStack() as stack:
        if not _open_displays:
            columns = (progress.TextColumn("{task.description:<34}", markup=False), progress.BarColumn(),
                       progress.MofNCompleteColumn(), progress.TimeElapsedColumn(), progress.TextColumn("left"),
                       progress.TimeRemainingColumn())
            _open_displays.append(stack.enter_context(progress.Progress(*columns, console=Console(stderr=True))))
            stack.callback(_open_displays.pop)
        shown = _open_displays[-1]
        task = shown.add_task(visible(what), total=None, start=False, visible=False)

        def tell(done: int, total: int) -> None:
            shown.start_task(task)
            shown.update(task, completed=done, total=total, visible=True)

        yield tell


_open_displays: list[Any] = []


def visible(text: str) -> str:
    """Text fit for a terminal: characters that steer it, as names of files may hold, are written as `\\x1b`.

    Line breaks stay.
    """
    # categories that are no text: control, format (also what turns the direction), lone surrogates, separators
    return "".join(c if c == "\n" or unicodedata.category(c) not in {"Cc", "Cf", "Cs", "Zl", "Zp"} else
                   c.encode("unicode_escape", "surrogatepass").decode("ascii") for c in text)


def split_figures(metrics: Iterable[Metric]) -> tuple[list[Metric], list[Metric]]:
    """The rows that the closing table shows, in order and at most twelve, as are read at a glance, and the rest."""
    metrics = list(metrics)
    main = [m for m in metrics if not m.detail][:12]
    return main, [m for m in metrics if m not in main]


def say(text: str) -> None:
    """A line on standard error, for what a user should know while a command runs."""
    sys.stderr.write(visible(text) + "\n")


def show(metrics: list[Metric]) -> None:
    """Print the closing table of figure, value, unit: what comes first, and how many more there are."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table("figure", "value", "unit")
    table.columns[1].justify = "right"
    main, more = split_figures(metrics)
    for metric in main:          # as text: names may hold what rich takes for markup
        table.add_row(*(Text(visible(cell)) for cell in (metric.name, metric.text(), metric.unit)))
    if more:
        table.caption = f"{len(more)} more in report.json"
    Console().print(table)


def library_versions() -> dict[str, str]:
    """Versions of Python, the platform and the libraries the figures depend on."""
    found = {"python": platform.python_version(), "machine": f"{platform.machine()}, {os.cpu_count()} cores"}
    for name in ("scapekit", "numpy", "scipy", "libigl", "cholespy", "embreex"):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name)
    return found


def write_report(outcome: Outcome, command: str, seconds: float, notes: Sequence[str] = (),
                 written: Mapping[str, str] | None = None) -> Path | None:
    """Write `report.json` beside the output: command, settings, versions, figures, what was noticed on the way, and
    digests of all files written."""
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
        **({} if written is None else {"written": dict(written)})})
    return path


def keep_report(space: Workspace, outcome: Outcome, command: str, seconds: float, notes: Sequence[str] = ()) -> Path:
    """`write_report` for an output folder that is open; its path."""
    with space.staging("report") as staged:
        write_report(dataclasses.replace(outcome, output=staged.folder), command, seconds, notes)
    return space.folder / "report.json"
