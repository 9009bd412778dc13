"""A page of the viewer's server without a browser, so that a test can send what no browser would."""
import contextlib
import http.client
import threading

from scanprep.viewer.messages import Message


def ask(server, path="/", method="GET", body=None, token=True, **headers):
    """Status, headers and body of one request; headers are given with `_` for `-`."""
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=30)
    if token:
        headers.setdefault("Cookie", f"{server.gate.cookie}={server.gate.token}")
    try:
        connection.request(method, path, body, {name.replace("_", "-"): value for name, value in headers.items()})
        answer = connection.getresponse()
        return answer.status, answer.headers, answer.read()
    finally:
        connection.close()


class Page:
    """One page; `turn` is the number of its connection."""

    def __init__(self, server, name="raw-page", turn=0):
        self.server, self.name, self.turn, self.greeted = server, name, turn, False

    def post(self, path, body=b"", query="", **headers):
        """Status, headers and body of one request of the page."""
        headers = {"Origin": f"http://127.0.0.1:{self.server.port}", **headers}
        return ask(self.server, f"{path}?page={self.name}&turn={self.turn}{query}", "POST", body, **headers)

    def send(self, kind, number, **fields):
        """Send a message; the status of the answer."""
        return self.post("/message", Message(kind, fields, number=number).pack())[0]

    def send_aside(self, kind, number, **fields):
        """Send a message that takes long, in a thread; a server that ends meanwhile does not answer."""
        def send():
            with contextlib.suppress(OSError, http.client.HTTPException):
                self.send(kind, number, **fields)

        threading.Thread(target=send, daemon=True).start()

    def next(self):
        """The next message; the status of the answer where there is none. The first request asks to be greeted."""
        status, _, body = self.post("/messages", query="" if self.greeted else "&greet=1")
        self.greeted = True
        return Message.unpack(body) if body else status

    def receive(self, kind):
        """The next message of this kind; others are passed over."""
        while (message := self.next()).kind != kind:
            pass
        return message
