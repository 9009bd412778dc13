"""What every command shares: progress bars, the closing table, `report.json`, one-line errors, exit codes.

Together with the `cli.py` files this is the only place that writes to the terminal.
"""
from __future__ import annotations

import contextlib
import dataclasses
import importlib
import importlib.metadata
import json
import math
import os
import platform
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from . import ranges

Progress = Callable[[int, int], None]

TRACEBACK = "SCAPEKIT_TRACEBACK"       # environment variable that shows where an error came from
LIBRARIES = ("scapekit", "numpy", "scipy", "libigl", "cholespy", "embreex")


@dataclasses.dataclass(frozen=True)
class Metric:
    """One row of the closing table."""

    name: str
    value: float | int | str
    unit: str = ""

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

    `problem` says in one line why the result means nothing, with the likely cause; the files are there all the same.
    """

    output: Path | None
    metrics: list[Metric]
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    failures: list[str] = dataclasses.field(default_factory=list)
    problem: str | None = None


@contextlib.contextmanager
def bar(what: str) -> Iterator[Progress]:
    """A progress bar on standard error that appears with its first news; yields the callback that moves it.

    Bars that are open at the same time stand below each other.
    """
    with _display() as shown:
        task = shown.add_task(what, total=None, start=False, visible=False)

        def tell(done: int, total: int) -> None:
            shown.start_task(task)
            shown.update(task, completed=done, total=total, visible=True)

        yield tell


_open_displays: list[Any] = []


@contextlib.contextmanager
def _display() -> Iterator[Any]:
    """The display of the bars that are open now, or a new one."""
    from rich import progress
    from rich.console import Console

    if _open_displays:
        yield _open_displays[-1]
        return
    columns = (progress.TextColumn("{task.description:<34}"), progress.BarColumn(), progress.MofNCompleteColumn(),
               progress.TimeElapsedColumn(), progress.TextColumn("left"), progress.TimeRemainingColumn())
    with progress.Progress(*columns, console=Console(stderr=True)) as shown:
        _open_displays.append(shown)
        try:
            yield shown
        finally:
            _open_displays.pop()


def say(text: str) -> None:
    """One line on standard error, for what a user should know while a command runs."""
    sys.stderr.write(text + "\n")


def show(metrics: list[Metric]) -> None:
    """Print the closing table of metric, value, unit."""
    from rich.console import Console
    from rich.table import Table

    table = Table("metric", "value", "unit")
    table.columns[1].justify = "right"
    for metric in metrics:
        table.add_row(metric.name, metric.text(), metric.unit)
    Console().print(table)


def versions() -> dict[str, str]:
    """Versions of Python, the platform and the libraries the figures depend on."""
    found = {"python": platform.python_version(), "machine": f"{platform.machine()}, {os.cpu_count()} cores"}
    for name in LIBRARIES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name)
    return found


def plain(value: Any) -> Any:
    """Settings and figures as JSON can hold them."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if isinstance(value, np.generic | np.ndarray):
        return plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None                         # JSON has no NaN
    return str(value) if isinstance(value, Path) else value


def write_report(outcome: Outcome, command: str, seconds: float) -> Path | None:
    """`report.json` beside the output: command, settings, versions and the numbers of the closing table."""
    from .geometry import storage

    if outcome.output is None:
        return None
    is_folder = outcome.output.is_dir()
    path = outcome.output / "report.json" if is_folder else outcome.output.with_suffix(".report.json")
    storage.write_json(path, {
        "command": command, "seconds": round(seconds, 2), "versions": versions(),
        "settings": plain(outcome.settings), "failures": outcome.failures, "problem": outcome.problem,
        "metrics": [{"metric": m.name, "value": plain(m.value), "unit": m.unit} for m in outcome.metrics]})
    return path


def run(function: Callable[..., Outcome], prog: str, argv: list[str]) -> int:
    """Read the command line for `function`, run it, print its table; returns the exit code.

    The signature of the function is the command line: names, types, defaults and the docstring.
    0: done; 1: failed, with one line that says why; 2: wrong usage.
    """
    import tyro

    start, wrong = time.perf_counter(), 2
    with _notes(prog):
        try:
            work = ranges.read(function, lambda read: tyro.cli(read, args=argv, prog=prog))
            wrong = 1
            outcome = work()
            report = write_report(outcome, f"{prog} {' '.join(argv)}", time.perf_counter() - start)
        except KeyboardInterrupt:
            say(f"{prog}: interrupted; the same command goes on where it stopped")
            return 130
        except Exception as error:
            if os.environ.get(TRACEBACK):
                raise
            say(f"{prog}: {_told(error)}")
            return wrong
    if outcome.problem:
        say(f"{prog}: THE RESULT MEANS NOTHING: {outcome.problem}")
    show([*outcome.metrics, Metric("time", time.perf_counter() - start, "s")])
    if outcome.output is not None:
        say(f"written: {outcome.output}" + (f" (figures in {report})" if report else ""))
    for failure in outcome.failures:
        say(f"{prog}: failed: {failure}")
    return 1 if outcome.failures or outcome.problem else 0


@contextlib.contextmanager
def _notes(prog: str) -> Iterator[None]:
    """Our own warnings as one line each; those of libraries are for their users, not for ours."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.filterwarnings("always", category=UserWarning, module=r"(scanprep|model|completion)(\.|$)")
        warnings.showwarning = lambda message, *_rest, **_named: say(f"{prog}: note: {message}")
        yield


def _told(error: Exception) -> str:
    """One line for what went wrong; with the way to the traceback where nobody foresaw it."""
    text = " ".join(str(error).split())
    if isinstance(error, ValueError | OSError | ModuleNotFoundError):
        return text
    return f"unforeseen {type(error).__name__}: {text} (this is a fault of scapekit; {TRACEBACK}=1 shows where)"


def dispatch(commands: Mapping[str, tuple[str, str]], prog: str, argv: list[str], lead: str) -> int:
    """Hand the arguments on to the command named first.

    Parameters
    ----------
    commands : name -> (one line of help, "module:function")
        The module is imported when its command is called, so that help answers at once. A function that
        takes `argv` alone is a group of commands of its own.
    """
    if not argv or argv[0] in ("-h", "--help"):
        width = max(map(len, commands))
        listing = "\n".join(f"  {name:<{width}}  {text}" for name, (text, _) in commands.items())
        sys.stdout.write(f"usage: {prog} COMMAND ...\n\n{lead}\n\n{listing}\n\n"
                         f"`{prog} COMMAND --help` tells the rest.\n")
        return 0 if argv else 2
    if argv[0] not in commands:
        say(f"{prog}: no command '{argv[0]}'; there are: {', '.join(commands)}")
        return 2
    module, function = commands[argv[0]][1].split(":")
    target = getattr(importlib.import_module(module), function)
    if function == "group":
        return target(argv[1:])
    return run(target, f"{prog} {argv[0]}", argv[1:])


def read_json(path: Path, what: str) -> Any:
    """A JSON file, or ValueError naming it and what was expected."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ValueError(f"{path}: no such file, expected {what}") from None
    except ValueError as error:
        raise ValueError(f"{path}: expected {what} in JSON, cannot read it ({error})") from None
