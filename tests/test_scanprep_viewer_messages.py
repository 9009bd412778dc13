"""Messages between tabs and program: no click is lost or done twice, and newer moves replace older ones."""
import math
import struct
import time

import numpy as np
import pytest
from click_app import refused_in_one_line, until
from socket_client import CLOSED, Tab, ask

from scanprep.viewer import handlers, tabs
from scanprep.viewer.messages import Message
from scanprep.viewer.waiting import Waiting


@pytest.mark.parametrize("message", [
    Message("pose"), Message("pick", {"name": "crown ⛑", "at": [1.5, None, True]}, b"\x00\xff" * 5, "pick/crown", 7)])
def test_a_message_comes_back_from_its_frame(message):
    assert Message.unpack(message.pack()) == message


@pytest.mark.parametrize("size", range(8))
def test_data_lie_at_a_multiple_of_eight_bytes(size):
    raw = Message("x" * (size + 1), data=b"data").pack()
    assert (4 + struct.unpack_from("<I", raw)[0]) % 8 == 0


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


def test_newer_messages_replace_older_ones_but_overtake_no_click():
    waiting = Waiting()
    for item in ("pose 1", "shape 1", "pose 2", "click", "pose 3", "pose 4"):
        waiting.put(item, "" if item == "click" else item.split()[0])
    assert [waiting.take()[1] for _ in range(len(waiting))] == ["pose 2", "shape 1", "click", "pose 4"]


def test_a_tab_is_greeted_and_all_tabs_are_told(server, app):
    with Tab(server, "first-tab") as first, Tab(server, "second-tab") as second:
        assert first.receive("state").data == b"\x01\x02"
        assert second.receive("state").fields == {"clicks": 0}
        first.send("click", 1, n=5)
        assert first.receive("state").fields == second.receive("state").fields == {"clicks": 1, "n": 5}
        with Tab(server, "third-tab") as third:
            assert third.receive("state").fields == {"clicks": 1}


def test_a_page_loads_while_a_job_runs(server, app):
    with Tab(server, "first-tab") as first:
        first.send("work")
        assert app.busy.wait(5)
        with Tab(server, "second-tab") as second:
            assert second.receive("state").fields == {"clicks": 0}
        assert ask(server)[0] == 200


def test_of_moves_that_wait_only_the_newest_is_handled(server, app):
    with Tab(server) as tab:
        tab.receive("state")         # the greeting, which may come after the first acknowledgements
        tab.send("work")
        assert app.busy.wait(5)
        for n in range(1, 6):
            tab.send("move", n, latest="pose", n=n)
        while tab.receive("acknowledged").fields["number"] < 5:
            pass
        app.go.set()
        assert tab.receive("state").fields == {"clicks": 1, "n": 5}
    assert app.seen == [5]


def test_a_slow_tab_gets_the_newest_and_no_other_waits_for_it(server):
    with Tab(server, "slow-tab") as slow, Tab(server, "fast-tab") as fast:
        slow.receive("state"), fast.receive("state")
        for n in range(60):
            server.send(Message("mesh", {"n": n}, bytes(2**20), latest="mesh"))
            if n % 20 == 0:
                assert fast.receive("mesh").fields["n"] <= n
        while fast.receive("mesh").fields["n"] < 59:
            pass
        numbers = [slow.receive("mesh").fields["n"]]
        while numbers[-1] < 59:
            numbers.append(slow.receive("mesh").fields["n"])
    assert numbers == sorted(numbers) and len(numbers) < 40


@pytest.mark.parametrize("pause", [0.0, 0.01])
def test_a_tab_that_reads_nothing_is_closed(server, monkeypatch, pause):
    monkeypatch.setattr(tabs, "LONGEST_QUEUE", 2**24)
    with Tab(server) as tab:
        tab.receive("state")
        for _ in range(80):          # the buffers of the sockets hold tens of megabytes
            server.send(Message("mesh", data=bytes(2**20)))
            time.sleep(pause)
        until(lambda: len(server.tabs) == 0, 2)      # at once, not when the protocol has waited 5 s for an answer


def test_what_was_taken_in_is_not_handled_again_after_a_lost_connection(server, app):
    with Tab(server) as tab:
        tab.send("click", 1, n="a")
        tab.send("click", 2, n="b")
        until(lambda: len(app.seen) == 2)
    with Tab(server) as again:
        assert again.receive("acknowledged").fields == {"number": 2}
        assert again.receive("state").fields == {"clicks": 2}
        again.send("click", 2, n="b")
        again.send("click", 3, n="c")
        assert again.receive("state").fields == {"clicks": 3, "n": "c"}
    with Tab(server, "another-tab") as other:
        other.send("click", 1, n="d")
        until(lambda: len(app.seen) == 4)
    assert app.seen == ["a", "b", "c", "d"]


@pytest.mark.parametrize(("data", "opcode", "length"), [
    (b"", 2, 2**24 + 1), (b"", 2, 2**62), (b"\x00", 2, None), (b"hello", 1, None)])
def test_messages_that_are_too_large_or_damaged_end_the_connection(server, app, data, opcode, length):
    with Tab(server) as tab:
        tab.receive("state")
        tab.send_raw(data, opcode, length)
        assert tab.frame()[0] == CLOSED
        assert refused_in_one_line(server, 101, tab.status)
    assert ask(server)[0] == 200 and not app.seen


def test_a_message_of_the_largest_size_is_taken(server, app):
    with Tab(server) as tab:
        empty = Message("click", {"n": 1})
        tab.send_raw(Message("click", {"n": 1}, bytes(handlers.LARGEST_MESSAGE - len(empty.pack()))).pack())
        until(lambda: app.seen == [1])


def test_errors_of_the_app_are_shown_and_unforeseen_ones_told_once(server, app):
    with Tab(server) as tab:
        tab.send("wrong")
        assert tab.receive("error").fields == {"text": "no such landmark"}
        assert not server.told
        tab.send("broken")
        tab.send("broken")
        for _ in range(2):
            assert tab.receive("error").fields == {"text": "unexpected KeyError: 'crown'"}
        trace, = server.told
        assert "Traceback" in trace and "KeyError" in trace
        tab.send("click", n=1)
        until(lambda: app.seen == [1])


def test_a_greeting_that_fails_is_told_and_clicks_go_on(server, app):
    def greet():
        raise ValueError("anna.ply: no triangles")

    app.greet = greet
    with Tab(server) as tab:
        tab.send("click", 1, n=1)
        assert tab.receive("acknowledged")
        assert tab.receive("error").fields == {"text": "anna.ply: no triangles"}
        until(lambda: app.seen == [1])
