"""Ctrl-C and SIGTERM end a command with one line, also while it is still loading, which takes a second."""
from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Iterator


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


@contextlib.contextmanager
def terminate_as_interrupt() -> Iterator[None]:
    """Make SIGTERM, as a cluster or a shutdown sends it, end the block as Ctrl-C does: with its processes and files."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _leave(_signal: int, _frame: object) -> None:
    """End the process at once; 130 is the exit code of a program ended by Ctrl-C."""
    sys.stderr.write("scape: interrupted; nothing was written\n")
    sys.stderr.flush()
    os._exit(130)
