"""The interface of a command that shows itself in the browser."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

from .messages import Message

Send = Callable[[Message], None]


class App(Protocol):
    """What a command shows in the browser: one user, several tabs with the same state.

    `handle` and `receive` run one at a time, in one thread. `greet` runs in another thread, even while they work, so
    that the page can be loaded again meanwhile: it must be quick and only read. Change the state first, then send the
    change.
    """

    title: str
    name: str                        # front end of the bundle: "view", "pick", "complete"
    folders: Sequence[Path]          # folders whose files may be downloaded

    def greet(self) -> list[Message]:
        """Return what a new or returning tab needs to show the present state."""
        ...

    def handle(self, message: Message, send: Send) -> None:
        """Act on a message of a tab; `send` goes to all tabs, and raises Stopped when the server has ended."""
        ...

    def receive(self, name: str, path: Path, send: Send) -> None:
        """Take a file dropped on the page, which is removed afterwards; ValueError for one that is not wanted."""
        ...

    def close(self) -> None:
        """React to the end of the server; a job that does not call `send` may still run."""
        ...
