"""Opening an output for one run: no other gets in, foreign files stay, and what a killed run left is put right."""
from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

from .lock import locked
from .ownership import HOME, ForeignFileError, refusal, refuse_any, report_path, written_of
from .workspace import Workspace

FileWorkspace = Annotated[Workspace, "steps of a command whose output is a file; they are kept beside it"]
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
    with _opened(Workspace(folder, folder / HOME, force)) as space:
        yield space


@contextlib.contextmanager
def beside(output: str | Path, force: bool = False) -> Iterator[Workspace]:
    """Open an output that is a file, or a folder that is made at once: what is kept meanwhile lies beside it.

    At the end that is removed; what was written is told by the report beside the output. Errors as `workspace`.
    """
    output = Path(output)
    space = Workspace(output.parent, output.parent / f".{output.name}{HOME}", force, output)
    with _opened(space):                    # first what a killed run had finished comes to its place, and is ours
        if output.is_dir() and not (output / HOME).is_dir() and not written_of(report_path(output)):
            refuse_any(output)
        if output.is_file() and not space.is_ours(output.name):
            raise ForeignFileError(refusal(output))
        yield space


@contextlib.contextmanager
def _opened(space: Workspace) -> Iterator[Workspace]:
    """Locked, and put right where an earlier run was killed; of one that came to nothing, nothing is left."""
    key, made = space.home.absolute(), [p for p in (space.home, *space.home.parents) if not p.exists()]
    space.home.mkdir(parents=True, exist_ok=True)
    with locked(space.home / "lock", space.output or space.folder):
        space._recover()
        _open[key] = space
        try:
            yield space
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
