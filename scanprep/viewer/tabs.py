"""The open tabs of one user: what each is still to be told, and which of its messages were taken in."""
from __future__ import annotations

import asyncio
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Iterable

from .messages import Message
from .waiting import Waiting

LONGEST_QUEUE = 2**29                # bytes that wait for one tab; beyond, it is closed, and greeted when it returns

Frames = Iterable[tuple[bytes, str]]


class Tab:
    """One connection, used in the thread of the event loop only.

    Parameters
    ----------
    write : (frame) -> Awaitable
        Ready when the socket takes more.
    close : () -> None
        Ends the connection.
    """

    def __init__(self, write: Callable[[bytes], Awaitable[None]], close: Callable[[], None]) -> None:
        self._write, self._close = write, close
        self._waiting: Waiting[bytes] = Waiting()
        self._size = 0
        self._greeted = self._closed = False
        self._writer: asyncio.Task[None] | None = None

    def put(self, frame: bytes, key: str = "") -> None:
        """Write a frame when its turn comes, and the greeting has gone ahead."""
        if self._closed:
            return
        old = self._waiting.put(frame, key)
        self._size += len(frame) - len(old or b"")
        if self._size > LONGEST_QUEUE:
            self.close()
        elif self._greeted and self._writer is None:
            self._writer = asyncio.get_running_loop().create_task(self._write_all())

    def greet(self, frames: Frames) -> None:
        """The present state, ahead of what was told to all tabs since it was asked for."""
        later, self._waiting, self._size, self._greeted = self._waiting, Waiting(), 0, True
        for frame, key in frames:
            self.put(frame, key)
        while len(later):
            key, frame = later.take()
            self.put(frame, key)

    def close(self) -> None:
        """End the connection; what waits is forgotten."""
        if not self._closed:
            self._closed, self._waiting = True, Waiting()
            self._close()

    async def _write_all(self) -> None:
        try:
            while len(self._waiting):
                frame = self._waiting.take()[1]
                self._size -= len(frame)
                await self._write(frame)
        except Exception:            # the socket was closed meanwhile; the tab returns by itself
            self.close()
        finally:
            self._writer = None


class Tabs:
    """All open tabs by the name that each gave itself, used in the thread of the event loop only."""

    def __init__(self) -> None:
        self._open: dict[str, Tab] = {}
        self._last: OrderedDict[str, int] = OrderedDict()

    def __len__(self) -> int:
        return len(self._open)

    def join(self, name: str, tab: Tab) -> None:
        """A tab that opened or came back; its earlier connection, if it seems to be there, is closed."""
        old = self._open.get(name)
        self._open[name] = tab
        if old is not None:
            old.close()
        self._remember(name, self._last.get(name, 0))

    def leave(self, name: str, tab: Tab) -> None:
        """A connection that ended."""
        if self._open.get(name) is tab:
            del self._open[name]

    def is_new(self, name: str, number: int) -> bool:
        """Whether this message of a tab was not taken in before; a tab sends again what was not acknowledged."""
        if not number:
            return True
        new = number > self._last.get(name, 0)
        if new:
            self._remember(name, number)
        return new

    def acknowledge(self, name: str) -> None:
        """Tell a tab which of its messages was the last that was taken in."""
        if name in self._open:
            self._open[name].put(*self.acknowledgement(name))

    def acknowledgement(self, name: str) -> tuple[bytes, str]:
        """The same as a frame and its key."""
        acknowledged = "acknowledged"
        return Message(acknowledged, {"number": self._last.get(name, 0)}).pack(), acknowledged

    def put(self, frame: bytes, key: str = "") -> None:
        """Tell every tab."""
        for tab in list(self._open.values()):
            tab.put(frame, key)

    def close(self) -> None:
        """End all connections."""
        for tab in list(self._open.values()):
            tab.close()

    def _remember(self, name: str, number: int) -> None:
        self._last[name] = number
        self._last.move_to_end(name)
        # tabs whose last message is known
        while len(self._last) > 4096:
            self._last.popitem(last=False)
