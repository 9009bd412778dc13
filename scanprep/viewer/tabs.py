"""The open tabs of one user: what each still has to get, and which of its messages were received."""
from __future__ import annotations

import asyncio
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Iterable

from .messages import Message
from .waiting import Waiting

LONGEST_QUEUE = 2**29                # bytes waiting for one tab; with more it is closed, and greeted when it returns

Frames = Iterable[tuple[bytes, str]]


class Tab:
    """One connection; used only in the thread of the event loop.

    Parameters
    ----------
    write : callable
        Writes a frame; the awaitable it returns is ready when the socket takes more.
    close : callable
        Ends the connection.
    """

    def __init__(self, write: Callable[[bytes], Awaitable[None]], close: Callable[[], None]) -> None:
        self._write, self._close = write, close
        self._waiting: Waiting[bytes] = Waiting()
        self._size = 0
        self._greeted = self._closed = False
        self._writer: asyncio.Task[None] | None = None

    def put(self, frame: bytes, key: str = "") -> None:
        """Queue a frame; it is written in its turn, after the greeting."""
        if self._closed:
            return
        old = self._waiting.put(frame, key)
        self._size += len(frame) - len(old or b"")
        if self._size > LONGEST_QUEUE:
            self.close()
        elif self._greeted and self._writer is None:
            self._writer = asyncio.get_running_loop().create_task(self._write_all())

    def greet(self, frames: Frames) -> None:
        """Write the present state, ahead of all messages since it was asked for."""
        later, self._waiting, self._size, self._greeted = self._waiting, Waiting(), 0, True
        for frame, key in frames:
            self.put(frame, key)
        while len(later):
            key, frame = later.take()
            self.put(frame, key)

    def close(self) -> None:
        """End the connection and forget what waits."""
        if not self._closed:
            self._closed, self._waiting = True, Waiting()
            self._close()

    async def _write_all(self) -> None:
        """Write what waits, one frame after the other."""
        try:
            while len(self._waiting):
                frame = self._waiting.take()[1]
                self._size -= len(frame)
                await self._write(frame)
        except Exception:            # the socket was closed meanwhile; the tab connects again by itself
            self.close()
        finally:
            self._writer = None


class Tabs:
    """All open tabs by the name that each gave itself; used only in the thread of the event loop."""

    def __init__(self) -> None:
        self._open: dict[str, Tab] = {}
        self._last: OrderedDict[str, int] = OrderedDict()

    def __len__(self) -> int:
        return len(self._open)

    def join(self, name: str, tab: Tab) -> None:
        """Add a tab that opened or came back, and close its earlier connection."""
        old = self._open.get(name)
        self._open[name] = tab
        if old is not None:
            old.close()
        self._remember(name, self._last.get(name, 0))

    def leave(self, name: str, tab: Tab) -> None:
        """Remove a connection that ended."""
        if self._open.get(name) is tab:
            del self._open[name]

    def is_new(self, name: str, number: int) -> bool:
        """Return whether a message was not received before; tabs send again what was not acknowledged."""
        if not number:
            return True
        new = number > self._last.get(name, 0)
        if new:
            self._remember(name, number)
        return new

    def acknowledge(self, name: str) -> None:
        """Tell a tab which of its messages was received last."""
        if name in self._open:
            self._open[name].put(*self.acknowledgement(name))

    def acknowledgement(self, name: str) -> tuple[bytes, str]:
        """Return that message as a frame and its key."""
        acknowledged = "acknowledged"
        return Message(acknowledged, {"number": self._last.get(name, 0)}).pack(), acknowledged

    def put(self, frame: bytes, key: str = "") -> None:
        """Send a frame to every tab."""
        for tab in list(self._open.values()):
            tab.put(frame, key)

    def close(self) -> None:
        """End all connections."""
        for tab in list(self._open.values()):
            tab.close()

    def _remember(self, name: str, number: int) -> None:
        """Remember the number of the last message of a tab."""
        self._last[name] = number
        self._last.move_to_end(name)
        # 4096 tabs are far more than a user opens; without a limit the memory would grow
        while len(self._last) > 4096:
            self._last.popitem(last=False)
