"""Access control of the local server: only its user's own page; a refusal is one line in the terminal."""
from __future__ import annotations

import secrets


class Gate:
    """The secret token of one server, and the checks that a request must pass.

    Parameters
    ----------
    port : int
        Port on which the server listens.
    """

    def __init__(self, port: int) -> None:
        self.token = secrets.token_urlsafe(32)
        self.server = secrets.token_urlsafe(12)         # not secret: tells the pages of two servers apart
        self.hosts = (f"127.0.0.1:{port}", f"localhost:{port}")
        self.cookie = f"scapekit-{port}"                # cookies are shared by all ports of a machine
        self._opening = ""

    def opening(self) -> str:
        """Make a token for one use: other users of the machine can see the command line of a starting browser."""
        self._opening = secrets.token_urlsafe(32)
        return self._opening

    def use(self, opening: str) -> bool:
        """Return whether this is the latest token for one use, and invalidate it."""
        valid = bool(self._opening) and same(self._opening, opening)
        if valid:
            self._opening = ""
        return valid

    def wrong_host(self, host: str) -> bool:
        """Return whether the requested host is not ours: a foreign name may resolve to this machine (DNS rebinding)."""
        return host.lower() not in self.hosts

    def wrong_origin(self, host: str, origin: str | None) -> bool:
        """Return whether the request comes from another page than ours."""
        return origin is None or origin.lower() != f"http://{host.lower()}"

    def wrong_token(self, token: str | None, cookie: str | None) -> bool:
        """Return whether the token in the address, or without one in the cookie, is wrong."""
        return not same(self.token, (cookie if token is None else token) or "")


def same(secret: str, text: str) -> bool:
    """Compare two texts in a time that does not reveal where they differ."""
    return secrets.compare_digest(secret.encode("utf-8"), text.encode("utf-8", "replace"))


def one_line(text: str) -> str:
    """Make text of a request fit for a terminal: no control characters, no line ends, not long."""
    text = "".join(c if c.isprintable() else "?" for c in text)
    longest_line = 200  # characters of one line about a request
    return text if len(text) <= longest_line else text[:longest_line] + "..."
