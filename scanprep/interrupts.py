"""Ctrl-C while a command is still loading, which takes a second: end with one line, as later on."""
from __future__ import annotations

import os
import signal
import sys


def leave_if_command() -> None:
    """Call `leave_at_once` if this process is the command `scape`, not a worker or a program that imports scapekit.

    It runs before other libraries are imported: they take so long that Ctrl-C often falls into their loading.
    """
    program = sys.orig_argv[1:3]
    if program == ["-m", "completion"] or os.path.basename(program[0] if program else "") in ("scape", "scape.exe"):
        leave_at_once()


def leave_at_once() -> None:
    """From here on Ctrl-C ends the process: libraries that are just loading would turn it into other errors."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:       # a shell may have it ignored
        signal.signal(signal.SIGINT, _leave)


def tidy_up() -> None:
    """From here on Ctrl-C is an exception again, so that unfinished files are removed."""
    if signal.getsignal(signal.SIGINT) is _leave:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _leave(_signal: int, _frame: object) -> None:
    """End the process at once; 130 is the exit code of a program ended by Ctrl-C."""
    sys.stderr.write("scape: interrupted; nothing was written\n")
    sys.stderr.flush()
    os._exit(130)
