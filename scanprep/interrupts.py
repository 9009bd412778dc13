"""Ctrl-C while a command is being loaded, which takes a second: one line, as later on."""
from __future__ import annotations

import os
import signal
import sys


def leave_at_once() -> None:
    """From here on Ctrl-C ends the process: libraries that are being loaded make other errors of it."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:       # not where a shell wants it ignored
        signal.signal(signal.SIGINT, _leave)


def tidy_up() -> None:
    """From here on Ctrl-C is an exception again, so that what is half done is put away."""
    if signal.getsignal(signal.SIGINT) is _leave:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _leave(_signal: int, _frame: object) -> None:
    sys.stderr.write("scape: interrupted; nothing was written\n")
    sys.stderr.flush()
    os._exit(130)
