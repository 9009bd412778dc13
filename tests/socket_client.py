"""A client of the viewer's server on plain sockets, so that a test can send what no browser would."""
import base64
import http.client
import os
import socket
import struct

from scanprep.viewer.messages import Message

CLOSED = 8


def ask(server, path="/", method="GET", body=None, token=True, **headers):
    """Status, headers and body of one request; headers are given with `_` for `-`."""
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=5)
    if token:
        headers.setdefault("Cookie", f"{server.gate.cookie}={server.gate.token}")
    try:
        connection.request(method, path, body, {name.replace("_", "-"): value for name, value in headers.items()})
        answer = connection.getresponse()
        return answer.status, answer.headers, answer.read()
    finally:
        connection.close()


class Tab:
    """One websocket; `status` of the handshake is 101 where it was let in."""

    def __init__(self, server, tab="raw-tab-1", origin="", host="", token=None):
        host = host or f"127.0.0.1:{server.port}"
        token = server.gate.token if token is None else token
        self.socket = socket.create_connection(("127.0.0.1", server.port), timeout=5)
        lines = [f"GET /socket?tab={tab}&token={token} HTTP/1.1", f"Host: {host}", "Upgrade: websocket",
                 "Connection: Upgrade", f"Sec-WebSocket-Key: {base64.b64encode(os.urandom(16)).decode()}",
                 "Sec-WebSocket-Version: 13", f"Origin: {origin or f'http://{host}'}"]
        self.socket.sendall(("\r\n".join(lines) + "\r\n\r\n").encode())
        self.stream = self.socket.makefile("rb")
        self.status = int(self.stream.readline().split()[1])
        while self.stream.readline() not in (b"\r\n", b""):
            pass

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        self.stream.close()
        self.socket.close()

    def send(self, kind, number=0, latest="", **fields):
        """Send a message."""
        self.send_raw(Message(kind, fields, latest=latest, number=number).pack())

    def send_raw(self, data, opcode=2, length=None):
        """Send bytes in a frame that promises `length` of them."""
        head = struct.pack("!BBQ", 0x80 | opcode, 0x80 | 127, len(data) if length is None else length)
        self.socket.sendall(head + bytes(4) + data)

    def frame(self):
        """Kind and bytes of the next frame; (8, b"") where the connection ended."""
        try:
            head = self.stream.read(2)
            if len(head) < 2:
                return CLOSED, b""
            size = head[1]
            if size > 125:
                size = int.from_bytes(self.stream.read(2 if size == 126 else 8), "big")
            return head[0] & 15, self.stream.read(size)
        except ConnectionError:
            return CLOSED, b""

    def receive(self, kind):
        """The next message of this kind; others are passed over."""
        while True:
            opcode, data = self.frame()
            assert opcode != CLOSED, f"the connection ended before a message {kind}"
            if opcode == 2 and (message := Message.unpack(data)).kind == kind:
                return message
