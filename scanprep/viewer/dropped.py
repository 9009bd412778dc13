"""Files that were dropped on a page: kept for as long as the program runs, the last of each name."""
from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from ..depth_camera.picture import CAMERA, camera_file, is_camera, is_picture, read_distances


class Dropped:
    """A temporary folder with the files that were dropped, which is made with the first."""

    def __init__(self) -> None:
        self._folder: Path | None = None

    @property
    def folder(self) -> Path:
        """Where they are."""
        if self._folder is None:
            self._folder = Path(tempfile.mkdtemp(prefix="scapekit-"))
        return self._folder

    def holds(self, path: Path) -> bool:
        """Whether this is one of its files."""
        return path.parent == self._folder

    @contextlib.contextmanager
    def keeping(self, name: str, path: Path) -> Iterator[Path]:
        """A copy of a file in place of the one of its name, which comes back if the block raises.

        What a ValueError says of it, it says by its name alone.
        """
        kept, earlier = self.folder / name, self.folder / f".{name}.earlier"
        if kept.exists():
            kept.replace(earlier)
        try:
            shutil.copyfile(path, kept)
            yield kept
        except BaseException as problem:
            kept.unlink(missing_ok=True)
            if earlier.exists():
                earlier.replace(kept)
            if isinstance(problem, ValueError):
                raise ValueError(str(problem).replace(f"{self.folder}{os.sep}", "")) from problem
            raise
        earlier.unlink(missing_ok=True)

    def close(self) -> None:
        """Forget all."""
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)


def with_camera(path: Path) -> tuple[Path, str]:
    """The file to open for one that was dropped, and what it still lacks: a depth picture and its camera are one.

    ValueError for another kind of picture.
    """
    if is_camera(path):
        picture = path.with_name(path.name[:-len(CAMERA)] + ".png")
        return picture, "" if picture.exists() else f"{path.name} is kept: now drop its depth picture, {picture.name}"
    if is_picture(path) and not camera_file(path).exists():
        read_distances(path)
        return path, f"{path.name} is kept: now drop its camera, {camera_file(path).name}"
    return path, ""
