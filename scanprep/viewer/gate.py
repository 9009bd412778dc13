"""Who may ask this server, and how a refusal is told: the page of its user alone, in one line of the terminal."""
from __future__ import annotations

import re
import secrets
from collections.abc import Iterable
from pathlib import Path, PurePosixPath, PureWindowsPath


class Gate:
    """The secret of one server, and what a request must show to pass.

    Parameters
    ----------
    port : int
        Where the server listens.
    """

    def __init__(self, port: int) -> None:
        self.token = secrets.token_urlsafe(32)
        self.server = secrets.token_urlsafe(12)         # no secret: tells one server's page from the next one's
        self.hosts = (f"127.0.0.1:{port}", f"localhost:{port}")
        self.cookie = f"scapekit-{port}"                # cookies are shared by all ports of a machine
        self._openings: list[str] = []

    def opening(self) -> str:
        """A token for one use: other users of the machine can see the command line of a browser that starts."""
        # addresses for one use that may be unused at a time
        self._openings = [*self._openings[1 - 16:], secrets.token_urlsafe(32)]
        return self._openings[-1]

    def use(self, opening: str) -> bool:
        """Whether this is a token for one use, which it is no more afterwards."""
        known = [one for one in self._openings if same(one, opening)]
        self._openings = [one for one in self._openings if one not in known]
        return bool(known)

    def wrong_host(self, host: str) -> bool:
        """Whether the address asked for is not ours: a foreign name may lead to this machine."""
        return host.lower() not in self.hosts

    def wrong_origin(self, host: str, origin: str | None) -> bool:
        """Whether another page than ours asks."""
        return origin is None or origin.lower() != f"http://{host.lower()}"

    def wrong_token(self, given: str | None, cookie: str | None) -> bool:
        """Whether neither the address nor, where it names none, the cookie has the token."""
        return not same(self.token, (cookie if given is None else given) or "")


def same(secret: str, given: str) -> bool:
    """Whether two texts are equal, in a time that does not tell where they differ."""
    return secrets.compare_digest(secret.encode("utf-8"), given.encode("utf-8", "replace"))


def one_line(text: str) -> str:
    """Text of a request, fit for a terminal: no control characters, no line ends, not long."""
    text = "".join(c if c.isprintable() else "?" for c in text)
    longest_line = 200  # characters of one line about a request
    return text if len(text) <= longest_line else text[:longest_line] + "..."


def file_name(name: str) -> str:
    """The last component of a name that a browser gave, in characters that every disk takes; ValueError for none."""
    last = re.split(r"[/\\]", name)[-1]
    last = re.sub(r"[^\w .()+-]", "_", last).strip(" ")
    if not last.strip(". "):
        raise ValueError("name: expected the name of a file")
    longest_name = 120  # characters of the name of a stored file
    return last if len(last) <= longest_name else last[-longest_name:].lstrip(" ")


def file_inside(folders: Iterable[Path], name: str) -> Path:
    """The file of this name in one of the folders, links followed; ValueError where there is none inside."""
    if not name or PurePosixPath(name).is_absolute() or PureWindowsPath(name).anchor:
        raise ValueError("expected a name inside of a folder")
    for folder in folders:
        try:
            path, within = (folder / name).resolve(), folder.resolve()
            if path.is_relative_to(within) and path.is_file():
                return path
        except (OSError, ValueError, RuntimeError):      # no name that a disk takes, or links in a circle
            continue
    raise ValueError("no such file in the folders of this server")
