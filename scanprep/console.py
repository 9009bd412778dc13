"""What every command shares: progress bars, the closing table, `report.json`, one-line errors, exit codes.

Together with the `cli.py` files this is the only place that writes to the terminal.
"""
from __future__ import annotations

import argparse
import contextlib
import dataclasses
import importlib
import importlib.metadata
import inspect
import math
import os
import platform
import sys
import time
import typing
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from . import config_files, ranges
from .threads import one_thread

if TYPE_CHECKING:               # imported where it is used: help answers at once
    from .batch.workspace import Results

Progress = Callable[[int, int], None]

OUTPUTS, SPACE, FORCE = ("output", "out"), "space", "force"     # parameters of commands that are dealt with here
FORCE_HELP = "\n    force: Do all anew, whatever is done already."
CONFIG_HELP = """
    config: TOML file with settings that have no flag.
    write_config: Print such a file, with the values in force and what each setting means, and do nothing else."""
PRESET_HELP = "\n    preset: Where settings begin: ours, or the values of the paper."
WRITE_CONFIG = "--write-config"
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


PROBLEM = "problem"                  # name of the row of figures that says why they mean nothing


def problem_of(metrics: Iterable[Metric]) -> str | None:
    """Why a result means nothing, where its figures say so."""
    return next((str(m.value) for m in metrics if m.name == PROBLEM), None)


def failures_of(results: Results) -> list[str]:
    """One line a task that failed, or of which the result means nothing."""
    told = {name: f"{name}: {problem}" for name, rows in results.values.items() if (problem := problem_of(rows))}
    return [*results.failures.values(), *told.values()]


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


def write_report(outcome: Outcome, command: str, seconds: float, written: Mapping[str, str] | None = None
                 ) -> Path | None:
    """Write `report.json` beside the output: command, settings, versions, figures, digests of all files written."""
    from .batch.ownership import report_path
    from .geometry import storage

    if outcome.output is None:
        return None
    path = report_path(outcome.output)
    storage.write_json(path, {
        "command": command, "seconds": round(seconds, 2), "versions": versions(),
        "settings": plain(outcome.settings), "failures": outcome.failures, "problem": outcome.problem,
        "metrics": [{"metric": m.name, "value": plain(m.value), "unit": m.unit} for m in outcome.metrics],
        **({} if written is None else {"written": dict(written)})})
    return path


def run(function: Callable[..., Outcome], prog: str, argv: list[str]) -> int:
    """Read the command line for `function`, run it, print its table; returns the exit code.

    The signature of the function is the command line: names, types, defaults and the docstring.
    0: done; 1: failed, with one line that says why; 2: wrong usage.

    A function with a parameter `space: Workspace` works in its output folder and goes on there where it was
    interrupted. All others write to a folder of their own, from which the output takes its place when it is whole.
    """
    start, wrong, call = time.perf_counter(), 2, None
    with _notes(prog), one_thread():
        try:
            if (text := settings_file(function, argv)) is not None:
                sys.stdout.write(text + "\n")
                return 0
            call = _Call(function, prog, argv)
            wrong = 1
            outcome, report = call.carried_out(start)
        except KeyboardInterrupt:
            goes_on = call is not None and call.wants_space
            say(f"{prog}: interrupted; " + ("the same command goes on where it stopped" if goes_on else
                                            "nothing was written"))
            return 130
        except Exception as error:
            if os.environ.get(TRACEBACK):
                raise
            told = _told(error)
            say(f"{prog}: {told if call is None else call.real(told)}")
            return wrong
    if outcome.problem:
        say(f"{prog}: THE RESULT MEANS NOTHING: {outcome.problem}")
    show([*(m for m in outcome.metrics if m.name != PROBLEM), Metric("time", time.perf_counter() - start, "s")])
    if outcome.output is not None:
        say(call.real(f"written: {outcome.output}" + (f" (figures in {report})" if report else "")))
    for failure in outcome.failures:
        say(call.real(f"{prog}: failed: {failure}"))
    return 1 if outcome.failures or outcome.problem else 0


def settings_file(function: Callable[..., Outcome], argv: list[str]) -> str | None:
    """The file of settings that `--write-config` asks for, or None where it does not."""
    found = {p.name: p.default for p in inspect.signature(function).parameters.values()
             if isinstance(p.default, ranges.Settings)}
    return config_files.write(_Settings(found, argv).values) if found and WRITE_CONFIG in argv else None


class _Settings:
    """The settings of a command: marked fields are flags, all others come from a file."""

    def __init__(self, values: dict[str, ranges.Settings], argv: list[str]) -> None:
        early = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
        early.add_argument("--config", type=Path)
        early.add_argument("--preset", default="default")
        self.presets = hasattr(values.get("config"), "published")     # of the command's own method
        self.values = values
        if not values or {"-h", "--help"} & {*argv}:
            return
        with contextlib.suppress(argparse.ArgumentError):               # said by the parser of the whole line
            given = early.parse_known_args(argv)[0]
            if self.presets and given.preset == "published":
                self.values = {name: getattr(value, "published", lambda value=value: value)()
                               for name, value in values.items()}
            if given.config is not None:
                self.values = config_files.read(given.config, self.values)

    def parameters(self) -> list[inspect.Parameter]:
        """The flags of the command line."""
        def keyword(name: str, default: Any, annotation: Any) -> inspect.Parameter:
            return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)

        if not self.values:
            return []
        shown = [keyword(name, flag.value, flag.annotation) for name, flag in config_files.flags(self.values).items()]
        if self.presets:
            shown.append(keyword("preset", "default", typing.Literal["default", "published"]))
        return [*shown, keyword("config", None, Path | None), keyword("write_config", False, bool)]

    def help(self) -> str:
        """What the docstring of the command says of them."""
        if not self.values:
            return ""
        told = "".join(f"\n    {name}: {flag.sentence}" for name, flag in config_files.flags(self.values).items())
        return told + (PRESET_HELP if self.presets else "") + CONFIG_HELP

    def taken_from(self, given: dict[str, Any]) -> dict[str, Any]:
        """The arguments of the command's function: settings in place of flags."""
        values = dict(self.values)
        for name, flag in (config_files.flags(values) if values else {}).items():
            first, *rest = flag.path
            values[first] = config_files.replaced(values[first], tuple(rest), given.pop(name))
        for name in ("preset", "config", "write_config"):
            if values:
                given.pop(name, None)
        return {**given, **values}


class _Call:
    """A function with what the command line gives it."""

    def __init__(self, function: Callable[..., Outcome], prog: str, argv: list[str]) -> None:
        import tyro

        self.function, self.command = function, f"{prog} {' '.join(argv)}"
        hints = typing.get_type_hints(function, include_extras=True)
        parameters = inspect.signature(function).parameters.values()
        self.wants_space = any(p.name == SPACE for p in parameters)
        self.settings = _Settings({p.name: p.default for p in parameters if isinstance(p.default, ranges.Settings)},
                                  argv)
        shown = [p.replace(annotation=hints[p.name]) for p in parameters
                 if p.name != SPACE and p.name not in self.settings.values]
        self.output_name = next((p.name for p in shown if p.name in OUTPUTS), None)
        self.beside = self.wants_space and typing.get_origin(hints[SPACE]) is not None      # Annotated: FileWorkspace
        shown = [*shown, *self.settings.parameters()]
        if self.output_name is not None:
            shown.append(inspect.Parameter(FORCE, inspect.Parameter.KEYWORD_ONLY, default=False, annotation=bool))
        signature = inspect.Signature(shown)

        def collect(*args: Any, **named: Any) -> dict[str, Any]:
            given = signature.bind(*args, **named)
            given.apply_defaults()
            return given.arguments

        collect.__doc__ = (inspect.getdoc(function) or "") + self.settings.help() + (
            FORCE_HELP if self.output_name else "")
        collect.__annotations__ = {p.name: p.annotation for p in shown}
        collect.__signature__ = signature                            # type: ignore[attr-defined]
        self.given = self.settings.taken_from(
            ranges.read(collect, lambda read: tyro.cli(read, args=argv, prog=prog))())
        self.force = self.given.pop(FORCE, False)
        self.output: Path | None = self.given.get(self.output_name or "")
        self._staged: Path | None = None

    def real(self, text: str) -> str:
        """A message with the path of the output for that of the folder in which it was made."""
        staged, output = self._staged, self.output
        return text if staged is None or output is None else text.replace(str(staged), str(output.parent))

    def carried_out(self, start: float) -> tuple[Outcome, Path | None]:
        """What the function did, and where its report is."""
        from .batch.opening import beside, workspace

        if self.output is None:
            return self.function(**self.given), None
        if self.wants_space and not self.beside:
            with workspace(self.output, self.force) as space:
                outcome = self.function(**self.given, space=space)
                with space.staging("report") as staged:
                    report = write_report(dataclasses.replace(outcome, output=staged.folder), self.command,
                                          time.perf_counter() - start)
                return outcome, None if report is None else self.output / report.name
        with beside(self.output, self.force) as space, space.staging("output") as staged:
            self._staged = staged.folder
            given = {**self.given, str(self.output_name): staged.folder / self.output.name}
            outcome = self.function(**given, **({SPACE: space} if self.wants_space else {}))
            made = outcome.output or staged.folder / self.output.name
            top = made if made.is_dir() else made.parent
            written = {p.relative_to(top).as_posix(): space.digests.of_file(p) for p in sorted(top.rglob("*"))
                       if p.is_file()}
            return outcome, write_report(outcome, self.command, time.perf_counter() - start, written)


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
    """Hand the arguments on to the command named first; `commands` is name -> (one line of help, "module:function").

    A module is imported when its command is called, so that help answers at once. A function called `group` has
    commands of its own.
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
