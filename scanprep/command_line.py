"""From a function to a command: its signature is the command line, and `run` deals with errors and exit codes."""
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
from typing import Any

from . import config_files, ranges
from .arguments import Argument, UsageError, command_sentences, make_parser, near, read_line
from .config_files import Flag
from .console import JUDGEMENT, Metric, Outcome, keep_report, say, show, write_report
from .interrupts import tidy_up
from .threads import one_thread
from .words import OUR_MODULES

SPACE, FORCE = "space", "force"        # parameters of commands that are dealt with here
TRACEBACK = "SCAPEKIT_TRACEBACK"       # environment variable that shows where an error came from


def run(function: Callable[..., Outcome], prog: str, argv: list[str]) -> int:
    """Read the command line for `function`, run it, print its table; returns the exit code.

    The signature of the function is the command line: names, types, defaults and the docstring.
    0: done, though perhaps to be looked at; 1: failed, with one line that says why; 2: wrong usage.

    A function with a parameter `space: Workspace` works in its output folder and goes on there where it was
    interrupted. All others write to a folder of their own, from which the output takes its place when it is whole.
    """
    start, wrong, call = time.perf_counter(), 2, None
    with _notes(prog) as (spelled, notes), one_thread():
        try:
            if (text := settings_file(function, argv)) is not None:
                sys.stdout.write(text + "\n")
                return 0
            call = _Call(function, prog, argv)
            spelled.append(call.arguments.as_flags)
            wrong = 1
            tidy_up()
            outcome, report = call.carry_out(start, notes)
        except KeyboardInterrupt:
            goes_on = call is not None and call.keeps_steps
            say(f"{prog}: interrupted; " + ("the same command goes on where it stopped" if goes_on else
                                            "nothing was written"))
            return 130
        except Exception as error:
            if os.environ.get(TRACEBACK):
                raise
            for failure in getattr(error, "failures", ()):
                say(call.real(f"{prog}: failed: {call.arguments.as_flags(failure)}") if call else failure)
            told = _error_line(error)
            say(f"{prog}: {told if call is None else call.real(call.arguments.as_flags(told))}")
            return 2 if isinstance(error, UsageError) else wrong
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
        say(f"next: {call.real(outcome.following)}")
    for failure in outcome.failures:
        say(call.real(f"{prog}: failed: {call.arguments.as_flags(failure)}"))
    return 1 if outcome.failures or failed else 0


def settings_file(function: Callable[..., Outcome], argv: list[str]) -> str | None:
    """The file of settings that `--write-config` asks for, or None where it does not."""
    found = {p.name: p.default for p in inspect.signature(function).parameters.values()
             if isinstance(p.default, ranges.Settings)}
    if not found or "--write-config" not in argv:
        return None
    settings = _Settings(found, argv)
    return settings.about + config_files.write_settings(settings.values)


class _Settings:
    """The settings of a command: marked fields are flags, all others come from a file."""

    def __init__(self, values: dict[str, ranges.Settings], argv: list[str]) -> None:
        early = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
        early.add_argument("--config", type=Path)
        early.add_argument("--preset", default="default")
        published = getattr(next(iter(values.values()), None), "from_paper", None)       # of the command's own method
        self.presets = published is not None
        self.values, self.about = values, ""
        if not values or {"-h", "--help"} & {*argv}:
            return
        with contextlib.suppress(argparse.ArgumentError):               # said by the parser of the whole line
            given = early.parse_known_args(argv)[0]
            if self.presets and given.preset == "published":
                self.about = config_files.comment(inspect.getdoc(published) or "")
                own = next(iter(values))           # other settings of one kind may stand for something else
                self.values = {name: _as_published(value) if hasattr(value, "from_paper") and (
                    name == own or value == type(value)()) else value for name, value in values.items()}
            if given.config is not None:
                self.values = config_files.read_settings(given.config, self.values)

    @property
    def flags(self) -> dict[str, Flag]:
        """The flags of the command line by their names; those without a path are of no setting."""
        if not self.values:
            return {}
        found = config_files.flags(self.values)
        if self.presets:
            found["preset"] = Flag((), typing.Literal["default", "published"], "default",
                                   "Where settings begin: ours, or the values of the paper.")
        found["config"] = Flag((), Path | None, None, "TOML file with settings that have no flag.")
        found["write_config"] = Flag((), bool, False, "Print such a file, with the values in force and what each "
                                     "setting means, and do nothing else.")
        return found

    def build_arguments(self, given: dict[str, Any]) -> dict[str, Any]:
        """The arguments of the command's function: settings in place of flags."""
        values = dict(self.values)
        for name, flag in self.flags.items():
            value = given.pop(name)
            if flag.path:
                first, *rest = flag.path
                values[first] = config_files.replace_at(values[first], tuple(rest), value)
        return {**given, **values}


def _as_published(value: Any) -> Any:
    """The published settings, but for the fields in which those of the command are not the usual ones anyway."""
    usual = type(value)()
    own = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    return dataclasses.replace(type(value).from_paper(), **{
        name: mine for name, mine in own.items() if mine != getattr(usual, name)})


class Arguments:
    """What a command takes: the arguments of its function, its settings that are flags, and what all commands take."""

    def __init__(self, function: Callable[..., Outcome], prog: str, argv: list[str]) -> None:
        self.prog = prog
        hints = typing.get_type_hints(function, include_extras=True)
        parameters = inspect.signature(function).parameters.values()
        self.wants_space = any(p.name == SPACE for p in parameters)
        # what is kept lies beside an output that is a file (FileWorkspace), or that has an ending (AnyWorkspace)
        kinds = typing.get_args(hints[SPACE])[1:] if self.wants_space else ()
        self.beside, self.either = bool(kinds), len(kinds) > 1
        self.settings = _Settings({p.name: p.default for p in parameters if isinstance(p.default, ranges.Settings)},
                                  argv)
        self.text, told = command_sentences(function)
        self.listed = [Argument(p.name, hints[p.name], p.default, told.get(p.name, "")) for p in parameters
                       if p.name != SPACE and p.name not in self.settings.values]
        self.output_name = next((a.name for a in self.listed if a.name in ("output", "out")), "")
        flags = self.settings.flags
        if self.wants_space:                # all others keep nothing that they could take as done
            flags[FORCE] = Flag((), bool, False, "Do all anew, whatever is done already.")
        self.listed += [Argument(name, flag.annotation, flag.value, flag.sentence) for name, flag in flags.items()]

    def parser(self, tell: Callable[[Argument, argparse.Action], None]) -> argparse.ArgumentParser:
        """The parser that prints help; `tell` is called with every argument and its action."""
        return make_parser(self.prog, self.text, self.listed, tell)

    def read(self, argv: list[str]) -> dict[str, Any]:
        """The values of a command line, every number in its range; nothing is done yet."""
        given = read_line(self.prog, self.text, self.listed, argv)
        for argument in self.listed:
            ranges.range_of(argument.annotation).check(given[argument.name], argument.flag)
        return given

    def as_flags(self, text: str) -> str:
        """A message of a function with flags in place of the names of its arguments."""
        for argument in self.listed:
            name = rf"(?<![\w.\-]){argument.name}"
            text = re.sub(rf"{name}=['\"]?([\w.]+)['\"]?", rf"{argument.flag} \1", text)
            text = re.sub(rf"{name}(?:=|(?=: expected))", argument.flag, text)
        return text


class _Call:
    """A function with what the command line gives it."""

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
        """Whether the function works in its output, which is a folder."""
        asked = self.arguments
        either = asked.either and self.output is not None and not self.output.suffix
        return asked.wants_space and (not asked.beside or either)

    @property
    def keeps_steps(self) -> bool:
        """Whether the same command goes on where it was interrupted."""
        return self.in_folder or (self.arguments.beside and not self.arguments.either)

    def real(self, text: str) -> str:
        """A message with the path of the output for that of the folder in which it was made."""
        staged, output = self._staged, self.output
        return text if staged is None or output is None else text.replace(str(staged), str(output.parent))

    def carry_out(self, start: float, notes: Sequence[str]) -> tuple[Outcome, Path | None]:
        """What the function did, and where its report is, which has the notes too."""
        from .batch.opening import beside, workspace
        from .batch.workspace import NothingMadeError
        from .judgement import carry_judgements

        asked = self.arguments
        for argument in asked.listed:
            argument.check_files(self.read[argument.name])
        # What results before say of themselves, read before anything is written: an output may be one of the inputs.
        # What stands at its place is the thing itself that a command works on; flags name what is taken along.
        before = carry_judgements(_paths(self.given.get(argument.name) for argument in asked.listed if argument.place),
                                  _paths(value for name, value in self.given.items() if name != asked.output_name))

        def call(**more: Any) -> Outcome:
            outcome = self.function(**{**self.given, **more})
            if outcome.judgement is None:
                assert outcome.output is None, "what was made has a judgement"
                return outcome
            return dataclasses.replace(outcome, judgement=outcome.judgement.merge(before))

        if self.output is None:
            return call(), None
        if self.in_folder:
            with workspace(self.output, self.force) as space:
                outcome = call(space=space)
                if outcome.failures and space.all_failed and space.is_new:
                    raise NothingMadeError(outcome.failures)
                return outcome, keep_report(space, outcome, self.command, time.perf_counter() - start, notes)
        with beside(self.output, self.force) as space, space.staging("output") as staged:
            self._staged = staged.folder
            outcome = call(**{asked.output_name: staged.folder / self.output.name},
                           **({SPACE: space} if asked.wants_space else {}))
            made = outcome.output or staged.folder / self.output.name
            top = made if made.is_dir() else made.parent
            return outcome, write_report(outcome, self.command, time.perf_counter() - start, notes,
                                         space.digests.of_files(top))


def _paths(values: Iterable[Any]) -> list[Path]:
    """The files and folders among the values of arguments."""
    found = [path for value in values for path in (value if isinstance(value, tuple) else (value,))]
    return [path for path in found if isinstance(path, Path) and path.exists()]


@contextlib.contextmanager
def _notes(prog: str) -> Iterator[tuple[list[Callable[[str], str]], list[str]]]:
    """Our own warnings as one line each, spelled by what is in the first list and kept in the second.

    Those of libraries are for their users.
    """
    spelled, notes = list[Callable[[str], str]](), list[str]()

    def tell(message: Warning | str, *_rest: Any, **_named: Any) -> None:
        text = " ".join(str(message).split())
        for spell in spelled:
            text = spell(text)
        notes.append(text)
        say(f"{prog}: note: {text}")

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.filterwarnings("always", category=UserWarning, module=OUR_MODULES)
        warnings.showwarning = tell
        yield spelled, notes


def _error_line(error: Exception) -> str:
    """One line for what went wrong; with the way to the traceback where nobody foresaw it."""
    text = " ".join(str(error).split())
    if isinstance(error, MemoryError):
        return f"there is too little memory{': ' + text if text else ''}; give fewer triangles, or --workers 1"
    if isinstance(error, ValueError | OSError | ModuleNotFoundError):
        return text
    return f"unforeseen {type(error).__name__}: {text} (this is a fault of scapekit; {TRACEBACK}=1 shows where)"


def dispatch(commands: Mapping[str, tuple[str, str]], prog: str, argv: list[str], lead: str) -> int:
    """Hand the arguments on to the command named first; `commands` is name -> (one line of help, "module:function").

    A module is imported when its command is called, so that help answers at once. A function called `group` has
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
    """The function of a command, "module:function"."""
    module, function = target.split(":")
    return getattr(importlib.import_module(module), function)


def list_commands(commands: Mapping[str, tuple[str, str]], prog: str) -> dict[str, str]:
    """Every command below a group, as it is typed, with its "module:function"."""
    found: dict[str, str] = {}
    for name, (_, target) in commands.items():
        if target.endswith(":group"):
            found |= list_commands(importlib.import_module(target.split(":")[0]).COMMANDS, f"{prog} {name}")
        else:
            found[f"{prog} {name}"] = target
    return found
