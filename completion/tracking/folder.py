"""Folders of frames: which file is which frame and camera; tracking in chunks that are kept for a later run."""
from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scanprep.batch.workspace import Workspace
from scanprep.geometry.files import (
    ENDINGS,
    EmptyFileError,
    MeshFileError,
    PointCloud,
    common_unit,
    ending_of,
    list_files,
    name_of,
    read_points,
    write_mesh,
)
from scanprep.registration.unit import resolve_unit

from ..motion import Progress
from .sequence import BodyTracker, TrackedFrame, TrackerState, without_points


class FrameFolder:
    """Frames in the order of the numbers in their names: in one folder, or one folder per camera.

    A missing number is a frame in which nothing was seen.
    """

    def __init__(self, folder: Path, unit: str | None = None) -> None:
        self.folder, self.unit = folder, unit
        self.problems: list[str] = []
        if not folder.is_dir():
            raise ValueError(f"{folder}: " + ("expected a folder of frames, found a file" if folder.exists()
                                              else "no such folder"))
        self._paths = _by_folder(folder)
        self.cameras = tuple(self._paths)
        # at most as many missing numbers as frames; with more, the numbers only give the order
        order = sorted({n for files in self._paths.values() for n in files})
        step = int(np.gcd.reduce(np.diff(order))) if len(order) > 1 else 1
        filled = list(range(order[0], order[-1] + 1, step))
        self.numbers = filled if len(filled) <= 2 * len(order) else order
        files = [path for files in self._paths.values() for path in files.values()]
        self.unit = resolve_unit(files[0], common_unit(files, self.unit))

    def __len__(self) -> int:
        return len(self.numbers)

    def __iter__(self) -> Iterator[list[PointCloud]]:
        return (self[i] for i in range(len(self)))

    def __getitem__(self, i: int) -> list[PointCloud]:
        """Read the views of frame i; a file that cannot be read counts as a camera that saw nothing."""
        views = []
        for path in self.paths(i):
            try:
                views.append(read_points(path, self.unit))
            except EmptyFileError:               # nothing was seen
                continue
            except MeshFileError as error:
                if str(error) not in self.problems:
                    self.problems.append(str(error))
        return views

    def paths(self, i: int) -> list[Path]:
        """Return the files of frame i."""
        return [files[self.numbers[i]] for files in self._paths.values() if self.numbers[i] in files]


def _by_folder(folder: Path) -> dict[str, dict[int, Path]]:
    """Map each camera to the files of a folder, or of its sub-folders, by the last number in their names."""
    inner = [("", folder), *((path.name, path) for path in sorted(folder.iterdir()) if path.is_dir())]
    files: dict[str, dict[int, Path]] = {}
    for camera, place in inner:
        for path in [] if "" in files else list_files(place, lambda path: ending_of(path) in ENDINGS):
            # the frame is the last number in the name
            digits = re.findall(r"\d+", name_of(path))
            if not digits:
                raise ValueError(f"{path}: expected the number of the frame in its name")
            own, number = files.setdefault(camera, {}), int(digits[-1])
            if number in own:
                raise ValueError(f"{place}: {own[number].name} and {path.name} are both frame {number}; put cameras "
                                 "into folders of their own")
            own[number] = path
    if not files:
        raise ValueError(f"{folder}: expected frames ({', '.join(ENDINGS)}) in it, or in one folder for each camera, "
                         "found none")
    return files


@dataclass(frozen=True, eq=False)
class TrackedFolder:
    """All frames of a folder."""

    frames: list[TrackedFrame]
    state: TrackerState             # of the tracker at the end
    key: str                        # digest of everything the frames depend on
    fresh: int                      # frames that were tracked in this run


def follow_folder(tracker: BodyTracker, frames: FrameFolder, space: Workspace, key: str, surfaces: bool = False,
                  progress: Progress | None = None) -> TrackedFolder:
    """Track a body through a folder of frames; frames that were tracked in an earlier run are not tracked again.

    Frames are kept in chunks, with the tracker's state at their end. A chunk depends on every file up to its last frame
    and on nothing after it. Where one is missing, damaged or changed, the tracker resumes from the chunk before.
    """
    done: list[TrackedFrame] = []
    # 5 frames a chunk: so many are lost at most when the run is stopped
    state, fresh, names, at_once = tracker.state, 0, [], 5
    start = "frames/"  # prefix of the names of kept chunks
    for first in (*range(0, len(frames), at_once), len(frames)):
        chunk = range(first, min(first + at_once, len(frames)))
        files = [[(path.relative_to(frames.folder).as_posix(), path) for path in frames.paths(i)] for i in chunk]
        key = space.digests.of(key, files)
        names.append(f"{start}{first:08d}" if chunk else f"{start}end")

        def follow(folder: Path, chunk: range = chunk, before: TrackerState = state
                   ) -> tuple[tuple[TrackedFrame, ...], TrackerState, tuple[str, ...]]:
            """Track the frames of a chunk; return final frames, state, and problems of files without the folder."""
            nonlocal fresh
            fresh += len(chunk)
            if tracker.state.number != before.number:
                tracker.resume(before)
            known = len(frames.problems)
            # the last chunk is empty: it takes the frames that were still waiting
            ready = [frame for i in chunk for frame in tracker.push(frames[i])] if chunk else tracker.finish()
            for frame in ready if surfaces else ():
                write_mesh(folder / "surfaces" / f"{frame.number:06d}.ply", tracker.surface(frame), "single")
            problems = tuple(text.removeprefix(str(frames.folder)) for text in frames.problems[known:])
            del frames.problems[known:]
            return tuple(without_points(frame) for frame in ready), tracker.state, problems

        ready, state, problems = space.step(names[-1], key, follow)
        done += ready
        frames.problems += [f"{frames.folder}{text}" for text in problems]
        if progress is not None:
            progress(first + len(chunk), len(frames))
    space.drop_others(start, names)                          # chunks of an earlier, longer recording
    return TrackedFolder(done, state, key, fresh)
