"""Access control of the local server: only its user's own page; a refusal is one line in the terminal."""
from __future__ import annotations

import re
import secrets
from collections.abc import Iterable
from pathlib import Path, PurePosixPath, PureWindowsPath


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
        self._openings: list[str] = []

    def opening(self) -> str:
        """Make a token for one use: other users of the machine can see the command line of a starting browser."""
        # at most 16 unused ones: more come only from browsers that failed to start
        self._openings = [*self._openings[1 - 16:], secrets.token_urlsafe(32)]
        return self._openings[-1]

    def use(self, opening: str) -> bool:
        """Return whether this is a valid token for one use, and invalidate it."""
        known = [one for one in self._openings if same(one, opening)]
        self._openings = [one for one in self._openings if one not in known]
        return bool(known)

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


def file_name(name: str) -> str:
    """Return the last component of a name from a browser, in characters valid on every disk; ValueError for none."""
    last = re.split(r"[/\\]", name)[-1]
    last = re.sub(r"[^\w .()+-]", "_", last).strip(" ")
    if not last.strip(". "):
        raise ValueError("name: expected the name of a file")
    longest_name = 120  # bytes of the name of a stored file; the ending stays
    return last.encode()[-longest_name:].decode(errors="ignore").lstrip(" ")


def file_inside(folders: Iterable[Path], name: str) -> Path:
    """Find the file of a name in one of the folders, links followed; ValueError where it is not inside."""
    if not name or PurePosixPath(name).is_absolute() or PureWindowsPath(name).anchor:
        raise ValueError("expected a name inside of a folder")
    for folder in folders:
        try:
            path, within = (folder / name).resolve(), folder.resolve()
            if path.is_relative_to(within) and path.is_file():
                return path
        except (OSError, ValueError, RuntimeError):      # an invalid name, or links in a circle
            continue
    raise ValueError("no such file in the folders of this server")
