"""From the signature of a command to its parser: arguments in groups, described by its docstring."""
from __future__ import annotations

import argparse
import difflib
import functools
import inspect
import re
import shutil
import textwrap
import types
import typing
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn

from .ranges import marks

GROUPS = {      # an argument has the same name and meaning in all commands; what is not listed belongs to the method
    "input": "model template poses shapes train_shapes bodies body target source motion control first registered "
             "skeleton candidates image correspondences views cameras rate",
    "output": "output out save_in format surfaces meshes level own_mesh names",
    "what is known": "landmarks template_landmarks source_landmarks features subject subjects "
                     "subject_prefix layout mask unit up betas own_body pose sex",
    "method": "",
    "other": "interactive over serve seed workers preset config write_config force",
}


class UsageError(ValueError):
    """The command line is wrong: flags that exclude each other, a missing flag, or one without such a value."""


@dataclass(frozen=True)
class Place:
    """Marks a positional argument: its name in help, in brackets where it is optional."""

    metavar: str


@dataclass(frozen=True)
class Alias:
    """Marks an argument with a second flag."""

    flag: str
    each: bool = False              # repeat the flag for each value, as in -m ALL -m WOMEN -m MEN


@dataclass(frozen=True)
class Called:
    """Marks an argument whose flag differs from its Python name; that name is understood too, but not shown."""

    flag: str


@dataclass(frozen=True)
class Argument:
    """One argument of a command, from its signature and docstring."""

    name: str
    annotation: Any
    default: Any
    sentence: str

    @functools.cached_property
    def place(self) -> Place | None:
        """Return the mark of a positional argument, if any."""
        return next((mark for mark in marks(self.annotation) if isinstance(mark, Place)), None)

    @functools.cached_property
    def alias(self) -> Alias | None:
        """Return the mark of a second flag, if any."""
        return next((mark for mark in marks(self.annotation) if isinstance(mark, Alias)), None)

    @functools.cached_property
    def flag(self) -> str:
        """Return the name that messages use."""
        if self.place:
            return self.place.metavar.strip("[]").split(" ")[0]
        called = next((mark.flag for mark in marks(self.annotation) if isinstance(mark, Called)), None)
        return called or f"--{self.name.replace('_', '-')}"

    @property
    def flags(self) -> tuple[str, ...]:
        """Return all ways to write it; none for a positional argument."""
        if self.place:
            return ()
        return (self.flag,) if self.alias is None else (self.alias.flag, self.flag)

    @property
    def required(self) -> bool:
        """Return whether it has no default."""
        return self.default is inspect.Parameter.empty

    @property
    def group(self) -> str:
        """Return the title of its group in help."""
        if self.place:
            return "input"
        name = self.flag[2:].replace("-", "_")
        return next((title for title, names in GROUPS.items() if name in names.split()), "method")

    @functools.cached_property
    def type(self) -> Any:
        """Return the type of the value, without marks and without None."""
        return _bare(self.annotation)

    @property
    def parts(self) -> tuple[Any, ...]:
        """Return the types of several values; empty where there is one."""
        if typing.get_origin(self.type) is not tuple:
            return ()
        return tuple(_bare(part) for part in typing.get_args(self.type) if part is not Ellipsis)

    @property
    def any_number(self) -> bool:
        """Return whether it takes any number of values."""
        return Ellipsis in typing.get_args(self.type)

    @property
    def nargs(self) -> int | str | None:
        """Return how many values it takes, in argparse's notation; `read_line` complains about missing ones."""
        each = self.alias is not None and self.alias.each
        if self.any_number and not each:
            return "*"
        if self.parts and not each:
            return len(self.parts)
        return "?" if self.place else None

    @property
    def choices(self) -> tuple[Any, ...]:
        """Return the allowed values; empty where any is allowed."""
        return _choices(self.type)

    @property
    def metavar(self) -> str | tuple[str, ...] | None:
        """Return what stands for the value in help."""
        if self.place:
            return self.place.metavar
        names = tuple(_metavar(part) for part in self.parts or (self.type,))
        return names[0] if self.any_number or len(names) == 1 else names

    def value(self, typed: Any) -> Any:
        """Convert what was typed to the type of the argument; UsageError says what was expected."""
        try:
            if self.any_number:
                return tuple(_value(self.parts[0], text) for text in typed)
            if self.parts:
                return tuple(_value(part, text) for part, text in zip(self.parts, typed, strict=True))
            return typed if self.type is bool else _value(self.type, typed)
        except ValueError as wrong:
            raise UsageError(f"{self.flag}: {wrong}") from None

    def check_files(self, value: Any) -> None:
        """Raise FileNotFoundError for an input file that does not exist, with the most similar name beside it."""
        if self.group == "output" or value == self.default:
            return
        for path in value if isinstance(value, tuple) else (value,):
            # these words stand for no landmarks and for built-in models
            if isinstance(path, Path) and str(path) not in ("none", "people", "people-fingers") and not path.exists():
                beside = [p.name for p in path.parent.iterdir()] if path.parent.is_dir() else []
                raise FileNotFoundError(f"{path}: no such file or folder{near(path.name, beside, 0.8)}")

    def add_to(self, group: Any) -> None:
        """Add it to a group of argparse."""
        help_text = self.sentence.replace("%", "%%")
        if self.required and not self.place:
            help_text += " (required)"
        # an empty default says nothing; a number 0 does
        elif self.default not in (None, (), False, "", Path(), inspect.Parameter.empty) or (self.default == 0 and \
                self.type in (int, float)):
            help_text += f" (default: {self.default})"
        if self.place:
            group.add_argument(self.name, nargs=self.nargs, metavar=self.metavar, help=help_text,
                               default=argparse.SUPPRESS)
            return
        if self.type is bool:
            kind: dict[str, Any] = {"action": "store_true"}
        else:
            kind = {"nargs": self.nargs, "metavar": self.metavar,
                    "action": "append" if self.alias is not None and self.alias.each else "store"}
        group.add_argument(*self.flags, dest=self.name, help=help_text, default=argparse.SUPPRESS, **kind)


def _bare(annotation: Any) -> Any:
    """Strip marks from a type, and None beside it; several literals become one."""
    if typing.get_origin(annotation) is Annotated:
        return _bare(typing.get_args(annotation)[0])
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        options = [_bare(part) for part in typing.get_args(annotation) if part is not type(None)]
        # a number or an address, as --workers takes
        if options == [int, str]:
            return annotation
        return options[0] if len(options) == 1 else Literal[tuple(c for one in options for c in _choices(one))]
    return annotation


def _choices(kind: Any) -> tuple[Any, ...]:
    """Return the values of a Literal; empty for other types."""
    return typing.get_args(kind) if typing.get_origin(kind) is Literal else ()


def _metavar(kind: Any) -> str:
    """Return what stands for a value of a type in help."""
    if choices := _choices(kind):
        return "{" + ",".join(map(str, choices)) + "}"
    return {Path: "PATH", int: "N", float: "NUMBER", int | str: "N|ADDRESS"}.get(kind, "TEXT")


def _value(kind: Any, text: str) -> Any:
    """Convert a text to a type; ValueError says what was expected."""
    if allowed := _choices(kind):
        for choice in allowed:
            if str(choice) == text:
                return choice
        raise ValueError(f"expected one of {', '.join(map(str, allowed))}, got {text}{near(text, map(str, allowed))}")
    if kind == int | str:
        if not text.lstrip("-").isdecimal() and "://" not in text:
            raise ValueError(f"expected a whole number, or an address such as tcp://host:8786, got {text}")
        kind = str if "://" in text else int
    try:
        return kind(text)
    except ValueError:
        raise ValueError(f"expected a {'whole ' if kind is int else ''}number, got {text}") from None


def near(word: str, known: Iterable[str], alike: float = 0.6) -> str:
    """Return the end of a message about an unknown word: the most similar known one."""
    similar = difflib.get_close_matches(word, list(known), 1, alike)
    return f"; did you mean {similar[0]}?" if similar else ""


def command_sentences(function: Callable[..., Any]) -> tuple[str, dict[str, str]]:
    """Split the docstring of a command into its text and the sentences about each argument."""
    text, _, listed = (inspect.getdoc(function) or "").partition("\nArgs:\n")
    entries = re.findall(r"^ {4}(\w+): (.*(?:\n {8}.*)*)", listed, re.MULTILINE)
    return text.strip(), {name: " ".join(sentence.split()) for name, sentence in entries}


def _make_parser(prog: str, text: str, arguments: Sequence[Argument]) -> argparse.ArgumentParser:
    """Make the parser of a command. Values stay text, and nothing is required: `read_line` converts and checks."""
    widths = range(60, 101)  # characters of help: narrower breaks the table, wider is hard to read
    width = min(max(shutil.get_terminal_size().columns, widths[0]), widths[-1])
    # wrap paragraphs, but keep examples in one line, so that they can be copied
    paragraphs = [part if part.startswith("Example:") else textwrap.fill(" ".join(part.split()), width)
                  for part in re.split(r"\n\s*\n", text)]
    needed = [argument.place.metavar for argument in arguments if argument.place] + [
        f"{argument.flags[0]} {argument.metavar}" for argument in arguments if argument.required and argument.flags]
    parser = _Parser(
        prog=prog, usage=" ".join(["%(prog)s", *needed, "[options]"]), description="\n\n".join(paragraphs),
        add_help=False, allow_abbrev=False,
        formatter_class=lambda prog: argparse.RawDescriptionHelpFormatter(prog, max_help_position=26, width=width))
    # argparse shows only groups that have arguments
    groups = {title: parser.add_argument_group(title) for title in GROUPS}
    for argument in arguments:
        argument.add_to(groups[argument.group])
    groups["other"].add_argument("-h", "--help", action="help", help="Show this and do nothing else.")
    return parser


class _Parser(argparse.ArgumentParser):
    """A parser that raises UsageError instead of ending the program."""

    def error(self, message: str) -> NoReturn:
        raise UsageError(re.sub(r"^argument (?:-\w/)?", "", message))


def read_line(prog: str, text: str, arguments: Sequence[Argument], argv: Sequence[str]) -> dict[str, Any]:
    """Read a command line: values by argument name, defaults where a flag was not given.

    Parameters
    ----------
    prog : str
        Name of the command in messages.
    text : str
        Its description.
    arguments : sequence of Argument
        What it takes.
    argv : sequence of str
        Words of the command line.

    Returns
    -------
    dict of str to value

    Raises
    ------
    UsageError
        An unknown flag, with the most similar one; missing arguments, all of them; a value of another type.
    """
    parser = _make_parser(prog, text, arguments)
    # behind -- there are files only, whatever they are called
    if "--" in argv:
        end = list(argv).index("--")
        argv = [*argv[:end], *(f"./{word}" if word.startswith("-") else word for word in argv[end + 1:])]
    values, unknown = parser.parse_known_intermixed_args(_join_flag_values(argv, arguments))
    # complain about the first unknown flag rather than about the value behind it
    if unknown:
        word = next((word for word in unknown if word.startswith("-")), unknown[0])
        if not word.startswith("-"):
            raise UsageError(f"{word}: one argument too many")
        if Path(word).exists():
            raise UsageError(f"{word}: no such flag; for the file of this name write ./{word}")
        word = word.partition("=")[0]
        raise UsageError(f"{word}: no such flag{near(word, (flag for a in arguments for flag in a.flags))}")
    missing = [a.flag for a in arguments if a.required and getattr(values, a.name, None) in (None, [])]
    for first in [a for a in arguments if a.place][:1]:
        optional = first.place is not None and first.place.metavar.startswith("[")
        if missing and first.flag not in missing and not optional and not getattr(values, first.name, None):
            missing.insert(0, first.flag)               # its default is for the browser only
    if missing:
        raise UsageError(f"expected {' and '.join(missing)}, as in: {parser.format_usage()[7:].strip()}")
    return {a.name: a.value(getattr(values, a.name)) if hasattr(values, a.name) else a.default for a in arguments}


def _join_flag_values(argv: Sequence[str], arguments: Sequence[Argument]) -> list[str]:
    """Join a flag with its value where that begins with a dash, as in `--up -y`; write flags as help shows them."""
    one_value = {flag for a in arguments if a.nargs is None and a.type is not bool for flag in a.flags}
    known = {"-h", "--help", *(flag for a in arguments for flag in a.flags)}
    names = {f"--{a.name.replace('_', '-')}": a.flag for a in arguments if a.flags}         # the Python names work too
    words: list[str] = []
    for word in argv:
        name, equals, value = word.partition("=")
        if name.startswith("--") and name not in known:
            name = name.replace("_", "-")
            word = names.get(name, name) + equals + value
        if words and words[-1] in one_value and word.startswith("-") and word.partition("=")[0] not in known:
            words[-1] += ("=" if words[-1].startswith("--") else "") + word
        else:
            words.append(word)
    return words
