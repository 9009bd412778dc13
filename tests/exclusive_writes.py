"""Notes every file that scapekit opens for writing without having made it: a link there would lead anywhere."""
import os
import sys
from importlib.util import find_spec
from pathlib import Path

# where the packages are: in this folder, or installed
OURS = tuple(find_spec(name).submodule_search_locations[0] + os.sep for name in ("scanprep", "model", "completion"))
WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND


class ExclusiveWrites:
    """Listens to the interpreter; `wrong` are the files that were opened, and by which function."""

    def __init__(self):
        self.wrong, self.made, self.folders = [], set(), set()
        sys.addaudithook(self._hear)

    def opened(self, path):
        """Take note of a file that is opened for writing, where a test wants to know."""

    def _hear(self, event, args):
        if event == "open" and isinstance(args[0], str | bytes | os.PathLike) and isinstance(args[2], int):
            self._opened(os.path.abspath(os.fsdecode(args[0])), args[2])
        elif event == "os.mkdir":
            path = os.path.abspath(os.fsdecode(args[0]))
            if not os.path.lexists(path) and _our_frame() is not None:
                self.folders.add(path)

    def _opened(self, path, flags):
        if not flags & WRITES or path == os.devnull:
            return
        self.opened(path)
        if flags & os.O_EXCL:
            self.made.add(path)
        elif path not in self.made and not self._in_new_folder(path) and (frame := _our_frame()) is not None \
                and not ("batch/opening.py" in frame and flags & os.O_NOFOLLOW):           # a lock is there for others
            self.wrong.append(f"{path}, opened for writing by {frame}")

    def _in_new_folder(self, path):
        """Return whether a folder on the way was made by us, and so had nothing in it."""
        return any(str(parent) in self.folders for parent in Path(path).parents)


def _our_frame():
    """Return the function of ours that runs now, as file and line; None where a test writes."""
    frame = sys._getframe()
    while frame is not None:
        name = frame.f_code.co_filename
        if name.startswith(OURS):
            return f"{name}:{frame.f_lineno}"
        if os.path.basename(name).startswith("test_"):
            return None
        frame = frame.f_back
    return None
