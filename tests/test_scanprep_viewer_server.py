"""The viewer's server: who may ask it, what it stores and gives away, and that no click is lost or done twice."""
import math
import os
import signal
import socket
import struct
import subprocess
import sys
import textwrap
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from click_app import Clicks, clicking, until
from socket_client import CLOSED, Tab, ask

from scanprep.viewer import handlers, tabs
from scanprep.viewer.gate import file_name, one_line
from scanprep.viewer.messages import Message
from scanprep.viewer.served_page import page as html
from scanprep.viewer.server import Server, Stopped
from scanprep.viewer.waiting import Waiting


@pytest.fixture
def app(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "body.ply").write_bytes(b"ply of a body")
    (tmp_path / "secret.txt").write_text("secret")
    return Clicks(tmp_path / "out")


@pytest.fixture
def server(app):
    with clicking(app) as server:
        yield server


def refused_in_one_line(server, status, got):
    """Whether a request was refused with this status, and the terminal told in one clean line without the token."""
    until(lambda: server.told)
    line, = server.told
    return (got == status and line.startswith("refused: ") and line.isprintable() and server.gate.token not in line
            and "Traceback" not in line)


# ---- messages ----

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


# ---- who may ask ----

@pytest.mark.parametrize("path", ["/", "/?token=wrong", "/?token=%ff", "/?open=wrong", "/file/body.ply", "/alive",
                                  "/favicon.ico", "/?token="])
def test_nothing_is_given_without_the_token(server, path):
    status, headers, body = ask(server, path, token=False)
    assert refused_in_one_line(server, 400 if "%ff" in path else 403, status)
    assert "Set-Cookie" not in headers and b"scapekit.start" not in body


def test_a_wrong_cookie_does_not_pass(server):
    status, _, _ = ask(server, token=False, Cookie=f"{server.gate.cookie}=wrong")
    assert refused_in_one_line(server, 403, status)


def test_the_token_gives_the_page_and_a_cookie(server):
    path = server.address.partition(str(server.port))[2]
    status, headers, body = ask(server, path, token=False)
    assert status == 200 and headers["Cache-Control"] == "no-store" and headers["X-Frame-Options"] == "DENY"
    cookie = headers["Set-Cookie"]
    assert "HttpOnly" in cookie and "SameSite=Strict" in cookie
    nonce = headers["Content-Security-Policy"].partition("'nonce-")[2].partition("'")[0]
    assert len(nonce) > 10 and f'<script nonce="{nonce}">scapekit.start("pick")</script>'.encode() in body
    assert server.gate.token.encode() not in body
    assert ask(server, token=False, Cookie=cookie.partition(";")[0])[0] == 200


def test_the_address_for_a_browser_opens_once(server):
    path = server.opening().partition(str(server.port))[2]
    assert ask(server, path, token=False)[0] == 200
    assert refused_in_one_line(server, 403, ask(server, path, token=False)[0])


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1", "127.0.0.1:1", "localhost.evil.example:{port}",
                                  "[::1]:{port}"])
def test_a_foreign_host_is_refused(server, host):
    status, _, _ = ask(server, Host=host.format(port=server.port))
    assert refused_in_one_line(server, 403, status)


def test_localhost_is_ours(server):
    assert ask(server, Host=f"localhost:{server.port}")[0] == 200


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "https://127.0.0.1:{port}", "http://127.0.0.1",
                                    "http://localhost:{port}"])
def test_a_foreign_origin_gets_no_socket_and_stores_nothing(server, app, origin):
    with Tab(server, origin=origin.format(port=server.port)) as tab:
        assert refused_in_one_line(server, 403, tab.status)
    server.told.clear()
    status, _, _ = ask(server, "/drop?name=a.ply", "POST", b"ply", Origin=origin.format(port=server.port))
    assert refused_in_one_line(server, 403, status)
    assert not app.files and not list(server.dropped.iterdir())


def test_an_upload_names_its_origin(server):
    assert refused_in_one_line(server, 403, ask(server, "/drop?name=a.ply", "POST", b"ply")[0])


@pytest.mark.parametrize(("given", "status"), [({"token": "wrong"}, 403), ({"host": "evil.example"}, 403),
                                               ({"tab": "../x"}, 400)])
def test_a_socket_needs_token_host_and_a_name(server, given, status):
    with Tab(server, **given) as tab:
        assert refused_in_one_line(server, status, tab.status)


def test_a_page_of_an_earlier_server_is_refused(server):
    assert ask(server, f"/alive?server={server.gate.server}")[0] == 204
    assert refused_in_one_line(server, 403, ask(server, "/alive?server=earlier")[0])


def test_lines_about_requests_are_clean():
    line = one_line("a\x1b[2J\r\n\u202eb" + "c" * 1000)
    assert line.isprintable() and len(line) < 210


def test_the_page_holds_a_bundle_whatever_is_in_its_texts():
    shown = html("<b>", 'a"</script>', "x = '</script><!--<script'", "p{}</style>", "s", "n")
    assert shown.count("</script>") == 3 and "<!--" not in shown and shown.count("</style>") == 1
    assert "<title>&lt;b&gt;</title>" in shown and shown.startswith("<!doctype html>")


# ---- files ----

@pytest.mark.parametrize("path", [
    "../secret.txt", "..%2fsecret.txt", "%2e%2e/secret.txt", "{folder}/secret.txt", "{folder}/out/body.ply", "link.txt",
    "linked/secret.txt", "", ".", "missing.ply", "body.ply%00", "a" * 5000, "..%5csecret.txt", "circle"])
def test_only_files_inside_of_the_folders_are_given(server, tmp_path, path):
    (tmp_path / "out" / "link.txt").symlink_to(tmp_path / "secret.txt")
    (tmp_path / "out" / "linked").symlink_to(tmp_path)
    (tmp_path / "out" / "circle").symlink_to(tmp_path / "out" / "circle")
    status, _, body = ask(server, "/file/" + path.format(folder=tmp_path))
    assert refused_in_one_line(server, 404, status)
    assert b"secret" not in body


def test_a_file_inside_is_given_whole(server, tmp_path):
    data = os.urandom(handlers.PIECE + 17)
    (tmp_path / "out" / "sub").mkdir()
    (tmp_path / "out" / "sub" / "böd y.ply").write_bytes(data)
    status, headers, body = ask(server, "/file/sub/b%C3%B6d%20y.ply")
    assert status == 200 and body == data and headers["Content-Disposition"].endswith("UTF-8''b%C3%B6d%20y.ply")
    assert not server.told


def drop(server, name, body, **headers):
    return ask(server, f"/drop?name={name}", "POST", body, Origin=f"http://127.0.0.1:{server.port}", **headers)


def test_a_dropped_file_is_received_and_removed(server, app):
    data = os.urandom(3_000_000)
    with Tab(server) as tab:
        assert drop(server, "..%2f..%2fanna%201.ply", data)[0] == 204
        assert tab.receive("received").fields == {"name": "anna 1.ply"}
    (name, stored, got, path), = app.files
    assert name == stored == "anna 1.ply" and got == data and path.parent.parent == server.dropped
    until(lambda: not list(server.dropped.iterdir()))


def test_the_app_refuses_a_file_by_its_own_name(server):
    with Tab(server) as tab:
        assert drop(server, "notes.txt", b"hello")[0] == 204
        assert tab.receive("error").fields == {"text": "notes.txt: expected a mesh"}


def pieces(count):
    yield from [b"x" * 1000] * count


@pytest.mark.parametrize("body", [lambda: b"x" * 20001, lambda: pieces(30)], ids=["its size told", "in pieces"])
def test_a_file_that_is_too_large_is_not_stored(server, app, monkeypatch, body):
    monkeypatch.setattr(handlers, "LARGEST_FILE", 20000)
    assert refused_in_one_line(server, 413, drop(server, "a.ply", body())[0])
    assert not app.files and not list(server.dropped.iterdir())


def test_a_file_that_is_too_large_is_refused_before_it_comes(server):
    with socket.create_connection(("127.0.0.1", server.port), timeout=5) as large:
        large.sendall((f"POST /drop?name=a.ply&token={server.gate.token} HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\n"
                       f"Origin: http://127.0.0.1:{server.port}\r\nContent-Length: {2**31}\r\n\r\n").encode())
        status = int(large.recv(1000).split()[1])
    assert refused_in_one_line(server, 413, status)


def test_half_an_upload_leaves_nothing(server, app):
    with socket.create_connection(("127.0.0.1", server.port)) as half:
        half.sendall((f"POST /drop?name=a.ply&token={server.gate.token} HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\n"
                      f"Origin: http://127.0.0.1:{server.port}\r\nContent-Length: 1000\r\n\r\nhalf").encode())
        until(lambda: list(server.dropped.iterdir()))
    until(lambda: not list(server.dropped.iterdir()))
    assert not app.files


@pytest.mark.parametrize(("given", "kept"), [
    ("C:\\scans\\anna.ply", "anna.ply"), ("a/../b.mrk.json", "b.mrk.json"), ("x\x00\n\x1b.ply", "x___.ply"),
    ("n" * 500 + ".ply.gz", "n" * 113 + ".ply.gz"), (" größe.ply", "größe.ply")])
def test_names_of_dropped_files_are_plain(given, kept):
    assert file_name(given) == kept


@pytest.mark.parametrize("name", ["", "..", "a/", ".", "\\"])
def test_a_dropped_file_has_a_name(server, name):
    with pytest.raises(ValueError, match="name"):
        file_name(name)


# ---- messages between tabs and app ----

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


def test_a_tab_that_reads_nothing_is_closed(server, monkeypatch):
    monkeypatch.setattr(tabs, "LONGEST_QUEUE", 2**24)
    with Tab(server) as tab:
        tab.receive("state")
        for _ in range(40):
            server.send(Message("mesh", data=bytes(2**20)))
        until(lambda: len(server.tabs) == 0)


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


# ---- the end ----

def test_the_server_ends_within_a_second_though_a_job_runs(app):
    with Server(app, script="", style="") as server, Tab(server) as tab:
        tab.send("endless")
        assert app.busy.wait(5)
        before = time.monotonic()
        server.__exit__()
        assert time.monotonic() - before < 1 and app.ended.is_set()
        assert app.closed == 1 and not server.dropped.exists()
        while tab.frame()[0] != CLOSED:
            pass
        with pytest.raises(Stopped):
            server.send(Message("late"))


def test_clicks_that_wait_at_the_end_are_handled(app):
    with Server(app, script="", style="") as server, Tab(server) as tab:
        tab.send("endless")
        for n in range(1, 4):
            tab.send("click", n, n=n)
        while tab.receive("acknowledged").fields["number"] < 3:
            pass
    assert app.seen == [1, 2, 3]


@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGTERM], ids=["Ctrl-C", "SIGTERM"])
def test_a_signal_ends_serve_cleanly_though_a_job_does_not(tmp_path, ending):
    code = textwrap.dedent("""
        import sys, time
        from scanprep.viewer import server
        from scanprep.viewer.messages import Message
        class App:
            title, name, folders = "t", "view", ()
            def greet(self): return []
            def handle(self, message, send): time.sleep(60)
            def receive(self, name, path, send): pass
            def close(self): print("closed", flush=True)
        with_page = lambda *given: server_class(*given, script="", style="")
        server_class, server.Server = server.Server, with_page
        def say(text):
            print(text, flush=True)
        server.serve(App(), open_browser=False, say=say)
        print("returned", flush=True)
        """)
    heard = partial(signal.signal, ending, signal.SIG_DFL)             # what runs in the background may ignore Ctrl-C
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                          cwd=Path(__file__).parents[1], preexec_fn=heard) as run:
        told = [run.stdout.readline() for _ in range(3)]
        address = told[0].split()[-1]
        assert "ssh -N -L" in told[2]
        at = type("At", (), {"port": int(address.split(":")[2].split("/")[0]), "gate": None})()
        with Tab(at, token=address.partition("token=")[2]) as tab:
            tab.send("work", 1)
            while tab.receive("acknowledged").fields["number"] < 1:
                pass
            before = time.monotonic()
            run.send_signal(ending)
            rest, wrong = run.communicate(timeout=5)
    assert time.monotonic() - before < 1.5
    assert (rest.split(), wrong, run.returncode) == (["closed", "returned"], "", 0)


def test_a_port_in_use_is_told(app):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ValueError, match=f"{port} is in use by another program"):
            Server(app, port, script="", style="")


def test_a_port_that_is_given_is_taken(app):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with Server(app, port, script="", style="") as server:
        assert server.address.startswith(f"http://127.0.0.1:{port}/?token=")
        with pytest.raises(OSError):
            socket.create_connection(("127.0.0.2", port), timeout=1)
