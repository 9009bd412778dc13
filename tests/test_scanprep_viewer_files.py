"""Files that the viewer's server gives away, and those that are dropped on its page."""
import os
import socket

import pytest
from click_app import refused_in_one_line, until
from socket_client import Tab, ask

from scanprep.viewer import handlers
from scanprep.viewer.gate import file_name


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


@pytest.mark.parametrize("body", [lambda: b"x" * 20001, lambda: pieces(21)], ids=["its size told", "in pieces"])
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
