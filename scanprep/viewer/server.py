"""A local web server for one user: a page in the browser, with an app in Python behind it."""
from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import shutil
import socket
import tempfile
import threading
import time
import traceback
import webbrowser
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tornado.httpserver import HTTPServer
from tornado.iostream import IOStream
from tornado.netutil import bind_sockets
from tornado.web import Application

from .. import console
from ..interrupts import terminate_as_interrupt
from ..words import explain_os_error
from . import handlers
from .app import App, Send
from .gate import Gate, one_line
from .messages import Message
from .tabs import Tab, Tabs
from .worker import Stopped, Worker

__all__ = ["App", "Message", "Send", "Server", "Stopped", "serve"]

ADDRESS = "127.0.0.1"                # this machine only
GRACE = 0.5                          # seconds that running work gets to end
HERE = Path(__file__).parent


class _Door(HTTPServer):
    """The HTTP server; of too many connections without token it closes the oldest."""

    def initialize(self, *args: Any, **kwargs: Any) -> None:
        super().initialize(*args, **kwargs)
        self.strangers: list[IOStream] = []

    def handle_stream(self, stream: IOStream, address: tuple[str, int]) -> None:
        self.strangers = [one for one in self.strangers if not one.closed()]
        # a browser opens six; 64 leave room for a flood of strangers
        if len(self.strangers) >= 64:         # each uses a file handle, of which a process has few
            self.strangers.pop(0).close()
        self.strangers.append(stream)
        super().handle_stream(stream, address)


class Server:
    """An app served at an address, in a thread of its own, while the context is open.

    Parameters
    ----------
    app : App
        What is shown.
    port : int, optional
        By default any free one; ValueError for one that cannot be used.
    say : callable
        Called with a line of text for every refusal and unexpected error.
    script, style : str, optional
        Code of the page; by default that of the package.
    """

    def __init__(self, app: App, port: int | None = None, say: Callable[[str], None] = console.say,
                 script: str | None = None, style: str | None = None) -> None:
        self.app, self.say = app, say
        self.script = (HERE / "viewer.js").read_text(encoding="utf-8") if script is None else script
        self.style = (HERE / "viewer.css").read_text(encoding="utf-8") if style is None else style
        self._sockets = _listen(port)
        self.port: int = self._sockets[0].getsockname()[1]
        self.gate, self.tabs = Gate(self.port), Tabs()
        self._stopped, self._ready = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._run()), name="scapekit server", daemon=True)
        self._told: set[str] = set()

    @property
    def address(self) -> str:
        """Return the address of the page, with its token."""
        return f"http://{ADDRESS}:{self.port}/?token={self.gate.token}"

    def opening(self) -> str:
        """Return an address for one use, to hand to a browser."""
        return f"http://{ADDRESS}:{self.port}/?open={self.gate.opening()}"

    def __enter__(self) -> Server:
        self.dropped = Path(tempfile.mkdtemp(prefix="scapekit-"))
        self._worker = Worker("scapekit work", self._report_failure)
        self._greeter = Worker("scapekit greeting", self._report_failure)
        self._thread.start()
        assert self._ready.wait(10), "the server did not start"
        return self

    def __exit__(self, *exc: object) -> None:
        self._stopped.set()
        with contextlib.suppress(RuntimeError):          # the loop ended by itself
            self._loop.call_soon_threadsafe(self._ending.set)
        self._thread.join(GRACE)
        self._greeter.stop(0)
        self._worker.stop(GRACE)
        self.app.close()
        shutil.rmtree(self.dropped, ignore_errors=True)

    def send(self, message: Message) -> None:
        """Send a message to all tabs, from any thread; raises Stopped when the server has ended."""
        frame = message.pack()
        self._in_loop(lambda: self.tabs.put(frame, message.latest))

    def tab_opened(self, name: str, tab: Tab) -> None:
        """Greet a tab that opened or came back; afterwards it gets what all tabs get."""
        self.tabs.join(name, tab)

        def greet() -> None:
            greeting = []
            try:
                greeting = [(message.pack(), message.latest) for message in self.app.greet()]
            finally:
                self._in_loop(lambda: tab.greet([self.tabs.acknowledgement(name), *greeting]))

        self._greeter.put(greet)

    def accept_connection(self, connection: Any) -> None:
        """Note that the connection has shown the token: it is not closed for lack of room."""
        self._door.strangers = [one for one in self._door.strangers if one is not connection.stream]

    def take_in(self, name: str, message: Message) -> None:
        """Handle a message of a tab, once even if it arrives again."""
        if self.tabs.is_new(name, message.number):
            self._worker.put(lambda: self.app.handle(message, self.send), message.latest)
        self.tabs.acknowledge(name)

    def file_dropped(self, name: str, path: Path) -> None:
        """Receive an uploaded file in its turn, and remove it."""
        def receive() -> None:
            try:
                self.app.receive(name, path, self.send)
            except ValueError as problem:                # call the file by the name that the user knows
                raise ValueError(str(problem).replace(str(path), name)) from problem
            finally:
                shutil.rmtree(path.parent, ignore_errors=True)

        self._worker.put(receive)

    def _in_loop(self, job: Callable[[], None]) -> None:
        """Run a job in the thread of the event loop; raises Stopped when that has ended."""
        try:
            if self._stopped.is_set():
                raise Stopped
            self._loop.call_soon_threadsafe(job)
        except RuntimeError:
            raise Stopped from None

    def _report_failure(self, problem: BaseException) -> None:
        """Report a failed job to the tabs; an unexpected error also once in the terminal."""
        text = explain_os_error(problem, "the file") if isinstance(problem, OSError) else str(problem)
        if not isinstance(problem, ValueError | OSError):
            text = f"unexpected {type(problem).__name__}: {problem}"
            traceback_text = "\n".join(map(one_line, "".join(traceback.format_exception(problem)).splitlines()))
            if traceback_text not in self._told:
                self._told.add(traceback_text)
                self.say(traceback_text)
        with contextlib.suppress(Stopped):
            self.send(Message("error", {"text": text}))

    async def _run(self) -> None:
        """Serve until the end is asked for, then close all connections."""
        own = {"server": self}
        routes = [(r"/", handlers.PageHandler, own), (r"/socket", handlers.Socket, own), (r"/drop", handlers.Drop, own),
                  (r"/alive", handlers.Alive, own), (r"/file/(.*)", handlers.Download, own)]
        application = Application(
            routes, default_handler_class=handlers.Unknown, default_handler_args=own,      # type: ignore[arg-type]
            log_function=lambda handler: None, websocket_max_message_size=handlers.LARGEST_MESSAGE,
            websocket_ping_interval=30)
        # a megabyte is plenty for any request but an upload
        self._door = http_server = _Door(application, max_body_size=(2**20))
        http_server.add_sockets(self._sockets)
        self._loop, self._ending = asyncio.get_running_loop(), asyncio.Event()
        self._ready.set()
        await self._ending.wait()
        http_server.stop()
        self.tabs.close()
        with contextlib.suppress(asyncio.TimeoutError):
            await asyncio.wait_for(http_server.close_all_connections(), GRACE / 2)


def serve(app: App, port: int | None = None, open_browser: bool = True, say: Callable[[str], None] = console.say
          ) -> None:
    """Show an app in the browser until Ctrl-C or SIGTERM.

    Parameters
    ----------
    app : App
        What is shown.
    port : int, optional
        By default any free one.
    open_browser : bool
        Start the browser of this machine, unless the user is logged in from another one.
    say : callable
        Called with each line for the terminal.
    """
    remote = "SSH_CONNECTION" in os.environ
    with contextlib.suppress(KeyboardInterrupt), terminate_as_interrupt(), Server(app, port, say) as server:
        say(f"{one_line(app.title)}: {server.address}")
        say("Ctrl-C ends it")
        if remote or not open_browser:
            say(f"from another machine: ssh -N -L {server.port}:{ADDRESS}:{server.port} {socket.gethostname()}")
        elif _has_screen():
            webbrowser.open(server.opening())
        while True:
            time.sleep(0.2)                  # seconds: on Windows Ctrl-C does not interrupt a sleep


def _listen(port: int | None) -> list[socket.socket]:
    """Open sockets for this machine only; ValueError for a port that cannot be used."""
    if port is not None and not 0 < port < 2**16:
        raise ValueError(f"port: expected a number from 1 to {2**16 - 1}, got {port}")
    try:
        return bind_sockets(port or 0, ADDRESS)
    except OSError as problem:
        why = "is in use by another program" if problem.errno == errno.EADDRINUSE else problem.strerror
        raise ValueError(f"port: {port} {why}; without a port a free one is taken") from None


def _has_screen() -> bool:
    """Return whether a graphical browser can start here."""
    return os.name == "nt" or os.uname().sysname == "Darwin" or bool(
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
