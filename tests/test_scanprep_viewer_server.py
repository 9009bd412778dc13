"""The viewer's server: who may ask it, and how it starts and ends."""
import contextlib
import os
import signal
import socket
import subprocess
import sys
import textwrap
import time
from functools import partial
from pathlib import Path

import pytest
from click_app import refused_in_one_line, until
from socket_client import CLOSED, Tab, ask

from scanprep.viewer.gate import file_name, one_line
from scanprep.viewer.messages import Message
from scanprep.viewer.served_page import page as html
from scanprep.viewer.server import Server, Stopped


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


def test_a_flood_of_connections_closes_none_of_the_user(server, app):
    """More than a process may have files open, each with half a request: the oldest go, and the page is served."""
    with Tab(server) as tab, contextlib.ExitStack() as flood:
        for _ in range(300):
            one = flood.enter_context(socket.create_connection(("127.0.0.1", server.port), timeout=5))
            one.sendall(b"GET /?token=")
        assert ask(server)[0] == 200
        held = len(os.listdir(f"/proc/{os.getpid()}/fd"))
        assert held < 300 + 100                             # their own ends, and few of the server's
        tab.send("click", number=1)
        until(lambda: app.numbers == [1])


def test_a_body_without_the_token_is_not_taken(server, app):
    head = f"POST /drop?name=a.ply HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\nContent-Length: 1000000000\r\n\r\n"
    with socket.create_connection(("127.0.0.1", server.port), timeout=5) as one:
        one.sendall(head.encode())
        with contextlib.suppress(OSError):
            for _ in range(1000):
                one.sendall(bytes(10**6))
            pytest.fail("all of it was taken")
    assert not list(server.dropped.iterdir()) and ask(server)[0] == 200


def test_lines_about_requests_are_clean():
    line = one_line("a\x1b[2J\r\n\u202eb" + "c" * 1000)
    assert line.isprintable() and len(line) < 210


def test_the_page_holds_a_bundle_whatever_is_in_its_texts():
    shown = html("<b>", 'a"</script>', "x = '</script><!--<script'", "p{}</style>", "s", "n")
    assert shown.count("</script>") == 3 and "<!--" not in shown and shown.count("</style>") == 1
    assert "<title>&lt;b&gt;</title>" in shown and shown.startswith("<!doctype html>")


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


@pytest.mark.slow
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


def test_the_name_of_a_dropped_file_fits_every_disk():
    for name in ("\u65e5" * 200 + ".ply", "a" * 500 + ".ply", "\U0001f600" * 100 + ".ply"):
        short = file_name(name)
        assert len(short.encode()) <= 120 and short.endswith(".ply")


def test_a_disk_that_is_full_is_told_in_a_line(app, monkeypatch):
    def fail(message, send):
        raise OSError(28, "No space left on device", "anna.landmarks.json")

    monkeypatch.setattr(app, "handle", fail)
    told = []
    with Server(app, say=told.append) as server, Tab(server) as tab:
        tab.send("click", number=1)
        assert "anna.landmarks.json: the disk is full" in tab.receive("error").fields["text"]
    assert not told
