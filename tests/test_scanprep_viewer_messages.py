"""Messages between page and program: no click is lost or done twice, and newer answers replace older ones."""
import math
import struct

import numpy as np
import pytest
from click_app import refused_in_one_line
from socket_client import Page, ask

from scanprep.viewer.messages import Message
from scanprep.viewer.server import LARGEST_MESSAGE


@pytest.mark.parametrize("message", [
    Message("pose"), Message("pick", {"name": "crown ⛑", "at": [1.5, None, True]}, b"\x00\xff" * 5, "pick/crown", 7)])
def test_a_message_comes_back_from_its_frame(message):
    assert Message.unpack(message.pack()) == message


def test_numbers_that_are_not_finite_are_null():
    raw = Message("a", {"x": math.nan, "y": [math.inf, 2], "z": np.array([1.0, np.nan])}).pack()
    assert b"NaN" not in raw and b"Infinity" not in raw
    assert Message.unpack(raw).fields == {"x": None, "y": [None, 2], "z": [1.0, None]}


def framed(header):
    return struct.pack("<I", len(header)) + header


@pytest.mark.parametrize(("raw", "why"), [
    ("text", "binary"), (b"\x01", "at least 4"), (struct.pack("<I", 9) + b"{}", "header of 9 bytes, got 2"),
    (framed(b"{"), "JSON"), (framed(b"[]"), "kind, latest"), (framed(b"{}"), "kind, latest"),
    (framed(b'{"kind":"a","latest":"","number":0,"fields":{"x":NaN}}'), "NaN"),
    (framed(b'{"kind":"a","latest":"","number":0,"fields":{"x":1e999}}'), "1e999"),
    (framed(b'{"kind":"a","latest":"","number":-1,"fields":{}}'), "not negative"),
    (framed(b'{"kind":"a","latest":"","number":true,"fields":{}}'), "expected int"),
    (framed(b'{"kind":"a","latest":1,"number":0,"fields":{}}'), "latest: expected str"),
    (framed(b"[" * 100000), "nested")])
def test_bad_frames_say_what_was_expected(raw, why):
    with pytest.raises(ValueError, match=why):
        Message.unpack(raw)


def opened(server, name="raw-page", turn=0):
    """A page that was greeted."""
    page = Page(server, name, turn)
    page.receive("state")
    return page


def test_a_page_is_greeted_and_told_what_changes(server):
    page = Page(server)
    greeting = page.receive("state")
    assert greeting.fields == {"clicks": 0} and greeting.data == b"\x01\x02"
    page.send("click", 1, n=5)
    assert page.receive("state").fields == {"clicks": 1, "n": 5}


def test_a_page_loads_while_a_job_runs(server, app):
    first = opened(server)
    first.send_aside("work", 1)
    assert app.busy.wait(5)
    assert ask(server)[0] == 200
    assert Page(server, "second-page").receive("state").fields == {"clicks": 0}
    app.go.set()


def test_a_page_that_reads_slowly_gets_the_newest_of_each_kind(server):
    page = opened(server)
    for n in range(500):                                    # half a gigabyte, if all of them waited
        server.send(Message("positions", {"n": n}, bytes(2**20), latest=f"positions {n % 2}"))
        server.send(Message("state", {"n": n}))
    assert [page.next().fields["n"] for _ in range(3)] == [498, 499, 499]


@pytest.mark.parametrize("data", [b"\x00", b"hello"])
def test_damaged_messages_are_refused(server, app, data):
    page = opened(server)
    assert refused_in_one_line(server, 400, page.post("/message", data)[0])
    assert page.send("click", 1) == 200 and len(app.seen) == 1


def test_a_message_of_the_largest_size_is_taken(server, app):
    message = Message("click", {"n": 1}, number=1)
    full = Message("click", {"n": 1}, bytes(LARGEST_MESSAGE - len(message.pack())), number=1)
    assert opened(server).post("/message", full.pack())[0] == 200 and app.seen == [1]


def test_errors_of_the_app_are_shown_and_unforeseen_ones_told_once(server, app):
    page = opened(server)
    page.send("wrong", 1)
    assert page.receive("error").fields == {"text": "no such landmark"}
    assert not server.told
    for number in (2, 3):
        page.send("broken", number)
        assert page.receive("error").fields == {"text": "unexpected KeyError: 'crown'"}
    trace, = server.told
    assert "Traceback" in trace and "KeyError" in trace
    assert page.send("click", 4, n=1) == 200 and app.seen == [1]


def test_a_greeting_that_fails_is_told_and_clicks_go_on(server, app):
    def greet():
        raise ValueError("anna.ply: no triangles")

    app.greet = greet
    page = Page(server)
    assert page.receive("error").fields == {"text": "anna.ply: no triangles"}
    assert page.send("click", 1, n=1) == 200 and app.seen == [1]
