"""A local web server for one user: a page in the browser, with an app in Python behind it."""
from __future__ import annotations

import contextlib
import errno
import os
import secrets
import socket
import socketserver
import sys
import threading
import time
import traceback
import webbrowser
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs

from .. import console
from ..interrupts import terminate_as_interrupt
from ..words import explain_os_error
from .app import App, Send, Stopped
from .gate import Gate, one_line
from .messages import Message
from .served_page import HEADERS, NOTHING, page, policy

__all__ = ["App", "Message", "Send", "Server", "Stopped", "serve"]

ADDRESS = "127.0.0.1"                # this machine only
GRACE = 0.5                          # seconds that running work gets to end
QUIET = 20                           # seconds after which a request for a message is answered without: tunnels live on
LARGEST_MESSAGE = 2**24              # bytes: clicks and sliders need a few hundred
HERE = Path(__file__).parent


class Server:
    """An app served at an address, in threads of its own, while the context is open.

    One page shows the app; a second one takes its place.

    Parameters
    ----------
    app : App
        What is shown.
    port : int, optional
        By default any free one; ValueError for one that cannot be used.
    say : callable
        Called with a line of text for every refusal and unexpected error.
    """

    def __init__(self, app: App, port: int | None = None, say: Callable[[str], None] = console.say) -> None:
        self.app, self.say = app, say
        self.script = (HERE / "viewer.js").read_text(encoding="utf-8")
        self.style = (HERE / "viewer.css").read_text(encoding="utf-8")
        self._door = self._open_door(port)
        self.port: int = self._door.server_address[1]
        self.gate = Gate(self.port)
        # the page, the number of its connection, and the number of the last message that it sent
        self._page, self._turn, self._last = "", "", 0
        self._frames: dict[str, bytes] = {}              # what the page still has to get: the latest of each key
        self._news, self._working = threading.Condition(), threading.Lock()
        self._stopped = False
        self._told: set[str] = set()

    def _open_door(self, port: int | None) -> Door:
        """Listen on this machine only; ValueError for a port that cannot be used."""
        if port is not None and not 0 < port < 2**16:
            raise ValueError(f"port: expected a number from 1 to {2**16 - 1}, got {port}")
        try:
            return Door((ADDRESS, port or 0), self)
        except OSError as problem:
            why = "is in use by another program" if problem.errno == errno.EADDRINUSE else problem.strerror
            raise ValueError(f"port: {port} {why}; without a port a free one is taken") from None

    @property
    def address(self) -> str:
        """Return the address of the page, with its token."""
        return f"http://{ADDRESS}:{self.port}/?token={self.gate.token}"

    def opening(self) -> str:
        """Return an address for one use, to hand to a browser."""
        return f"http://{ADDRESS}:{self.port}/?open={self.gate.opening()}"

    def __enter__(self) -> Server:
        # asked ten times a second whether it shall end
        threading.Thread(target=self._door.serve_forever, args=(0.1,), name="scapekit server", daemon=True).start()
        return self

    def __exit__(self, *exc: object) -> None:
        with self._news:
            self._stopped = True
            self._news.notify_all()
        self._door.shutdown()
        self._door.server_close()
        if self._working.acquire(timeout=GRACE):
            self._working.release()

    def send(self, message: Message) -> None:
        """Send a message to the page, from any thread; raises Stopped when the server has ended."""
        frame = message.pack()
        with self._news:
            if self._stopped:
                raise Stopped
            self._put(message, frame)
            self._news.notify_all()

    def _put(self, message: Message, frame: bytes) -> None:
        """Queue a message as the last; it replaces a waiting one of its key, without one of its kind."""
        key = message.latest or message.kind
        self._frames.pop(key, None)
        self._frames[key] = frame

    def greet(self, page: str, turn: str) -> None:
        """Greet a page that opened or came back, ahead of all messages since."""
        with self._news:
            if page != self._page:
                self._last = 0
            self._page, self._turn, self._frames = page, turn, {}
            self._news.notify_all()
        try:
            greeting = [(message, message.pack()) for message in self.app.greet()]
        except Exception as problem:
            self._report_failure(problem)
            return
        with self._news:
            if (page, turn) == (self._page, self._turn):
                since, self._frames = self._frames, {}
                for message, frame in greeting:
                    self._put(message, frame)
                for key, frame in since.items():
                    self._frames.pop(key, None)
                    self._frames[key] = frame

    def next_frame(self, page: str, turn: str) -> bytes | None:
        """Wait for the next message for the page; empty after a while, None where another page took its place."""
        with self._news:
            self._news.wait_for(lambda: self._frames or self._stopped or (page, turn) != (self._page, self._turn),
                                QUIET)
            if self._stopped:
                raise Stopped
            if (page, turn) != (self._page, self._turn):
                return None
            key = next(iter(self._frames), None)
            return b"" if key is None else self._frames.pop(key)

    def take_in(self, page: str, message: Message) -> bool:
        """Act on a message of the page, once even if it arrives again; False where another page took its place."""
        with self._working:
            if self._stopped:
                raise Stopped
            if page != self._page:
                return False
            if message.number > self._last:
                self._last = message.number
                try:
                    self.app.handle(message, self.send)
                except (Exception, SystemExit) as problem:
                    self._report_failure(problem)
            return True

    def _report_failure(self, problem: BaseException) -> None:
        """Report what failed to the page; an unexpected error also once in the terminal."""
        text = explain_os_error(problem, "the file") if isinstance(problem, OSError) else str(problem)
        if not isinstance(problem, ValueError | OSError):
            text = f"unexpected {type(problem).__name__}: {problem}"
            traceback_text = "\n".join(map(one_line, "".join(traceback.format_exception(problem)).splitlines()))
            if traceback_text not in self._told:
                self._told.add(traceback_text)
                self.say(traceback_text)
        with contextlib.suppress(Stopped):
            self.send(Message("error", {"text": text}))


class RefusedError(Exception):
    """A request that is refused, with the reason for the terminal."""

    def __init__(self, status: int, why: str) -> None:
        super().__init__(why)
        self.status = status


class Door(socketserver.ThreadingTCPServer):
    """The listening socket; of too many connections without token it closes the oldest."""

    daemon_threads = True
    request_queue_size = 128                             # connections that wait while others are accepted
    allow_reuse_address = sys.platform != "win32"        # there it would let another program take the port

    def __init__(self, address: tuple[str, int], app_server: Server) -> None:
        self.app_server = app_server
        self.strangers: dict[socket.socket, None] = {}
        super().__init__(address, Request)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Start the thread of a connection."""
        # a browser opens six; 64 leave room for a flood of strangers, and each uses a thread and a file handle
        if len(self.strangers) >= 64:
            oldest = next(iter(list(self.strangers)))    # a copy: other threads take some away
            self.strangers.pop(oldest, None)
            with contextlib.suppress(OSError):           # it ended by itself
                oldest.shutdown(socket.SHUT_RDWR)
        self.strangers[request] = None
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        """Close a connection."""
        self.strangers.pop(request, None)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Report what went wrong in a thread, but that a browser went away."""
        if not isinstance(sys.exc_info()[1], OSError):
            self.app_server.say(traceback.format_exc().rstrip())


class Request(BaseHTTPRequestHandler):
    """One connection of a browser, and its requests one after the other."""

    server: Door
    protocol_version = "HTTP/1.1"
    timeout = 60                         # seconds that a connection may be silent
    disable_nagle_algorithm = True       # else the end of an answer waits
    wbufsize = -1                        # headers and body leave together

    def do_GET(self) -> None:
        """Answer with the page."""
        self._answer({"/": self._page}, acts=False)

    def do_POST(self) -> None:
        """Answer to what changes something."""
        self._answer({"/messages": self._next_message, "/message": self._take_message}, acts=True)

    def _answer(self, routes: dict[str, Callable[[], None]], acts: bool) -> None:
        """Check a request, and answer it or refuse it."""
        path, _, query = self.path.partition("?")
        self.query = {name: values[-1] for name, values in parse_qs(query).items()}
        try:
            self._check(self.server.app_server.gate, path, acts)
            self.server.strangers.pop(self.connection, None)
            if path not in routes:
                raise RefusedError(404, "no such address")
            routes[path]()
        except RefusedError as refusal:
            self.send_error(refusal.status, str(refusal))
        except Stopped:
            self.close_connection = True                 # without an answer, as a server that is gone

    def _check(self, gate: Gate, path: str, acts: bool) -> None:
        """Refuse wrong hosts and tokens, and wrong origins where the request changes something."""
        host, origin = self.headers.get("Host", ""), self.headers.get("Origin")
        if gate.wrong_host(host):
            raise RefusedError(403, f"foreign Host {host}")
        if acts and gate.wrong_origin(host, origin):
            raise RefusedError(403, f"foreign Origin {origin or '(none)'}")
        # plainly taken apart: cookies of other programs on this machine may be of any form
        cookies = dict(part.strip().partition("=")[::2] for part in self.headers.get("Cookie", "").split(";"))
        opened = path == "/" and "open" in self.query and gate.use(self.query["open"])
        if not opened and gate.wrong_token(self.query.get("token"), cookies.get(gate.cookie)):
            raise RefusedError(403, "wrong or missing token")
        if self.query.get("server", gate.server) != gate.server:
            raise RefusedError(403, "a page of an earlier server")

    def _page(self) -> None:
        """Send the page; a cookie replaces the token, so that it can be loaded again."""
        app_server, nonce = self.server.app_server, secrets.token_urlsafe(16)
        app, gate = app_server.app, app_server.gate
        text = page(app.title, app.name, app_server.script, app_server.style, gate.server, nonce)
        self._send(200, text.encode("utf-8"), "text/html; charset=utf-8", {
            "Content-Security-Policy": policy(nonce),
            "Set-Cookie": f"{gate.cookie}={gate.token}; HttpOnly; Path=/; SameSite=Strict"})

    def _next_message(self) -> None:
        """Send the next message for the page, as soon as there is one."""
        self._body()
        which = self.query.get("page", ""), self.query.get("turn", "")
        if "greet" in self.query:
            self.server.app_server.greet(*which)
        frame = self.server.app_server.next_frame(*which)
        self._send(409 if frame is None else 200, frame or b"")

    def _take_message(self) -> None:
        """Act on a message of the page."""
        try:
            message = Message.unpack(self._body())
        except ValueError as problem:
            raise RefusedError(400, str(problem)) from None
        known = self.server.app_server.take_in(self.query.get("page", ""), message)
        self._send(200 if known else 409)

    def _body(self) -> bytes:
        """Read the body of a request; it is refused by its announced length."""
        length = self.headers.get("Content-Length", "")
        if not (length.isascii() and length.isdecimal()) or "Transfer-Encoding" in self.headers:
            raise RefusedError(411, "expected the length of the message")
        # no number of more than 20 digits is a length
        if len(length) > 20 or int(length) > LARGEST_MESSAGE:
            raise RefusedError(413, f"a message of more than {LARGEST_MESSAGE} bytes")
        return self.rfile.read(int(length))

    def _send(self, status: int, body: bytes = b"", kind: str = "application/octet-stream",
              headers: dict[str, str] | None = None) -> None:
        """Send an answer with the headers that protect the page."""
        self.send_response_only(status)
        own = {"Content-Security-Policy": NOTHING, "Content-Type": kind, "Content-Length": str(len(body))}
        for name, value in {**HEADERS, **own, **(headers or {})}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Refuse a request, and report it in the terminal without the token."""
        path = getattr(self, "path", "").partition("?")[0]
        why = message or self.responses.get(code, ("",))[0]
        self.server.app_server.say(one_line(f"refused: {self.command or '?'} {path}: {why}"))
        text = "Refused: open the address that the terminal shows." if code == 403 else self.responses[code][0]
        self.close_connection = True             # its body was not read
        self._send(code, f"{text}\n".encode(), "text/plain; charset=utf-8", {"Connection": "close"})

    def log_message(self, format: str, *args: Any) -> None:
        """Write no line for every request."""


def serve(app: App, port: int | None = None, open_browser: bool = True) -> None:
    """Show an app in the browser until Ctrl-C or SIGTERM.

    Parameters
    ----------
    app : App
        What is shown.
    port : int, optional
        By default any free one.
    open_browser : bool
        Start the browser of this machine, unless the user is logged in from another one.
    """
    remote = "SSH_CONNECTION" in os.environ
    with contextlib.suppress(KeyboardInterrupt), terminate_as_interrupt(), Server(app, port) as server:
        console.say(f"{one_line(app.title)}: {server.address}")
        console.say("Ctrl-C ends it")
        if remote or not open_browser:
            console.say(f"from another machine: ssh -N -L {server.port}:{ADDRESS}:{server.port} {socket.gethostname()}")
        elif _has_screen():
            webbrowser.open(server.opening())
        while True:
            time.sleep(0.2)                  # seconds: on Windows Ctrl-C does not interrupt a sleep


def _has_screen() -> bool:
    """Return whether a graphical browser can start here."""
    return os.name == "nt" or os.uname().sysname == "Darwin" or bool(
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
