"""The call of a command, kept in the folder that it wrote, so that the same work can be repeated later.

It is in the folder itself, or in its `.scapekit` folder.
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
from .digests import paths_of, with_paths
from .ownership import HOME

# name of the file, version of its format, and what its kind begins with; all three are in files of users
RUN, VERSION, CALL = "run.json", 1, "call of "
Of = TypeVar("Of", bound="KeptCall")


@dataclass(frozen=True)
class KeptCall:
    """The call of one command; each command has a class of its own, with the settings in a field `config`.

    `run.json` holds absolute paths, and the settings as `--write-config` prints them.
    """

    command: ClassVar[str]
    may_be_files: ClassVar[tuple[str, ...]] = ()         # text fields that hold a keyword or a file name

    def write(self, folder: Path) -> None:
        """Write the call into a folder."""
        def find_place(path: Path) -> Path:
            """Return the absolute path of a file; a keyword, as the name of a built-in model, stays as it is."""
            return path.absolute() if path.exists() else path

        stored: dict[str, Any] = {f.name: with_paths(getattr(self, f.name), find_place) for f in fields(self)}
        stored |= {name: str(find_place(Path(stored[name]))) for name in self.may_be_files if stored[name]}
        stored["config"] = config_files.write_settings({"config": stored["config"]})
        storage.write_json(folder / RUN, {"kind": _kind(self), "version": VERSION, **stored})

    def ask_outside(self, folder: Path) -> str:
        """Return the question whether files outside of the folder are right, which the call names; empty without any.

        A folder may come from a stranger: nothing outside of it is changed before the user has read where it is.
        """
        named = [*paths_of(self), *(Path(text) for name in self.may_be_files if (text := getattr(self, name)))]
        home = folder.resolve()
        outside = [str(path) for path in named if path.is_absolute() and not path.resolve().is_relative_to(home)]
        return (f"{_file(folder)} names {', '.join(dict.fromkeys(outside))}, outside of {folder}: they are read, and "
                "what you change of them is saved there. If that is right, do it once more") if outside else ""

    @classmethod
    def read(cls: type[Of], folder: Path) -> Of:
        """Read the call kept in a folder.

        Raises
        ------
        StorageError
            The folder keeps no call of this command.
        """
        import msgspec

        path = _file(folder)
        if path is None:
            raise storage.StorageError(f"{folder}: it does not tell what it was made from, as what {cls.command} made "
                                       "earlier does not; run the same command once more")
        with storage.taking_apart(path, f"a {_kind(cls)}"):
            stored = storage.read_json(path, f"a {_kind(cls)}")
            if stored.pop("kind") != _kind(cls) or stored.pop("version") != VERSION:
                raise ValueError(f"kind and version are not those of a {_kind(cls)} that is known here")
            hints = typing.get_type_hints(cls)
            default_config: Callable[[], Settings] = hints["config"]
            config = config_files.parse_settings(stored.pop("config"), path, {"config": default_config()})["config"]
            # convert JSON values to the types of the fields: Path, text, keyword, tuples of these, or None
            return cls(**{name: msgspec.convert(value, hints[name], dec_hook=lambda kind, text: kind(text))
                          for name, value in stored.items()} | {"config": config})


def _file(folder: Path) -> Path | None:
    """Return the file with the call in a folder, or None."""
    return next((path for path in (folder / RUN, folder / HOME / RUN) if path.is_file()), None)


def _kind(call: KeptCall | type[KeptCall]) -> str:
    """Return the kind that is written into the file."""
    return CALL + call.command
