"""An app that writes down the clicks it is told of, and a page with nothing but its connection."""
import contextlib
import threading
import time
from pathlib import Path

import pytest

from scanprep.viewer.messages import Message
from scanprep.viewer.server import Server, Stopped

CONNECTION = Path(__file__).parents[1] / "scanprep" / "viewer" / "source" / "connection.js"
START = """
const scapekit = (() => {
%s
  return {pack, unpack, start(name) {
    const got = [], states = [];
    const line = connect((m) => got.push([m.kind, m.fields, Array.from(m.data)]), (s) => states.push(s));
    Object.assign(window, {name, line, got, states});
    document.body.append("started");
  }};
})();
"""


def allowed(app):
    """Return an app of results as it is after the user has read which files it changes outside of its folder."""
    app.outside = ""
    return app


class Clicks:
    """An app that writes down what it is told."""

    title, name = "Clicks <of> a test", "pick"

    def __init__(self):
        self.seen, self.numbers = [], []
        self.busy, self.go, self.ended = threading.Event(), threading.Event(), threading.Event()

    def greet(self):
        return [Message("state", {"clicks": len(self.seen)}, b"\x01\x02")]

    def handle(self, message, send):
        if message.kind == "work":
            self.busy.set()
            self.go.wait(20)
        elif message.kind == "endless":
            self.busy.set()
            try:
                while True:
                    send(Message("progress", latest="progress"))
                    time.sleep(0.01)
            except Stopped:
                self.ended.set()
                raise
        elif message.kind == "wrong":
            raise ValueError("no such landmark")
        elif message.kind == "broken":
            raise KeyError("crown")
        else:
            self.numbers.append(message.number)
            self.seen.append(message.fields.get("n"))
            send(Message("state", {"clicks": len(self.seen), "n": message.fields.get("n")}, message.data))


@contextlib.contextmanager
def clicking(app):
    """Its server; `told` has what the terminal was told."""
    told = []
    server = Server(app, say=told.append)
    server.script = START % CONNECTION.read_text(encoding="utf-8").replace("export function", "function")
    server.told = told
    with server:
        yield server
        app.go.set()


def until(what, seconds=5.0):
    """Wait until this is so."""
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.01)


@pytest.fixture
def app():
    """An app of clicks."""
    return Clicks()


@pytest.fixture
def server(app):
    """Its server."""
    with clicking(app) as server:
        yield server


def refused_in_one_line(server, status, got):
    """Whether a request was refused with this status, and the terminal told in one clean line without the token."""
    until(lambda: server.told)
    line, = server.told
    return (got == status and line.startswith("refused: ") and line.isprintable() and server.gate.token not in line
            and "Traceback" not in line)
