"""What a command was called with, kept in the folder that it wrote: the same can be done again from elsewhere.

In the folder itself, or with the rest of what scapekit knows of it.
"""
from __future__ import annotations

import typing
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, TypeVar

from .. import config_files
from ..geometry import storage
from ..ranges import Settings
from .digests import with_paths
from .ownership import HOME

RUN, VERSION, CALL = "run.json", 1, "call of "
Of = TypeVar("Of", bound="KeptCall")


@dataclass(frozen=True)
class KeptCall:
    """The call of one command; each has its own class, with a field `config` for the settings.

    `run.json` holds absolute paths, and the settings as `--write-config` prints them.
    """

    command: ClassVar[str]
    may_be_files: ClassVar[tuple[str, ...]] = ()         # fields with a text that is a word or names a file

    def write(self, folder: Path) -> None:
        """Keep it in a folder."""
        given: dict[str, Any] = {f.name: with_paths(getattr(self, f.name), Path.absolute) for f in fields(self)}
        given |= {name: str(Path(given[name]).absolute()) for name in self.may_be_files
                  if given[name] is not None and Path(given[name]).exists()}
        given["config"] = config_files.write_settings({"config": given["config"]})
        storage.write_json(folder / RUN, {"kind": _kind(self), "version": VERSION, **given})

    @classmethod
    def read(cls: type[Of], folder: Path) -> Of:
        """That of a folder; StorageError for one that does not tell."""
        import msgspec

        path = _file(folder)
        if path is None:
            raise storage.StorageError(f"{folder}: it does not tell what it was made from, as what {cls.command} made "
                                       "earlier does not; run the same command once more")
        with storage.taking_apart(path, f"a {_kind(cls)}"):
            told = storage.read_json(path, f"a {_kind(cls)}")
            if told.pop("kind") != _kind(cls) or told.pop("version") != VERSION:
                raise ValueError(f"kind and version are not those of a {_kind(cls)} that is known here")
            hints = typing.get_type_hints(cls)
            usual: Callable[[], Settings] = hints["config"]
            config = config_files.parse_settings(told.pop("config"), path, {"config": usual()})["config"]
            # values of JSON in the types of the fields: Path, text, one of some words, tuples of these, or None
            return cls(**{name: msgspec.convert(value, hints[name], dec_hook=lambda kind, text: kind(text))
                          for name, value in told.items()} | {"config": config})


def command_of(folder: Path) -> str:
    """The command whose call is kept in a folder, such as "scape mosh"; empty where none is."""
    path = _file(folder)
    try:
        told = storage.read_json(path, "a kept call") if path else None
    except storage.StorageError:
        return ""
    kind = told.get("kind") if isinstance(told, dict) else None
    return kind.removeprefix(CALL) if isinstance(kind, str) and kind.startswith(CALL) else ""


def _file(folder: Path) -> Path | None:
    return next((path for path in (folder / RUN, folder / HOME / RUN) if path.is_file()), None)


def _kind(call: KeptCall | type[KeptCall]) -> str:
    return CALL + call.command
