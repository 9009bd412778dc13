"""What a folder holds, and what is left in it where a run dies."""
import contextlib
import itertools
import os
import shutil

from scanprep.batch.ownership import HOME


def tree(folder, *apart):
    """Path -> bytes of all files but those of these names, and what scapekit keeps there for itself."""
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*"))
            if p.is_file() and p.name not in apart and HOME not in p.parts}


class Killed(BaseException):
    pass


def die_at_move(monkeypatch, at, run):
    """Run something that dies at one of its renames, by their number, where nobody tidies up."""
    moves, replace = itertools.count(), os.replace

    def move(source, target):
        if next(moves) == at:
            raise Killed
        replace(source, target)

    with monkeypatch.context() as patch, contextlib.suppress(Killed):
        patch.setattr(os, "replace", move)
        patch.setattr(shutil, "rmtree", lambda *args, **named: None)
        run()
