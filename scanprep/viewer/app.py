"""What a command has to be to show itself in the browser."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

from .messages import Message

Send = Callable[[Message], None]


class App(Protocol):
    """What a command puts into the browser: one user, several tabs that show the same state.

    `handle` and `receive` run one at a time, in one thread. `greet` runs in another, also while they work, so that a
    page can be loaded again meanwhile: it is quick and only reads. Change the state first, then send what changed.
    """

    title: str
    name: str                        # front end of the bundle: "view", "pick", "complete"
    folders: Sequence[Path]          # from which files may be downloaded

    def greet(self) -> list[Message]:
        """What a tab that opens, or returns, needs to show the present state."""
        ...

    def handle(self, message: Message, send: Send) -> None:
        """A message of a tab; `send` goes to all tabs and raises Stopped when the server has ended."""
        ...

    def receive(self, name: str, path: Path, send: Send) -> None:
        """A file dropped on the page; it is removed afterwards. ValueError for one that is not wanted."""
        ...

    def close(self) -> None:
        """The server ended; a job that does not call `send` may still run."""
        ...
