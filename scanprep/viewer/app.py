"""The interface of a command that shows itself in the browser."""
from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from .messages import Message

Send = Callable[[Message], None]


class Stopped(BaseException):
    """The server has ended: jobs let this exception pass. It is no Exception, so that no handler swallows it."""


class App(Protocol):
    """What a command shows in the browser, on one page.

    `handle` runs for one message at a time. `greet` runs even while it works, so that the page can be loaded again
    meanwhile: it must be quick and only read. Change the state first, then send the change.
    """

    title: str
    name: str                        # front end of the bundle: "view", "pick", "complete"

    def greet(self) -> list[Message]:
        """Return what a new or reloaded page needs to show the present state."""
        ...

    def handle(self, message: Message, send: Send) -> None:
        """Act on a message of the page; `send` raises Stopped when the server has ended."""
        ...
