"""Opening an output for one run: no other gets in, foreign files stay, and what a killed run left is put right."""
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
_open: dict[Path, Workspace] = {}


@contextlib.contextmanager
def workspace(folder: str | Path, force: bool = False) -> Iterator[Workspace]:
    """Open an output folder for one run: no other gets in, and what a killed one left is put right.

    Opened again inside, it is the same one. With `force` nothing counts as done. ValueError where another run is at
    work, ForeignFileError where files are in it that scapekit did not make.
    """
    folder = Path(folder)
    if (folder / HOME).absolute() in _open:
        yield _open[(folder / HOME).absolute()]
        return
    if folder.exists() and not folder.is_dir():
        raise ForeignFileError(f"{folder}: expected a folder for the output, found a file")
    if not (folder / HOME).is_dir():
        refuse_any(folder)
    with _lock_and_recover(Workspace(folder, folder / HOME, force)) as space:
        yield space


@contextlib.contextmanager
def beside(output: str | Path, force: bool = False) -> Iterator[Workspace]:
    """Open an output that is a file, or a folder that is made at once: what is kept meanwhile lies beside it.

    At the end that is removed; what was written is told by the report beside the output. Errors as `workspace`.
    """
    output = Path(output)
    space = Workspace(output.parent, output.parent / f".{output.name}{HOME}", force, output)
    with _lock_and_recover(space):                # first what a killed run had finished comes to its place, and is ours
        if output.is_dir() and not (output / HOME).is_dir() and not digests_in_report(output):
            refuse_any(output)
        if output.is_file() and not space.is_ours(output.name):
            raise ForeignFileError(refusal(output))
        yield space


@contextlib.contextmanager
def _lock_and_recover(space: Workspace) -> Iterator[Workspace]:
    """Locked, and put right where an earlier run was killed; of one that came to nothing, nothing is left."""
    key, made = space.home.absolute(), [p for p in (space.home, *space.home.parents) if not p.exists()]
    for place in (space.home, *(Path(parent) / name for parent, folders, files in os.walk(space.home)
                                for name in (*folders, *files))):
        if place.is_symlink():                              # what is moved and removed there would be elsewhere
            raise ForeignFileError(f"{place}: expected a file or folder that scapekit made, found a link; remove it")
    space.home.mkdir(parents=True, exist_ok=True)
    space.is_new = space.folder in made
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
                space.drop_record("output")                 # the report tells what was written
            if any(space.home.glob("[drs]*/*")):            # done, ready, steps
                space.digests.save()
            else:
                shutil.rmtree(space.home)
                with contextlib.suppress(OSError):          # others have put something there
                    for folder in made[1:]:
                        folder.rmdir()


@contextlib.contextmanager
def lock_output(path: Path, output: Path, wait: bool = False) -> Iterator[None]:
    """Keep other runs out of an output until the block ends: ValueError, or wait for them.

    The operating system holds the lock, so that a run that was killed leaves none behind. `output` is for the message.
    """
    while True:
        with open(path, "a+", encoding="utf-8") as file:
            if not _take(file):
                if wait:
                    time.sleep(0.2)
                    continue
                file.seek(0)
                raise ValueError(f"{output}: another run is at work on this output ({file.read().strip()}); "
                                 "wait for it, or name another output")
            try:
                if os.fstat(file.fileno()).st_ino != path.stat().st_ino:
                    continue            # the run before removed it between our opening and our taking it
            except OSError:
                continue
            file.truncate(0)
            file.write(f"process {os.getpid()} on {platform.node()}, since {time.strftime('%Y-%m-%d %H:%M:%S')}\n")
            file.flush()
            try:
                yield
            finally:
                with contextlib.suppress(OSError):      # where open files cannot be removed it stays, unlocked
                    path.unlink()
            return


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
