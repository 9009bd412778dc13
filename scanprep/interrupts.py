"""Ctrl-C while a command is being loaded, which takes a second: one line, as later on."""
from __future__ import annotations

import os
import signal
import sys


def leave_if_command() -> None:
    """`leave_at_once` where this process is the command `scape`, not a program that imports the packages or a worker.

    Other libraries take long enough to load for a Ctrl-C in them to be seen; hence it comes before all of them.
    """
    program = sys.orig_argv[1:3]
    if program == ["-m", "completion"] or os.path.basename(program[0] if program else "") in ("scape", "scape.exe"):
        leave_at_once()


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
