"""Request handlers of the server: the page, its socket, uploads of dropped files, downloads."""
from __future__ import annotations

import contextlib
import re
import secrets
import shutil
import tempfile
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import quote

from tornado.iostream import StreamClosedError
from tornado.web import HTTPError, RequestHandler, stream_request_body
from tornado.websocket import WebSocketHandler

from .app import App
from .gate import Gate, file_inside, file_name, one_line
from .messages import Message
from .served_page import HEADERS, NOTHING, page, policy
from .tabs import Tab, Tabs

LARGEST_MESSAGE = 2**24              # bytes: clicks and sliders need a few hundred
LARGEST_FILE = 2**30                 # bytes of a dropped file; larger scans are named on the command line
PIECE = 2**20                        # bytes of a download in memory at a time


class Serving(Protocol):
    """What the handlers need of their server."""

    app: App
    gate: Gate
    tabs: Tabs
    say: Callable[[str], None]
    script: str
    style: str
    dropped: Path

    def tab_opened(self, name: str, tab: Tab) -> None:
        """Welcome a tab that opened or came back."""
        ...

    def accept_connection(self, connection: Any) -> None:
        """Note that the connection has shown the token."""
        ...

    def take_in(self, name: str, message: Message) -> None:
        """Act on a message of a tab."""
        ...

    def file_dropped(self, name: str, path: Path) -> None:
        """Act on an uploaded file."""
        ...


class RefusedError(HTTPError):
    """A request that is refused, with the reason for the terminal."""

    def __init__(self, status: int, why: str) -> None:
        super().__init__(status)
        self.why = why


class Guarded(RequestHandler):
    """A request handler that refuses wrong hosts and tokens, and wrong origins where the request changes something."""

    acts = False

    def initialize(self, server: Serving) -> None:
        self.server = server

    def set_default_headers(self) -> None:
        self.clear_header("Server")
        for name, value in HEADERS.items():
            self.set_header(name, value)
        self.set_header("Content-Security-Policy", NOTHING)

    def prepare(self) -> None:
        gate, host = self.server.gate, self.request.host
        if gate.wrong_host(host):
            raise RefusedError(403, f"foreign Host {host}")
        if self.acts and gate.wrong_origin(host, self.request.headers.get("Origin")):
            raise RefusedError(403, f"foreign Origin {self.request.headers.get('Origin', '(none)')}")
        if not self.passes():
            raise RefusedError(403, "wrong or missing token")
        if self.get_query_argument("server", gate.server) != gate.server:
            raise RefusedError(403, "a page of an earlier server")
        self.server.accept_connection(self.request.connection)

    def passes(self) -> bool:
        """Return whether the request has the token."""
        gate = self.server.gate
        return not gate.wrong_token(self.get_query_argument("token", None), self.get_cookie(gate.cookie))

    def report_refusal(self, why: str) -> None:
        """Report a refusal in the terminal, without the token."""
        self.server.say(one_line(f"refused: {self.request.method} {self.request.path}: {why}"))

    def log_exception(self, typ: Any, value: BaseException | None, tb: Any) -> None:
        if isinstance(value, HTTPError):
            self.report_refusal(getattr(value, "why", str(value)))
        else:
            self.server.say("".join(traceback.format_exception(typ, value, tb)).rstrip())

    def write_error(self, status_code: int, **kwargs: Any) -> None:
        self.set_header("Content-Type", "text/plain; charset=utf-8")
        text = "Refused: open the address that the terminal shows." if status_code == 403 else self._reason
        self.finish(f"{text}\n")


class Unknown(Guarded):
    """Any other address: refused."""

    def prepare(self) -> None:
        super().prepare()
        raise RefusedError(404, "no such address")


class Alive(Guarded):
    """Tells a page that lost its connection whether its server still runs."""

    def get(self) -> None:
        self.set_status(204)


class PageHandler(Guarded):
    """The page; a cookie replaces the token, so that it can be loaded again."""

    def passes(self) -> bool:
        opening = self.get_query_argument("open", None)
        return super().passes() if opening is None else self.server.gate.use(opening) or super().passes()

    def get(self) -> None:
        server, nonce = self.server, secrets.token_urlsafe(16)
        self.set_cookie(server.gate.cookie, server.gate.token, httponly=True, samesite="Strict", path="/")
        self.set_header("Content-Security-Policy", policy(self.request.host, nonce))
        self.finish(page(server.app.title, server.app.name, server.script, server.style, server.gate.server, nonce))


class Socket(Guarded, WebSocketHandler):
    """The connection of one tab."""

    # names that tabs give themselves
    TAB = re.compile(r"[\w-]{8,64}", re.ASCII)

    acts = True

    def prepare(self) -> None:
        super().prepare()
        self.tab_name = self.get_query_argument("tab", "")
        if not self.TAB.fullmatch(self.tab_name):
            raise RefusedError(400, "expected the name of a tab")

    def get_websocket_protocol(self) -> Any:
        protocol = super().get_websocket_protocol()
        if protocol is not None:
            # code 1009 is a message that is too large: tornado closes the connection without telling us
            close = protocol.close

            def close_and_report(code: int | None = None, reason: str | None = None) -> None:
                if code == 1009:
                    self.report_refusal(f"a message of more than {LARGEST_MESSAGE} bytes")
                close(code, reason)

            protocol.close = close_and_report           # type: ignore[method-assign]
        return protocol

    def open(self, *args: str, **kwargs: str) -> None:
        self.set_nodelay(True)

        async def write(frame: bytes) -> None:
            await self.write_message(frame, binary=True)

        self.tab = Tab(write, self.end)
        self.server.tab_opened(self.tab_name, self.tab)

    def end(self) -> None:
        """Close the connection, without waiting for a tab that reads nothing."""
        stream = getattr(self.ws_connection, "stream", None)
        behind = stream is not None and stream.writing()     # checked now, as the closing message may empty the buffer
        self.close(1001)
        if stream is not None and behind:
            stream.close()

    def on_message(self, message: str | bytes) -> None:
        try:
            self.server.take_in(self.tab_name, Message.unpack(message))
        except ValueError as problem:
            self.report_refusal(str(problem))
            self.close(1003)

    def on_close(self) -> None:
        if hasattr(self, "tab"):
            self.server.tabs.leave(self.tab_name, self.tab)


@stream_request_body
class Drop(Guarded):
    """A file dropped on the page, written to a temporary folder as it arrives."""

    TOO_LARGE = f"a file of more than {LARGEST_FILE} bytes"

    acts = True

    def prepare(self) -> None:
        self.folder: Path | None = None
        super().prepare()
        if self.request.method != "POST":
            raise RefusedError(405, "only POST")
        try:
            self.name = file_name(self.get_query_argument("name", ""))
            expected = int(self.request.headers.get("Content-Length", 0))
        except ValueError as problem:
            raise RefusedError(400, str(problem)) from None
        # refuse by the announced size; what really comes is counted too
        if expected > LARGEST_FILE:
            raise RefusedError(413, self.TOO_LARGE)
        self.request.connection.set_max_body_size(LARGEST_FILE + PIECE)     # type: ignore[union-attr]
        try:
            self.folder = Path(tempfile.mkdtemp(dir=self.server.dropped))
            self.out = open(self.folder / self.name, "wb")
        except OSError as problem:
            raise RefusedError(507, f"cannot store the file: {problem.strerror}") from None
        self.size = 0

    def data_received(self, chunk: bytes) -> None:
        if self.folder is None:
            return
        self.size += len(chunk)
        if self.size > LARGEST_FILE:
            self._fail(413, self.TOO_LARGE)
            return
        try:
            self.out.write(chunk)
        except OSError as problem:
            self._fail(507, f"cannot store the file: {problem.strerror}")

    def post(self) -> None:
        if self.folder is None:
            return
        self.out.close()
        self.server.file_dropped(self.name, self.folder / self.name)
        self.folder = None
        self.set_status(204)

    def on_connection_close(self) -> None:
        self._forget()
        super().on_connection_close()

    def _fail(self, status: int, why: str) -> None:
        """Refuse the file and remove what has arrived."""
        self._forget()
        self.report_refusal(why)
        self.set_status(status)
        self.finish(why)

    def _forget(self) -> None:
        """Remove what has arrived of the file."""
        if self.folder is not None:
            self.out.close()
            shutil.rmtree(self.folder, ignore_errors=True)
            self.folder = None


class Download(Guarded):
    """A file inside the folders of the app."""

    async def get(self, name: str) -> None:
        try:
            path = file_inside(self.server.app.folders, name)
        except ValueError as problem:
            raise RefusedError(404, str(problem)) from None
        self.set_header("Content-Type", "application/octet-stream")
        self.set_header("Content-Disposition", f"attachment; filename*=UTF-8''{quote(path.name, safe='')}")
        with open(path, "rb") as stored, contextlib.suppress(StreamClosedError):
            remaining = stored.seek(0, 2)
            self.set_header("Content-Length", str(remaining))
            stored.seek(0)
            # piece by piece, as results may be larger than the memory
            while piece := stored.read(min(PIECE, remaining)):
                remaining -= len(piece)
                self.write(piece)
                await self.flush()
