"""The things of a view: which exist, what is known of them, and which are shown."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from .contents import Content
from .files import Entry, Files
from .movable import MovableBody
from .statues import movable

MOST = 12                            # things shown at a time: more are too small to see
T = TypeVar("T")


class Things:
    """Entries by number, and the contents of those that are shown.

    Attributes
    ----------
    entries : list of Entry
    shown : list of int
    contents, bodies : dict
        Contents of the shown things, and the bodies of those that are models.
    problems, about : dict
        Why a thing cannot be read; a description of one that was.
    """

    def __init__(self, entries: Sequence[Entry], files: Files) -> None:
        self.entries, self.files = list(entries), files
        self.shown: list[int] = []
        self.contents: dict[int, Content] = {}
        self.bodies: dict[int, MovableBody] = {}
        self.problems: dict[int, str] = {}
        self.about: dict[int, str] = {}

    def read(self, wanted: Sequence[int]) -> list[int]:
        """Read entries; return those that could be read."""
        if len(wanted) > MOST:
            raise ValueError(f"at most {MOST} can be shown at a time")
        read: list[int] = []
        for i in wanted:
            try:
                if i not in self.contents:
                    content = self.entries[i].load()
                    self.contents[i] = replace(content, name=self.entries[i].name,
                                               stance=content.start or content.stance)
                    self.about[i] = content.about
                model = self.contents[i].model
                if model is not None and i not in self.bodies:
                    self.bodies[i] = movable(model, self.contents[i].statue)
            except (ValueError, OSError) as problem:
                self.problems[i] = str(problem)
            else:
                self.problems.pop(i, None)
                read.append(i)
        return read

    def put(self, read: Sequence[int]) -> None:
        """Show what was read, and release the rest."""
        self.shown = list(read)
        self.contents = {i: self.contents[i] for i in read}
        self.bodies = {i: body for i, body in self.bodies.items() if i in read}

    def join(self, path: Path) -> None:
        """Show the things of one more file or folder with the others; ValueError where none can be shown.

        After an error everything is as before. Things that stay keep their contents; those that have changed are read
        again.
        """
        known = self.files.known
        before = self.entries, self.problems, self.contents, self.bodies, self.about
        try:
            # new numbers of the entries that stay; entries that are new, or changed while shown
            entries = self.files.with_another(self.entries, path)
            place = {i: entries.index(entry) for i, entry in enumerate(self.entries) if entry in entries}
            fresh = [i for i in range(len(entries)) if i not in place.values()]
            changed = {self.entries[i].path for i in self.shown if i not in place}
            new = [i for i in fresh if entries[i].path in changed] or [i for i in fresh if entries[i].first] \
                or fresh[:1]
            self.problems, self.about = _renumber(self.problems, place), _renumber(self.about, place)
            self.contents, self.bodies = _renumber(self.contents, place), _renumber(self.bodies, place)
            self.entries = entries
            read = self.read(sorted([*(place[i] for i in self.shown if i in place), *new][-MOST:]))
            if not set(new) & set(read):
                raise ValueError(self.problems[new[0]])
        except (ValueError, OSError):
            self.files.known = known
            self.entries, self.problems, self.contents, self.bodies, self.about = before
            raise
        self.put(read)


def _renumber(known: dict[int, T], place: dict[int, int]) -> dict[int, T]:
    """Return a mapping with new numbers, without things that are gone."""
    return {place[i]: one for i, one in known.items() if i in place}
