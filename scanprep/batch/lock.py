"""One run at a time on an output."""
from __future__ import annotations

import contextlib
import os
import platform
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO

LOOK = 0.2                     # seconds between two looks whether the other run has ended

@contextlib.contextmanager
def locked(path: Path, output: Path, wait: bool = False) -> Iterator[None]:
    """Keep other runs out of an output until the block ends: ValueError, or wait for them.

    The operating system holds the lock, so that a run that was killed leaves none behind. `output` is for the message.
    """
    while True:
        with open(path, "a+", encoding="utf-8") as file:
            if not _take(file):
                if wait:
                    time.sleep(LOOK)
                    continue
                file.seek(0)
                raise ValueError(f"{output}: another run is at work on this output ({file.read().strip()}); "
                                 "wait for it, or name another output")
            if not _still_there(file, path):
                continue                # the run before removed it between our opening and our taking it
            file.truncate(0)
            file.write(f"process {os.getpid()} on {platform.node()}, since {time.strftime('%Y-%m-%d %H:%M:%S')}\n")
            file.flush()
            try:
                yield
            finally:
                with contextlib.suppress(OSError):      # where open files cannot be removed it stays, unlocked
                    path.unlink()
            return


def _still_there(file: IO[str], path: Path) -> bool:
    with contextlib.suppress(OSError):
        return os.fstat(file.fileno()).st_ino == path.stat().st_ino
    return False


def _take(file: IO[str]) -> bool:
    """Whether the lock of an open file could be had at once."""
    try:
        if sys.platform == "win32":
            import msvcrt

            file.seek(1 << 20)          # a place nobody reads: others may still read who holds the lock
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
