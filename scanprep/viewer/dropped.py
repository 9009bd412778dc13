"""Files dropped on a page: kept while the program runs, the last of each name."""
from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from ..depth_camera.picture import CAMERA, camera_file, is_camera, is_picture, read_distances


class Dropped:
    """A temporary folder for dropped files, created with the first of them."""

    def __init__(self) -> None:
        self._folder: Path | None = None

    @property
    def folder(self) -> Path:
        """Return the folder; it is created when first used."""
        if self._folder is None:
            self._folder = Path(tempfile.mkdtemp(prefix="scapekit-"))
        return self._folder

    def holds(self, path: Path) -> bool:
        """Return whether a path is one of the dropped files."""
        return path.parent == self._folder

    @contextlib.contextmanager
    def keeping(self, name: str, path: Path) -> Iterator[Path]:
        """Copy a file over the one of the same name, which is restored if the block raises an error.

        In the text of a ValueError the file is called by its name, without the folder.
        """
        copy, earlier = self.folder / name, self.folder / f".{name}.earlier"
        if copy.exists():
            copy.replace(earlier)
        try:
            shutil.copyfile(path, copy)
            yield copy
        except BaseException as problem:
            copy.unlink(missing_ok=True)
            if earlier.exists():
                earlier.replace(copy)
            if isinstance(problem, ValueError):
                raise ValueError(str(problem).replace(f"{self.folder}{os.sep}", "")) from problem
            raise
        earlier.unlink(missing_ok=True)

    def close(self) -> None:
        """Remove all files."""
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)


def with_camera(path: Path) -> tuple[Path, str]:
    """Return the file to open for a dropped one, and what it still lacks: a depth picture needs its camera file.

    ValueError for another kind of picture.
    """
    # the camera came: open the picture, if it is there already
    if is_camera(path):
        picture = path.with_name(path.name[:-len(CAMERA)] + ".png")
        return picture, "" if picture.exists() else f"{path.name} is kept: now drop its depth picture, {picture.name}"
    if is_picture(path) and not camera_file(path).exists():
        read_distances(path)
        return path, f"{path.name} is kept: now drop its camera, {camera_file(path).name}"
    return path, ""
