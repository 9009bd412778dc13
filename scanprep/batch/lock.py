"""One run at a time in a folder."""
from __future__ import annotations

import contextlib
import os
import platform
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO

NAME = ".lock"


@contextlib.contextmanager
def locked(folder: str | Path) -> Iterator[None]:
    """Keep other runs out of a folder until the block ends.

    The operating system holds the lock, so that a run that was killed leaves none behind.

    Raises
    ------
    ValueError
        Another run is at work in the folder: which, and since when.
    """
    path = Path(folder) / NAME
    path.parent.mkdir(parents=True, exist_ok=True)
    while True:
        with open(path, "a+", encoding="utf-8") as file:
            if not _take(file):
                file.seek(0)
                raise ValueError(f"{folder}: another run is at work in this folder ({file.read().strip()}); "
                                 "wait for it, or name another folder")
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
