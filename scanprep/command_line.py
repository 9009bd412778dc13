"""From a function to a command: its signature is the command line; `run` handles errors and exit codes."""
from __future__ import annotations

import argparse
import contextlib
import dataclasses
import importlib
import inspect
import os
import re
import sys
import time
import typing
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from shlex import quote
from typing import Any

from . import config_files, ranges
from .arguments import Argument, UsageError, command_sentences, near, read_line
from .config_files import Flag
from .console import JUDGEMENT, Metric, Outcome, keep_report, say, show, write_report
from .interrupts import terminate_as_interrupt, tidy_up
from .threads import one_thread
from .words import OUR_MODULES, explain_os_error

SPACE, FORCE = "space", "force"        # parameters that every command handles the same way
TRACEBACK = "SCAPEKIT_TRACEBACK"       # environment variable that shows the traceback of an error


def run(function: Callable[..., Outcome], prog: str, argv: list[str]) -> int:
    """Read the command line for a function, run it, print its table; return the exit code.

    The signature of the function is the command line: names, types, defaults and docstring. Exit codes are 0: done,
    perhaps with doubts; 1: failed, with one line that says why; 2: wrong usage; 130: interrupted.

    A function with a parameter `space: Workspace` works in its output folder and resumes there after an interruption.
    All others write to a temporary folder, from which the finished output is moved to its place.
    """
    start, exit_code, call = time.perf_counter(), 2, None
    with _notes(prog) as (spelled, notes), one_thread(), terminate_as_interrupt():
        try:
            if (text := settings_file(function, argv)) is not None:
                sys.stdout.write(text + "\n")
                return 0
            call = _Call(function, prog, argv)
            spelled.append(call.arguments.as_flags)
            exit_code = 1
            tidy_up()
            outcome, report = call.carry_out(start, notes)
        except KeyboardInterrupt:
            # Ctrl-C or SIGTERM: say whether the same command resumes
            goes_on = call is not None and call.keeps_steps
            say(f"{prog}: interrupted; " + ("the same command goes on where it stopped" if goes_on else
                                            "nothing was written"))
            return 130
        except Exception as error:
            if os.environ.get(TRACEBACK):
                raise
            # an error: what failed, in one line each, then the error itself
            for failure in getattr(error, "failures", ()):
                say(call.real(f"{prog}: failed: {call.arguments.as_flags(failure)}") if call else failure)
            line = _error_line(error, call)
            say(f"{prog}: {line if call is None else call.real(call.arguments.as_flags(line))}")
            return 2 if isinstance(error, UsageError) else exit_code
    # done: the verdict first, then the table, where the output is, what to do next, and what failed on the way
    judgement = outcome.judgement
    failed = judgement is not None and judgement.verdict == "failed"
    if judgement is not None and judgement.reasons:
        say(f"{prog}: {'THE RESULT MEANS NOTHING' if failed else 'LOOK AT THE RESULT'}: {judgement.why}")
    judged = [] if judgement is None else [Metric(JUDGEMENT, judgement.verdict)]
    if judged or outcome.metrics:
        show([*judged, *(m for m in outcome.metrics if m.name != JUDGEMENT),
              Metric("time", time.perf_counter() - start, "s")])
    if outcome.output is not None:
        say(call.real(f"written: {outcome.output}" + (f" (figures in {report})" if report else "")))
    if outcome.following and not failed:
        say(f"next: {call.real(outcome.following, quote)}")
    for failure in outcome.failures:
        say(call.real(f"{prog}: failed: {call.arguments.as_flags(failure)}"))
    return 1 if outcome.failures or failed else 0


def settings_file(function: Callable[..., Outcome], argv: list[str]) -> str | None:
    """Return the settings file that `--write-config` asks for; None where it was not given."""
    defaults = {p.name: p.default for p in inspect.signature(function).parameters.values()
                if isinstance(p.default, ranges.Settings)}
    if not defaults or "--write-config" not in argv:
        return None
    settings = _Settings(defaults, argv)
    return settings.about + config_files.write_settings(settings.values)


class _Settings:
    """The settings of a command: marked fields are flags, the others come from a file."""

    def __init__(self, values: dict[str, ranges.Settings], argv: list[str]) -> None:
        # --config and --preset are read first: they set the defaults of all other flags
        early = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
        early.add_argument("--config", type=Path)
        early.add_argument("--preset", default="default")
        published = getattr(next(iter(values.values()), None), "from_paper", None)     # of the command's own method
        self.presets = published is not None
        self.values, self.about = values, ""
        if not values or {"-h", "--help"} & {*argv}:
            return
        with contextlib.suppress(argparse.ArgumentError):               # the main parser reports it
            known = early.parse_known_args(argv)[0]
            if self.presets and known.preset == "published":
                self.about = config_files.comment(inspect.getdoc(published) or "")
                own_name = next(iter(values))           # settings of the same kind may serve another purpose
                self.values = {name: _as_published(value) if hasattr(value, "from_paper") and (
                    name == own_name or value == type(value)()) else value for name, value in values.items()}
            if known.config is not None:
                self.values = config_files.read_settings(known.config, self.values)

    @property
    def flags(self) -> dict[str, Flag]:
        """Return the flags of the command line by name; those without a path belong to no setting."""
        if not self.values:
            return {}
        flags = config_files.flags(self.values)
        if self.presets:
            flags["preset"] = Flag((), typing.Literal["default", "published"], "default",
                                   "Where settings begin: ours, or the values of the paper.")
        flags["config"] = Flag((), Path | None, None, "TOML file with settings that have no flag.")
        flags["write_config"] = Flag((), bool, False, "Print such a file, with the values in force and what each "
                                     "setting means, and do nothing else.")
        return flags

    def build_arguments(self, flag_values: dict[str, Any]) -> dict[str, Any]:
        """Build the arguments of the function: settings in place of flags."""
        values = dict(self.values)
        for name, flag in self.flags.items():
            value = flag_values.pop(name)
            if flag.path:
                first, *rest = flag.path
                values[first] = config_files.replace_at(values[first], tuple(rest), value)
        return {**flag_values, **values}


def _as_published(value: Any) -> Any:
    """Return the published settings, except for fields that the command itself sets differently from the default."""
    default = type(value)()
    current = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    return dataclasses.replace(type(value).from_paper(), **{
        name: setting for name, setting in current.items() if setting != getattr(default, name)})


class Arguments:
    """What a command takes: arguments of its function, settings that are flags, and flags of all commands."""

    def __init__(self, function: Callable[..., Outcome], prog: str, argv: list[str]) -> None:
        self.prog = prog
        hints = typing.get_type_hints(function, include_extras=True)
        parameters = inspect.signature(function).parameters.values()
        self.wants_space = any(p.name == SPACE for p in parameters)
        # intermediate results lie beside an output file (FileWorkspace), or beside one with an ending (AnyWorkspace)
        kinds = typing.get_args(hints[SPACE])[1:] if self.wants_space else ()
        self.beside, self.either = bool(kinds), len(kinds) > 1
        self.settings = _Settings({p.name: p.default for p in parameters if isinstance(p.default, ranges.Settings)},
                                  argv)
        self.text, sentences = command_sentences(function)
        self.listed = [Argument(p.name, hints[p.name], p.default, sentences.get(p.name, "")) for p in parameters
                       if p.name != SPACE and p.name not in self.settings.values]
        self.output_name = next((a.name for a in self.listed if a.name in ("output", "out")), "")
        flags = self.settings.flags
        if self.wants_space:                # other commands keep no results to compute again
            flags[FORCE] = Flag((), bool, False, "Do all anew, whatever is done already.")
        self.listed += [Argument(name, flag.annotation, flag.value, flag.sentence) for name, flag in flags.items()]

    def read(self, argv: list[str]) -> dict[str, Any]:
        """Read a command line and check the range of every number; nothing is run yet."""
        values = read_line(self.prog, self.text, self.listed, argv)
        for argument in self.listed:
            ranges.range_of(argument.annotation).check(values[argument.name], argument.flag)
        return values

    def as_flags(self, text: str) -> str:
        """Return a message of a function with flags in place of Python argument names."""
        for argument in self.listed:
            name = rf"(?<![\w.\-]){argument.name}"
            text = re.sub(rf"{name}=['\"]?([\w.]+)['\"]?", rf"{argument.flag} \1", text)
            text = re.sub(rf"{name}(?:=|(?=: expected))", argument.flag, text)
        return text


class _Call:
    """A function with the arguments from the command line."""

    def __init__(self, function: Callable[..., Outcome], prog: str, argv: list[str]) -> None:
        self.function, self.command = function, f"{prog} {' '.join(argv)}"
        self.arguments = Arguments(function, prog, argv)
        self.read = self.arguments.read(argv)
        self.given = self.arguments.settings.build_arguments(dict(self.read))
        self.force = self.given.pop(FORCE, False)
        self.output: Path | None = self.given.get(self.arguments.output_name)
        self._staged: Path | None = None

    @property
    def in_folder(self) -> bool:
        """Return whether the function works directly in its output folder."""
        arguments = self.arguments
        either = arguments.either and self.output is not None and not self.output.suffix
        return arguments.wants_space and (not arguments.beside or either)

    @property
    def keeps_steps(self) -> bool:
        """Return whether the same command resumes after an interruption."""
        return self.in_folder or (self.arguments.beside and not self.arguments.either)

    def real(self, text: str, as_shown: Callable[[str], str] = str) -> str:
        """Return a message with the output's path, written `as_shown`, in place of the temporary folder's."""
        staged, output = self._staged, self.output
        if staged is None or output is None:
            return text
        # a path with blanks may be quoted already; then it ends at the quote
        path = re.escape(str(staged))
        return re.sub(rf"'{path}([^']*)'|{path}([^\s;,:]*)",
                      lambda match: as_shown(f"{output.parent}{match[1] or match[2] or ''}"), text)

    def carry_out(self, start: float, notes: Sequence[str]) -> tuple[Outcome, Path | None]:
        """Run the function; return its outcome and the path of the report, which lists the notes too."""
        from .batch.opening import beside, workspace
        from .batch.workspace import NothingMadeError
        from .judgement import carry_judgements

        arguments = self.arguments
        for argument in arguments.listed:
            argument.check_files(self.read[argument.name])
        # what a command has made may be replaced, but not by what is made of it
        if self.output is not None and self.output.is_file():
            for path in _paths(self.given.get(each.name) for each in arguments.listed if each.place):
                if path.is_file() and path.samefile(self.output):
                    raise UsageError(f"--output: expected another file than {path}, which is read")
        # Judgements of earlier results carry over. Read them before anything is written, as the output may be an input.
        # Positional arguments are what the command works on; flags name what it merely uses.
        before = carry_judgements(_paths(self.given.get(each.name) for each in arguments.listed if each.place),
                                  _paths(value for name, value in self.given.items() if name != arguments.output_name))

        def call(**more: Any) -> Outcome:
            """Call the function, and merge its judgement with those of its inputs."""
            outcome = self.function(**{**self.given, **more})
            if outcome.judgement is None:
                assert outcome.output is None, "what was made has a judgement"
                return outcome
            return dataclasses.replace(outcome, judgement=outcome.judgement.merge(before))

        if self.output is None:
            return call(), None
        # in a folder: the function resumes there
        if self.in_folder:
            with workspace(self.output, self.force) as space:
                outcome = call(space=space)
                if outcome.failures and space.all_failed and space.is_new:
                    raise NothingMadeError(outcome.failures)
                return outcome, keep_report(space, outcome, self.command, time.perf_counter() - start, notes)
        # otherwise it writes to a temporary folder, which is moved when all is complete
        with beside(self.output, self.force) as space, space.staging("output") as staged:
            self._staged = staged.folder
            outcome = call(**{arguments.output_name: staged.folder / self.output.name},
                           **({SPACE: space} if arguments.wants_space else {}))
            made = outcome.output or staged.folder / self.output.name
            top = made if made.is_dir() else made.parent
            return outcome, write_report(outcome, self.command, time.perf_counter() - start, notes,
                                         space.digests.of_files(top))


def _paths(values: Iterable[Any]) -> list[Path]:
    """Return the existing files and folders among the values of arguments."""
    candidates = [path for value in values for path in (value if isinstance(value, tuple) else (value,))]
    return [path for path in candidates if isinstance(path, Path) and path.exists()]


@contextlib.contextmanager
def _notes(prog: str) -> Iterator[tuple[list[Callable[[str], str]], list[str]]]:
    """Print our own warnings as one line each while the block runs.

    Yields two lists: functions that rewrite the text, and the texts printed so far. Warnings of libraries are ignored:
    they are for programmers.
    """
    spelled, notes = list[Callable[[str], str]](), list[str]()

    def print_note(message: Warning | str, *_rest: Any, **_named: Any) -> None:
        text = " ".join(str(message).split())
        for spell in spelled:
            text = spell(text)
        if text in notes:                    # a file that is read twice, or by several processes
            return
        notes.append(text)
        say(f"{prog}: note: {text}")

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.filterwarnings("always", category=UserWarning, module=OUR_MODULES)
        warnings.showwarning = print_note
        yield spelled, notes


def _error_line(error: Exception, call: _Call | None) -> str:
    """Return one line for an error; an unexpected one says how to see the traceback."""
    text = " ".join(str(error).split())
    if isinstance(error, MemoryError):
        fewer = ", or --workers 1" if call and any(each.flag == "--workers" for each in call.arguments.listed) else ""
        return f"there is too little memory{': ' + text if text else ''}; give fewer triangles{fewer}"
    if isinstance(error, OSError):
        return explain_os_error(error, "the file" if call is None or call.output is None else call.output)
    if isinstance(error, ValueError | ModuleNotFoundError):
        return text
    return f"unforeseen {type(error).__name__}: {text} (this is a fault of scapekit; {TRACEBACK}=1 shows where)"


def dispatch(commands: Mapping[str, tuple[str, str]], prog: str, argv: list[str], lead: str) -> int:
    """Run the command named first; `commands` is name -> (line of help, "module:function").

    A module is imported only when its command is called, so that help answers at once. A function called `group` has
    commands of its own.
    """
    first = argv[0] if argv else ""
    if first == "help":                                              # `scape help prep run` is `scape prep run --help`
        return dispatch(commands, prog, [*argv[1:], "--help"], lead)
    if first in ("", "-h", "--help"):
        width = max(map(len, commands))
        listing = "\n".join(f"  {name:<{width}}  {text}" for name, (text, _) in commands.items())
        sys.stdout.write(f"usage: {prog} COMMAND ...\n\n{lead}\n\n{listing}\n\n"
                         f"`{prog} COMMAND --help` tells the rest.\n")
        return 0 if argv else 2
    # an unknown command: look for it in all groups, then for a similar one
    if first not in commands:
        everywhere = {path.split()[-1]: path for path in list_commands(commands, prog)}
        at = everywhere.get(first)
        hint = f"; did you mean {at}?" if at else near(first, commands) or near(first, everywhere)
        say(f"{prog}: no command '{first}'{hint or '; there are: ' + ', '.join(commands)}")
        return 2
    target = load_command(commands[first][1])
    if target.__name__ == "group":
        return target(argv[1:])
    return run(target, f"{prog} {first}", argv[1:])


def load_command(target: str) -> Callable[..., Any]:
    """Import the function of a command, "module:function"."""
    module, function = target.split(":")
    return getattr(importlib.import_module(module), function)


def list_commands(commands: Mapping[str, tuple[str, str]], prog: str) -> dict[str, str]:
    """List every command below a group as it is typed, with its "module:function"."""
    targets: dict[str, str] = {}
    for name, (_, target) in commands.items():
        if target.endswith(":group"):
            targets |= list_commands(importlib.import_module(target.split(":")[0]).COMMANDS, f"{prog} {name}")
        else:
            targets[f"{prog} {name}"] = target
    return targets
