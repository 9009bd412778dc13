"""Messages with the right token and wrong contents, for any app behind the viewer's server."""
import inspect

import numpy as np
from socket_client import Page

from completion.viewing.app import MOVES
from scanprep.viewer.server import Server

NEST = [[]]
for _ in range(300):
    NEST = [NEST]
VALUES = (None, True, False, -1, 0, 1, 2, 7, 2**53, 10**40, -1e308, 1e308, 0.5, "", "x", "left toe", "x" * 100_000,
          "../../etc", "\ud800", "a\nb\x1b[2J", [], [1, 2], [0, 0, 0], [1, 2, 3], [1e308] * 3, [None] * 3, ["x"],
          list(range(3000)), NEST, {}, {"a": {"b": []}})
# what begins long work is sent with a field too much, so that it never begins
LONG = {"predict", "complete", "doubt", "register", "take_rival", "run"}


def hostile_messages(app, count, seed):
    """Yield messages: known and unknown kinds, with fields that lack, are too many, or are of any type."""
    rng = np.random.default_rng(seed)
    known = {name[3:]: getattr(type(app), name) for name in dir(type(app)) if name.startswith("on_")} | \
        (dict(MOVES) if app.name == "view" else {})
    kinds = [*known, *known, "surface", "", "__init__", "no such kind"]
    good = {"name": getattr(app, "chosen", "x"), "origin": [0.1, -3, 1], "direction": [0.01, 1, 0.02], "pane": 0,
            "entries": [0], "scan": 0}
    for _ in range(count):
        kind = kinds[rng.integers(len(kinds))]
        names = [*inspect.signature(known[kind]).parameters][1:] if kind in known else ["scan"]
        # half of the fields are right, so that the others are reached
        fields = {name: good[name] if name in good and rng.random() < 0.5 else VALUES[rng.integers(len(VALUES))]
                  for name in names if name != "send" and rng.random() < 0.93}
        if kind in LONG or rng.random() < 0.1:
            fields["more"] = VALUES[rng.integers(len(VALUES))]
        yield kind or "x", fields


def check_it_goes_on(app, capfd, count=300, seed=0):
    """Send them, and check that each is taken or refused in one line, and that the app still answers."""
    told = []
    with Server(app, say=told.append) as server:
        page = Page(server)
        page.next()
        for number, (kind, fields) in enumerate(hostile_messages(app, count, seed), 1):
            assert page.send(kind, number, **fields) == 200
        page.send("a question", count + 1)
        while "a question" not in page.receive("error").fields["text"]:
            pass
    assert not told, told[0]
    assert "Traceback" not in capfd.readouterr().err
