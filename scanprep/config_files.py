"""Settings in files: those without a flag on the command line are set by `--config FILE`, in TOML.

The names are those of the fields of the settings. A command with one group of settings has its fields at the top of
the file; one with several has a table for each, named like the parameter of the Python function.
"""
from __future__ import annotations

import dataclasses
import inspect
import re
import textwrap
import types
import typing
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

from .arguments import near
from .geometry import storage
from .ranges import FLAG, NO_FLAGS, OutOfRangeError, Settings, marks

Path_ = tuple[str, ...]              # path of a field: parameter, then names of nested settings

# What became of settings of earlier versions: `Class.field`, wherever the class is nested, or the whole name in a file,
# as `table.field`, where the class is gone too. One sentence each, of what holds now.
REMOVED = Path(__file__).with_name("removed_settings.json")


@dataclasses.dataclass(frozen=True)
class Flag:
    """A field of settings that is also a flag: where it is, its type, value and description."""

    path: Path_
    annotation: Any
    value: Any
    sentence: str


def flags(settings: Mapping[str, Settings]) -> dict[str, Flag]:
    """Find the marked fields of settings; a flag has the name of its field."""
    by_name: dict[str, Flag] = {}
    for parameter, config in settings.items():
        for flag in _flags((parameter,), config):
            assert flag.path[-1] not in by_name, f"two settings have a flag {flag.path[-1]}"
            by_name[flag.path[-1]] = flag
    return by_name


def _flags(path: Path_, config: Settings) -> Iterator[Flag]:
    """Yield the marked fields of settings and of the settings inside them."""
    sentences, hints = settings_sentences(type(config)), _hints(type(config))
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if FLAG in marks(hints[field.name]):
            yield Flag((*path, field.name), hints[field.name], value, sentences.get(field.name, ""))
        elif isinstance(value, Settings) and NO_FLAGS not in marks(hints[field.name]):
            yield from _flags((*path, field.name), value)


def replace_at(config: Settings, path: Path_, value: Any) -> Settings:
    """Return settings with another value at a path of field names."""
    first, *rest = path
    inner = replace_at(getattr(config, first), tuple(rest), value) if rest else value
    return dataclasses.replace(config, **{first: inner})


def settings_sentences(cls: type[Settings]) -> dict[str, str]:
    """Read what the docstrings of settings, and of their base classes, say of each field."""
    fields, lines_of = {field.name for field in dataclasses.fields(cls)}, dict[str, list[str]]()
    for owner in reversed(cls.__mro__):
        names: list[str] = []
        listed = re.split(r"(?:Attributes|Parameters)\n *-+\n", inspect.cleandoc(owner.__doc__ or ""))[-1]
        for line in listed.splitlines():
            if line and not line.startswith(" "):
                names = [name for name in re.split(r",\s*", line.partition(" :")[0]) if name in fields]
                lines_of.update((name, []) for name in names)
            else:
                for name in names:
                    lines_of[name].append(line.strip())
    return {name: " ".join(lines).strip() for name, lines in lines_of.items()}


def write_settings(settings: Mapping[str, Settings]) -> str:
    """Write settings as text that `read_settings` reads: every field with its description."""
    kept = _of_files(settings)
    return "\n\n".join("\n".join(_lines(config, (name,) if len(kept) > 1 else ())) for name, config in kept.items())


def _of_files(settings: Mapping[str, Settings]) -> dict[str, Settings]:
    """Return the settings of which some field has no flag."""
    return {name: config for name, config in settings.items()
            if any(FLAG not in marks(hint) for hint in _hints(type(config)).values())}


def _hints(cls: type) -> dict[str, Any]:
    """Return the types of fields with their marks."""
    return typing.get_type_hints(cls, include_extras=True)


def comment(text: str) -> str:
    """Format paragraphs as comment lines of a file, with an empty line after them; nothing for no text."""
    parts = [textwrap.fill(part, 102, initial_indent="# ", subsequent_indent="# ")
             for part in text.split("\n\n") if part]
    return "\n#\n".join(parts) + "\n\n" * bool(parts)


def _lines(config: Any, table: Path_) -> Iterator[str]:
    """Yield the lines of one group of settings: fields first, then tables, as TOML requires."""
    import tomlkit

    sentences, inner = settings_sentences(type(config)), []
    if table:
        yield f"[{'.'.join(table)}]"
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            inner.append((value, (*table, field.name)))
            continue
        if isinstance(value, tuple) and value and dataclasses.is_dataclass(value[0]):
            # a tuple of settings becomes an array of inline tables
            rows = [", ".join(f"{f.name} = {tomlkit.item(getattr(item, f.name)).as_string()}"
                              for f in dataclasses.fields(item) if getattr(item, f.name) is not None) for item in value]
            text: str | None = "[" + ", ".join("{" + row + "}" for row in rows) + "]"
        else:
            text = None if value is None else tomlkit.item(list(value) if isinstance(value, tuple) else value
                                                          ).as_string()
        yield from (f"# {line}" for line in textwrap.wrap(sentences.get(field.name, ""), 100))
        yield f"# {field.name} = (not set)" if text is None else f"{field.name} = {text}"
    for value, name in inner:
        yield ""
        yield from _lines(value, name)


def read_settings(path: Path, settings: Mapping[str, Settings]) -> dict[str, Settings]:
    """Read settings from a file; ValueError names file, line, what was expected and the most similar name."""
    with storage.taking_apart(path, "settings in TOML"):
        text = storage.read_bytes(path, "settings in TOML").decode("utf-8")
    return parse_settings(text, path, settings)


def parse_settings(text: str, path: Path, settings: Mapping[str, Settings]) -> dict[str, Settings]:
    """Parse settings from the text of a file."""
    import tomlkit
    from tomlkit.exceptions import ParseError

    try:
        tree = tomlkit.parse(text).unwrap()
    except ParseError as error:
        raise ValueError(f"{path}:{error.line}: expected TOML: {error}") from None
    place = _Place(path, text)
    in_file = _of_files(settings)
    if len(in_file) == 1:
        name, config = next(iter(in_file.items()))
        return {**settings, name: _apply_table(config, tree, (), place)}
    place.check_removed(sorted(tree.keys() - in_file.keys()), ())
    for name in tree:
        place.check_name(name, in_file, (), "table")
    changed = {name: _apply_table(config, tree.get(name, {}), (name,), place) for name, config in in_file.items()}
    return {**settings, **changed}


@dataclasses.dataclass(frozen=True)
class _Place:
    """The file and its text, to say where something is wrong."""

    path: Path
    text: str

    def error(self, name: str, table: Path_, problem: str) -> ValueError:
        """Return the error for a key, with its line."""
        return ValueError(f"{self.path}:{self._line(name, table)}: {'.'.join((*table, name))}: {problem}")

    def check_name(self, name: str, known: Any, table: Path_, what: str) -> None:
        """Raise an error for an unknown name, with the most similar known one."""
        if name not in known:
            names = near(name, known, 0.5) or f"; there are: {', '.join(known)}"
            raise self.error(name, table, f"expected a {what} of this command{names}")

    def check_removed(self, names: Collection[str], table: Path_, owner: type | None = None) -> None:
        """Raise an error for settings of earlier versions: all of a table at once, as each is a line to delete."""
        classes = () if owner is None else owner.__mro__
        sentences = storage.read_json(REMOVED, "sentences on settings that left") if names else {}
        problems = []
        for name in names:
            keys = [".".join((*table, name)), *(f"{base.__name__}.{name}" for base in classes)]
            problems += [str(self.error(name, table, f"this setting is gone: {sentences[key]}"))
                         for key in keys if key in sentences][:1]
        if problems:
            raise ValueError("; ".join(problems))

    def _line(self, name: str, table: Path_) -> int:
        """Find the line of a key in a table, or of the table itself."""
        at: Path_ = ()
        for i, line in enumerate(self.text.splitlines(), 1):
            if header := re.match(r"\s*\[+([^\]]+)\]", line):
                at = tuple(part.strip(" \"'") for part in header[1].split("."))
                if at[:len(table) + 1] == (*table, name):
                    return i
            elif at == table and re.match(rf"\s*[\"']?{re.escape(name)}[\"']?\s*[.=]", line):
                return i
            elif re.match(rf"\s*{re.escape('.'.join((*table, name)))}\s*=", line):
                return i
        return 1


def _apply_table(config: Settings, tree: Any, table: Path_, place: _Place) -> Settings:
    """Return settings with the values of a table in the file."""
    import msgspec

    if not isinstance(tree, dict):
        raise place.error(table[-1], table[:-1], f"expected a table, got {tree!r}")
    hints, names = _hints(type(config)), [f.name for f in dataclasses.fields(config)]
    place.check_removed(sorted(tree.keys() - names), table, type(config))
    for name, value in tree.items():
        place.check_name(name, names, table, "setting")
        now = getattr(config, name)
        # an optional group of settings that is None starts from its defaults
        options = typing.get_args(hints[name]) if typing.get_origin(hints[name]) in (typing.Union, types.UnionType) \
            else ()
        inner = now if isinstance(now, Settings) else next(
            (option() for option in options if isinstance(option, type) and issubclass(option, Settings)), None)
        try:
            new = msgspec.convert(value, hints[name]) if inner is None else \
                _apply_table(inner, value, (*table, name), place)
            config = dataclasses.replace(config, **{name: new})
        except OutOfRangeError as error:
            raise place.error(name, table, error.args[1]) from None
        except msgspec.ValidationError as error:
            raise place.error(name, table, str(error).replace("`", "").replace("$", "value")) from None
    return config
