"""Opening an output for one run: lock it, protect foreign files, and repair what a killed run left."""
from __future__ import annotations

import contextlib
import os
import platform
import shutil
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Annotated

from .ownership import HOME, ForeignFileError, digests_in_report, refusal, refuse_any
from .workspace import NothingMadeError, Workspace

FileWorkspace = Annotated[Workspace, "steps of a command whose output is a file; they are kept beside it"]
AnyWorkspace = Annotated[FileWorkspace, "as a FileWorkspace where the output has an ending; else a folder"]
_open: dict[Path, Workspace] = {}       # outputs open in this process: a nested call gets the same workspace


@contextlib.contextmanager
def workspace(folder: str | Path, force: bool = False) -> Iterator[Workspace]:
    """Open an output folder for one run, lock it, and repair what a killed run left.

    Opened again inside the block, it is the same workspace. With `force` no earlier result counts as done.

    Raises
    ------
    ValueError
        Another run is at work in the folder.
    ForeignFileError
        The folder holds files that scapekit did not write.
    """
    folder = Path(folder)
    if (folder / HOME).absolute() in _open:
        yield _open[(folder / HOME).absolute()]
        return
    if folder.exists() and not folder.is_dir():
        raise ForeignFileError(f"{folder}: expected a folder for the output, found a file")
    # a folder without our records must be empty, or it belongs to somebody else
    if not (folder / HOME).is_dir():
        refuse_any(folder)
    with _lock_and_recover(Workspace(folder, folder / HOME, force)) as space:
        yield space


@contextlib.contextmanager
def beside(output: str | Path, force: bool = False) -> Iterator[Workspace]:
    """Open an output that is a file, or a folder written in one go; intermediate results lie beside it.

    They are removed at the end. What was written is recorded in the report beside the output. Errors as `workspace`.
    """
    output = Path(output)
    space = Workspace(output.parent, output.parent / f".{output.name}{HOME}", force, output)
    with _lock_and_recover(space):                # first, so that files finished by a killed run count as ours
        if output.is_dir() and not (output / HOME).is_dir() and not digests_in_report(output):
            refuse_any(output)
        if output.is_file() and not space.is_ours(output.name):
            raise ForeignFileError(refusal(output))
        yield space


@contextlib.contextmanager
def _lock_and_recover(space: Workspace) -> Iterator[Workspace]:
    """Lock a workspace, repair it, and on leaving remove what need not stay."""
    key, made = space.home.absolute(), [p for p in (space.home, *space.home.parents) if not p.exists()]
    for place in (space.home, *(Path(parent) / name for parent, folders, files in os.walk(space.home)
                                for name in (*folders, *files))):
        if place.is_symlink():                              # through a link, files elsewhere would be moved or removed
            raise ForeignFileError(f"{place}: expected a file or folder that scapekit made, found a link; remove it")
    space.home.mkdir(parents=True, exist_ok=True)
    space.is_new = space.folder in made
    # while the lock is held: repair, run the caller's block, clean up
    with lock_output(space.home / "lock", space.output or space.folder):
        space._recover()
        _open[key] = space
        try:
            yield space
        except NothingMadeError:
            space.drop_others("")
            raise
        finally:
            del _open[key]
            shutil.rmtree(space.home / "making", ignore_errors=True)
            if space.output is not None:
                space.drop_record("output")                 # the report keeps this record
            if any(space.home.glob("[drs]*/*")):            # any results in the folders done, ready and steps?
                space.digests.save()
            else:
                # nothing was kept: remove the folders that this run made
                shutil.rmtree(space.home)
                with contextlib.suppress(OSError):          # somebody else has put files there
                    for folder in made[1:]:
                        folder.rmdir()


@contextlib.contextmanager
def lock_output(path: Path, output: Path) -> Iterator[None]:
    """Keep other runs out of an output until the block ends.

    The operating system holds the lock, so a killed run leaves none behind. `output` is for the message.

    Raises
    ------
    ValueError
        Another run holds the lock.
    """
    while True:
        # never through a link, which would write elsewhere
        flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | getattr(os, "O_NOFOLLOW", 0)
        with open(os.open(path, flags, 0o666), "a+", encoding="utf-8") as file:
            if not _take(file):
                file.seek(0)
                raise ValueError(f"{output}: another run is at work on this output ({file.read().strip()}); "
                                 "wait for it, or name another output")
            try:
                if os.fstat(file.fileno()).st_ino != path.stat().st_ino:
                    continue            # the run before removed the file after we opened it: try again
            except OSError:
                continue
            # write who holds the lock, for the message to others
            file.truncate(0)
            file.write(f"process {os.getpid()} on {platform.node()}, since {time.strftime('%Y-%m-%d %H:%M:%S')}\n")
            file.flush()
            try:
                yield
            finally:
                with contextlib.suppress(OSError):      # Windows cannot remove an open file: it stays, unlocked
                    path.unlink()
            return


def _take(file: IO[str]) -> bool:
    """Try to lock an open file; return whether it worked."""
    try:
        if sys.platform == "win32":
            import msvcrt

            file.seek(1 << 20)          # lock one byte far behind the text, so that others can read who holds the lock
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
