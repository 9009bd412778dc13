"""The viewer's server: who may ask it, and how it starts and ends."""
import contextlib
import os
import signal
import socket
import subprocess
import sys
import textwrap
import threading
import time
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
from click_app import refused_in_one_line, until
from socket_client import Page, ask

from scanprep.viewer.gate import one_line
from scanprep.viewer.messages import Message
from scanprep.viewer.served_page import page as html
from scanprep.viewer.server import Server


@pytest.mark.parametrize("path", ["/", "/?token=wrong", "/?token=%ff", "/?open=wrong", "/?open=", "/message",
                                  "/favicon.ico", "/?token="])
def test_nothing_is_given_without_the_token(server, path):
    status, headers, body = ask(server, path, token=False)
    assert refused_in_one_line(server, 403, status)
    assert "Set-Cookie" not in headers and b"scapekit.start" not in body


def test_a_wrong_cookie_does_not_pass(server):
    status, _, _ = ask(server, token=False, Cookie=f"{server.gate.cookie}=wrong")
    assert refused_in_one_line(server, 403, status)


def test_the_token_gives_the_page_and_a_cookie(server):
    path = server.address.partition(str(server.port))[2]
    status, headers, body = ask(server, path, token=False)
    assert status == 200 and headers["Cache-Control"] == "no-store" and headers["X-Frame-Options"] == "DENY"
    assert "Server" not in headers
    cookie = headers["Set-Cookie"]
    assert "HttpOnly" in cookie and "SameSite=Strict" in cookie
    nonce = headers["Content-Security-Policy"].partition("'nonce-")[2].partition("'")[0]
    assert len(nonce) > 10 and f'<script nonce="{nonce}">scapekit.start("pick")</script>'.encode() in body
    assert server.gate.token.encode() not in body
    assert ask(server, token=False, Cookie=f'other={{"a": [1]}}; {cookie.partition(";")[0]}')[0] == 200


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


@pytest.mark.parametrize("path", ["/message", "/messages"])
@pytest.mark.parametrize("headers", [
    {"Origin": "http://evil.example"}, {"Origin": "null"}, {"Origin": "https://127.0.0.1:{port}"},
    {"Origin": "http://127.0.0.1"}, {"Origin": "http://localhost:{port}"}, {}])
def test_a_foreign_origin_neither_acts_nor_listens(server, app, path, headers):
    headers = {name: value.format(port=server.port) for name, value in headers.items()}
    page = Page(server)
    page.next()
    click = Message("click", {"n": 1}, number=1).pack()
    status, _, body = ask(server, f"{path}?page={page.name}&turn=0", "POST", click, **headers)
    assert refused_in_one_line(server, 403, status) and b"click" not in body and not app.seen


@pytest.mark.parametrize(("method", "path", "status"), [
    ("GET", "/message", 404), ("POST", "/", 404), ("POST", "/file/body.ply", 404), ("PUT", "/", 501),
    ("TRACE", "/", 501), ("GET", "/" + 70_000 * "a", 414)])
def test_there_are_no_other_addresses(server, method, path, status):
    assert refused_in_one_line(server, status, ask(server, path, method, b"" if method == "POST" else None,
                                                   Origin=f"http://127.0.0.1:{server.port}")[0])


def test_a_page_of_an_earlier_server_is_refused(server):
    assert ask(server, f"/?server={server.gate.server}")[0] == 200
    assert refused_in_one_line(server, 403, ask(server, "/?server=earlier")[0])


def test_a_flood_of_connections_closes_none_of_the_user(server, app):
    """More than a process may have files open, each with half a request: the oldest go, and the page is served."""
    page = Page(server)
    page.next()
    with contextlib.ExitStack() as flood:
        waiting = threading.Thread(target=page.next)
        waiting.start()
        time.sleep(0.3)                                     # until it has shown its token
        for _ in range(300):
            stranger = flood.enter_context(socket.create_connection(("127.0.0.1", server.port), timeout=5))
            stranger.sendall(b"GET /?token=")
        assert ask(server)[0] == 200
        until(lambda: len(os.listdir(f"/proc/{os.getpid()}/fd")) < 300 + 100)    # their own ends, and few of ours
        assert waiting.is_alive()
        assert page.send("click", 1) == 200 and app.numbers == [1]
        waiting.join(5)
        assert not waiting.is_alive()


def raw(server, head, token=True):
    """Status of a request whose body never comes, or is refused before it does."""
    with socket.create_connection(("127.0.0.1", server.port), timeout=5) as connection:
        secret = f"Cookie: {server.gate.cookie}={server.gate.token}\r\n" if token else ""
        here = f"127.0.0.1:{server.port}"
        connection.sendall(f"POST /message?page=a HTTP/1.1\r\nHost: {here}\r\nOrigin: http://{here}\r\n{secret}{head}"
                           "\r\n\r\n".encode())
        return int(connection.recv(1000).split()[1])


@pytest.mark.parametrize(("head", "status"), [
    (f"Content-Length: {2**24 + 1}", 413), (f"Content-Length: {10**30}", 413), (f"Content-Length: {5000 * '9'}", 413),
    ("Content-Length: -1", 411), ("Content-Length: x", 411), ("X: 1", 411),
    ("Content-Length: 5\r\nTransfer-Encoding: chunked", 411)])
def test_a_message_is_refused_by_its_length_before_it_comes(server, head, status):
    assert refused_in_one_line(server, status, raw(server, head))


def test_a_body_without_the_token_is_not_taken(server):
    assert refused_in_one_line(server, 403, raw(server, "Content-Length: 1000000000", token=False))


def test_lines_about_requests_are_clean():
    line = one_line("a\x1b[2J\r\n\u202eb" + "c" * 1000)
    assert line.isprintable() and len(line) < 210


def test_the_page_holds_a_bundle_whatever_is_in_its_texts():
    shown = html("<b>", 'a"</script>', "x = '</script><!--<script'", "p{}</style>", "s", "n")
    assert shown.count("</script>") == 3 and "<!--" not in shown and shown.count("</style>") == 1
    assert "<title>&lt;b&gt;</title>" in shown and shown.startswith("<!doctype html>")


@pytest.mark.slow
@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGTERM], ids=["Ctrl-C", "SIGTERM"])
def test_a_signal_ends_serve_cleanly_though_a_job_does_not(ending):
    code = textwrap.dedent("""
        import time
        from scanprep.viewer import server
        class App:
            title, name = "t", "view"
            def greet(self): return [server.Message("state")]
            def handle(self, message, send):
                print("working", flush=True)
                time.sleep(60)
        server.serve(App(), open_browser=False)
        print("returned", flush=True)
        """)
    heard = partial(signal.signal, ending, signal.SIG_DFL)             # what runs in the background may ignore Ctrl-C
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                          cwd=Path(__file__).parents[1], preexec_fn=heard) as run:
        told = [run.stderr.readline() for _ in range(3)]
        port, _, token = told[0].split()[-1].partition("127.0.0.1:")[2].partition("/?token=")
        assert "ssh -N -L" in told[2]
        page = Page(SimpleNamespace(port=int(port), gate=SimpleNamespace(cookie=f"scapekit-{port}", token=token)))
        page.next()
        page.send_aside("work", 1)
        assert run.stdout.readline() == "working\n"
        before = time.monotonic()
        run.send_signal(ending)
        rest, wrong = run.communicate(timeout=5)
    assert time.monotonic() - before < 1.5
    assert (rest, wrong, run.returncode) == ("returned\n", "", 0)


def test_a_port_in_use_is_told(app):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ValueError, match=f"{port} is in use by another program"):
            Server(app, port)


def test_a_port_that_is_given_is_taken(app):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with Server(app, port) as server:
        assert server.address.startswith(f"http://127.0.0.1:{port}/?token=")
        with pytest.raises(OSError):
            socket.create_connection(("127.0.0.2", port), timeout=1)


def test_a_disk_that_is_full_is_told_in_a_line(app, server):
    def fail(message, send):
        raise OSError(28, "No space left on device", "anna.landmarks.json")

    app.handle = fail
    page = Page(server)
    page.next()
    page.send("click", 1)
    assert "anna.landmarks.json: the disk is full" in page.receive("error").fields["text"]
    assert not server.told
