"""From the signature of a command to its parser: arguments in groups, with the sentences of its docstring."""
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
    "output": "output out save_in format surfaces meshes level",
    "what is known": "landmarks template_landmarks source_landmarks features subject subjects "
                     "subject_prefix layout mask unit up betas own_body pose sex",
    "method": "",
    "other": "interactive over serve seed workers preset config write_config force",
}
WIDTH = range(60, 101)              # of help: narrower is no table, wider cannot be read


class UsageError(ValueError):
    """The command line is wrong: flags that exclude each other, one that is missing or has no such value."""


@dataclass(frozen=True)
class Place:
    """Marks an argument that is given by its place: what it is called in help, in brackets where it may be left out."""

    metavar: str


@dataclass(frozen=True)
class Alias:
    """Marks an argument that has another flag too."""

    flag: str
    each: bool = False              # the flag is given once for each value, as in -m ALL -m WOMEN -m MEN


@dataclass(frozen=True)
class Called:
    """Marks an argument whose flag is not its name in Python; the latter is understood too, and not shown."""

    flag: str


class _Unknown(Exception):
    """What a text should have been."""


@dataclass(frozen=True)
class Argument:
    """One argument of a command, as its signature and docstring have it."""

    name: str
    annotation: Any
    default: Any
    sentence: str

    @functools.cached_property
    def place(self) -> Place | None:
        return next((mark for mark in marks(self.annotation) if isinstance(mark, Place)), None)

    @functools.cached_property
    def alias(self) -> Alias | None:
        return next((mark for mark in marks(self.annotation) if isinstance(mark, Alias)), None)

    @functools.cached_property
    def flag(self) -> str:
        """How messages call it."""
        if self.place:
            return self.place.metavar.strip("[]").split(" ")[0]
        called = next((mark.flag for mark in marks(self.annotation) if isinstance(mark, Called)), None)
        return called or f"--{self.name.replace('_', '-')}"

    @property
    def flags(self) -> tuple[str, ...]:
        """All ways to write it, none where its place says which it is."""
        if self.place:
            return ()
        return (self.flag,) if self.alias is None else (self.alias.flag, self.flag)

    @property
    def required(self) -> bool:
        return self.default is inspect.Parameter.empty

    @property
    def group(self) -> str:
        if self.place:
            return "input"
        name = self.flag[2:].replace("-", "_")
        return next((title for title, names in GROUPS.items() if name in names.split()), "method")

    @functools.cached_property
    def type(self) -> Any:
        """The type of the value, without marks and without None."""
        return _bare(self.annotation)

    @property
    def parts(self) -> tuple[Any, ...]:
        """The types of several values; empty where there is one."""
        if typing.get_origin(self.type) is not tuple:
            return ()
        return tuple(_bare(part) for part in typing.get_args(self.type) if part is not Ellipsis)

    @property
    def any_number(self) -> bool:
        return Ellipsis in typing.get_args(self.type)

    @property
    def nargs(self) -> int | str | None:
        """How many values it takes, as argparse writes it; that something is missing is said by `read_line`."""
        each = self.alias is not None and self.alias.each
        if self.any_number and not each:
            return "*"
        if self.parts and not each:
            return len(self.parts)
        return "?" if self.place else None

    @property
    def choices(self) -> tuple[Any, ...]:
        return _choices(self.type)

    @property
    def metavar(self) -> str | tuple[str, ...] | None:
        if self.place:
            return self.place.metavar
        names = tuple(_metavar(part) for part in self.parts or (self.type,))
        return names[0] if self.any_number or len(names) == 1 else names

    def value(self, given: Any) -> Any:
        """What was written as the type of the argument; UsageError says what was expected."""
        try:
            if self.any_number:
                return tuple(_value(self.parts[0], text) for text in given)
            if self.parts:
                return tuple(_value(part, text) for part, text in zip(self.parts, given, strict=True))
            return given if self.type is bool else _value(self.type, given)
        except _Unknown as wrong:
            raise UsageError(f"{self.flag}: {wrong}") from None

    def check_files(self, value: Any) -> None:
        """FileNotFoundError for a file to read that is not there, with the nearest name beside it."""
        if self.group == "output" or value == self.default:
            return
        for path in value if isinstance(value, tuple) else (value,):
            # stand for no landmarks and for built-in models where files are expected
            if isinstance(path, Path) and str(path) not in ("none", "people", "people-fingers") and not path.exists():
                beside = [p.name for p in path.parent.iterdir()] if path.parent.is_dir() else []
                raise FileNotFoundError(f"{path}: no such file or folder{near(path.name, beside, 0.8)}")

    def add_to(self, group: Any) -> argparse.Action:
        """As an argument of argparse."""
        told = self.sentence.replace("%", "%%")
        if self.required and not self.place:
            told += " (required)"
        elif self.default not in (None, (), False, "", Path(), inspect.Parameter.empty) or (self.default == 0 and \
                self.type in (int, float)):
            told += f" (default: {self.default})"
        if self.place:
            return group.add_argument(self.name, nargs=self.nargs, metavar=self.metavar, help=told,
                                      default=argparse.SUPPRESS)
        if self.type is bool:
            kind: dict[str, Any] = {"action": "store_true"}
        else:
            kind = {"nargs": self.nargs, "metavar": self.metavar,
                    "action": "append" if self.alias is not None and self.alias.each else "store"}
        return group.add_argument(*self.flags, dest=self.name, help=told, default=argparse.SUPPRESS, **kind)


def _bare(annotation: Any) -> Any:
    """A type without marks, and without None beside it; several literals become one."""
    if typing.get_origin(annotation) is Annotated:
        return _bare(typing.get_args(annotation)[0])
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        options = [_bare(part) for part in typing.get_args(annotation) if part is not type(None)]
        if options == [int, str]:
            return annotation
        return options[0] if len(options) == 1 else Literal[tuple(c for one in options for c in _choices(one))]
    return annotation


def _choices(kind: Any) -> tuple[Any, ...]:
    return typing.get_args(kind) if typing.get_origin(kind) is Literal else ()


def _metavar(kind: Any) -> str:
    if found := _choices(kind):
        return "{" + ",".join(map(str, found)) + "}"
    return {Path: "PATH", int: "N", float: "NUMBER", int | str: "N|ADDRESS"}.get(kind, "TEXT")


def _value(kind: Any, text: str) -> Any:
    """A text as one value of a type."""
    if found := _choices(kind):
        for choice in found:
            if str(choice) == text:
                return choice
        raise _Unknown(f"expected one of {', '.join(map(str, found))}, got {text}{near(text, map(str, found))}")
    if kind == int | str:
        if not text.lstrip("-").isdecimal() and "://" not in text:
            raise _Unknown(f"expected a whole number, or an address such as tcp://host:8786, got {text}")
        kind = str if "://" in text else int
    try:
        return kind(text)
    except ValueError:
        raise _Unknown(f"expected a {'whole ' if kind is int else ''}number, got {text}") from None


def near(word: str, known: Iterable[str], alike: float = 0.6) -> str:
    """The end of a message about a word that is unknown: the nearest one that is known."""
    found = difflib.get_close_matches(word, list(known), 1, alike)
    return f"; did you mean {found[0]}?" if found else ""


def command_sentences(function: Callable[..., Any]) -> tuple[str, dict[str, str]]:
    """The docstring of a command without its arguments, and what it says of each argument."""
    text, _, listed = (inspect.getdoc(function) or "").partition("\nArgs:\n")
    found = re.findall(r"^ {4}(\w+): (.*(?:\n {8}.*)*)", listed, re.MULTILINE)
    return text.strip(), {name: " ".join(told.split()) for name, told in found}


def make_parser(prog: str, text: str, arguments: Sequence[Argument],
                tell: Callable[[Argument, argparse.Action], None] = lambda _argument, _action: None
                ) -> argparse.ArgumentParser:
    """The parser of a command. It leaves values as they were written, and asks for nothing: `read_line` does.

    `tell` is called with every argument and its action.
    """
    width = min(max(shutil.get_terminal_size().columns, WIDTH[0]), WIDTH[-1])
    paragraphs = [part if part.startswith("Example:") else textwrap.fill(" ".join(part.split()), width)
                  for part in re.split(r"\n\s*\n", text)]
    needed = [argument.place.metavar for argument in arguments if argument.place] + [
        f"{argument.flags[0]} {argument.metavar}" for argument in arguments if argument.required and argument.flags]
    parser = _Parser(
        prog=prog, usage=" ".join(["%(prog)s", *needed, "[options]"]), description="\n\n".join(paragraphs),
        add_help=False, allow_abbrev=False,
        formatter_class=lambda prog: argparse.RawDescriptionHelpFormatter(prog, max_help_position=26, width=width))
    groups = {title: parser.add_argument_group(title) for title in GROUPS}
    for argument in arguments:
        tell(argument, argument.add_to(groups[argument.group]))
    groups["other"].add_argument("-h", "--help", action="help", help="Show this and do nothing else.")
    return parser


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are exceptions."""

    def error(self, message: str) -> NoReturn:
        raise UsageError(re.sub(r"^argument (?:-\w/)?", "", message))


def read_line(prog: str, text: str, arguments: Sequence[Argument], argv: Sequence[str]) -> dict[str, Any]:
    """The values of a command line by the names of the arguments, those that were not given with their defaults.

    Raises
    ------
    UsageError
        A flag that there is not, with the nearest; what is missing, all of it; a value of another type.
    """
    parser = make_parser(prog, text, arguments)
    given, left = parser.parse_known_intermixed_args(_join_flag_values(argv, arguments))
    if left:
        word = next((word for word in left if word.startswith("-")), left[0])
        if not word.startswith("-"):
            raise UsageError(f"{word}: one argument too many")
        word = word.partition("=")[0]
        raise UsageError(f"{word}: no such flag{near(word, (flag for a in arguments for flag in a.flags))}")
    missing = [a.flag for a in arguments if a.required and getattr(given, a.name, None) in (None, [])]
    for first in [a for a in arguments if a.place][:1]:
        optional = first.place is not None and first.place.metavar.startswith("[")
        if missing and first.flag not in missing and not optional and not getattr(given, first.name, None):
            missing.insert(0, first.flag)               # it has a default, for the browser alone
    if missing:
        raise UsageError(f"expected {' and '.join(missing)}, as in: {parser.format_usage()[7:].strip()}")
    return {a.name: a.value(getattr(given, a.name)) if hasattr(given, a.name) else a.default for a in arguments}


def _join_flag_values(argv: Sequence[str], arguments: Sequence[Argument]) -> list[str]:
    """A flag and its value in one word where the value begins with a dash, as in `--up -y`; flags as help has them."""
    single = {flag for a in arguments if a.nargs is None and a.type is not bool for flag in a.flags}
    known = {"-h", "--help", *(flag for a in arguments for flag in a.flags)}
    names = {f"--{a.name.replace('_', '-')}": a.flag for a in arguments if a.flags}         # in Python
    words: list[str] = []
    for word in argv:
        name, equals, value = word.partition("=")
        if name.startswith("--") and name not in known:
            name = name.replace("_", "-")
            word = names.get(name, name) + equals + value
        if words and words[-1] in single and word.startswith("-") and word.partition("=")[0] not in known:
            words[-1] += ("=" if words[-1].startswith("--") else "") + word
        else:
            words.append(word)
    return words
