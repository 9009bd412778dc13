"""A folder of frames: which file is which frame and camera; frames followed a few at a time, each few kept."""
from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scanprep.arguments import UsageError
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

from ..motion import Progress
from .sequence import BodyTracker, TrackedFrame, TrackerState, without_points


class FrameFolder:
    """Frames in the order of the numbers in their names: in a folder, in one for each camera, or named by a pattern.

    A number that is left out is a frame in which nothing was seen.
    """

    def __init__(self, folder: Path, pattern: str | None = None, unit: str | None = None) -> None:
        self.folder, self.unit = folder, unit
        self.problems: list[str] = []
        if not folder.is_dir():
            raise ValueError(f"{folder}: " + ("expected a folder of frames, found a file" if folder.exists()
                                              else "no such folder"))
        self._paths = _by_pattern(folder, pattern) if pattern else _by_folder(folder)
        self.cameras = tuple(self._paths)
        # numbers may leave out as many frames as there are; else they only give the order
        order = sorted({n for files in self._paths.values() for n in files})
        step = int(np.gcd.reduce(np.diff(order))) if len(order) > 1 else 1
        filled = list(range(order[0], order[-1] + 1, step))
        self.numbers = filled if len(filled) <= 2 * len(order) else order
        self.unit = common_unit([path for files in self._paths.values() for path in files.values()], self.unit)

    def __len__(self) -> int:
        return len(self.numbers)

    def __iter__(self) -> Iterator[list[PointCloud]]:
        return (self[i] for i in range(len(self)))

    def __getitem__(self, i: int) -> list[PointCloud]:
        """What the cameras saw in frame i; a file that cannot be read is a camera that saw nothing."""
        found = []
        for path in self.paths(i):
            try:
                found.append(read_points(path, self.unit))
            except EmptyFileError:               # the camera saw nothing
                continue
            except MeshFileError as error:
                if str(error) not in self.problems:
                    self.problems.append(str(error))
        return found

    def paths(self, i: int) -> list[Path]:
        """The files of frame i."""
        return [files[self.numbers[i]] for files in self._paths.values() if self.numbers[i] in files]


def _by_folder(folder: Path) -> dict[str, dict[int, Path]]:
    """Camera -> the files of a folder, or of those in it, by the last number in their names."""
    inner = [("", folder), *((path.name, path) for path in sorted(folder.iterdir()) if path.is_dir())]
    found: dict[str, dict[int, Path]] = {}
    for camera, place in inner:
        for path in [] if "" in found else list_files(place, lambda path: ending_of(path) in ENDINGS):
            digits = re.findall(r"\d+", name_of(path))
            if not digits:
                raise ValueError(f"{path}: expected the number of the frame in its name")
            own, number = found.setdefault(camera, {}), int(digits[-1])
            if number in own:
                raise ValueError(f"{place}: {own[number].name} and {path.name} are both frame {number}; put cameras "
                                 "into folders of their own, or name them with --cameras")
            own[number] = path
    if not found:
        raise ValueError(f"{folder}: expected frames ({', '.join(ENDINGS)}) in it, or in one folder for each camera, "
                         "found none")
    return found


def _by_pattern(folder: Path, pattern: str) -> dict[str, dict[int, Path]]:
    """Camera -> files by number, of names such as "cam{camera}_{frame}.ply"."""
    if "{camera}" not in pattern or "{frame}" not in pattern:
        raise UsageError(f"--cameras: expected a name with {{camera}} and {{frame}} in it, got '{pattern}'")
    expression = re.escape(pattern).replace(r"\{camera\}", "(?P<camera>.+?)").replace(r"\{frame\}", r"(?P<frame>\d+)")
    found: dict[str, dict[int, Path]] = {}
    for path in sorted(folder.rglob("*")):
        match = re.fullmatch(expression, path.relative_to(folder).as_posix())
        if match and path.is_file():
            own, number = found.setdefault(match["camera"], {}), int(match["frame"])
            if number in own:
                raise ValueError(f"{folder}: {own[number].name} and {path.name} are both frame {number} of camera "
                                 f"{match['camera']}")
            own[number] = path
    if not found:
        raise ValueError(f"{folder}: no file is named as --cameras '{pattern}' says")
    return dict(sorted(found.items()))


@dataclass(frozen=True, eq=False)
class TrackedFolder:
    """All frames of a folder."""

    frames: list[TrackedFrame]
    state: TrackerState             # at the end
    key: str                        # changes with everything they depend on
    fresh: int                      # frames that were followed now; the others had been before


def follow_folder(tracker: BodyTracker, frames: FrameFolder, space: Workspace, key: str, surfaces: bool = False,
                  progress: Progress | None = None) -> TrackedFolder:
    """Follow a body through a folder of frames; those that were followed before are not followed again.

    What is kept of a chunk, with the tracker's state, depends on every file up to its last frame and nothing after it:
    when one is missing, damaged or changed, the tracker goes on from the end of the one before.
    """
    done: list[TrackedFrame] = []
    state, fresh, names, at_once = tracker.state, 0, [], 5
    start = "frames/"  # of the names of what is kept
    for first in (*range(0, len(frames), at_once), len(frames)):
        mine = range(first, min(first + at_once, len(frames)))
        files = [[(path.relative_to(frames.folder).as_posix(), path) for path in frames.paths(i)] for i in mine]
        key = space.digests.of(key, files)
        names.append(f"{start}{first:08d}" if mine else f"{start}end")

        def follow(folder: Path, mine: range = mine, before: TrackerState = state
                   ) -> tuple[tuple[TrackedFrame, ...], TrackerState, tuple[str, ...]]:
            """The frames that are ready, the state after them, and what was wrong with files, the folder left out."""
            nonlocal fresh
            fresh += len(mine)
            if tracker.state.number != before.number:
                tracker.resume(before)
            known = len(frames.problems)
            # none are pushed at the end, for those that were waiting
            ready = [frame for i in mine for frame in tracker.push(frames[i])] if mine else tracker.finish()
            for frame in ready if surfaces else ():
                write_mesh(folder / "surfaces" / f"{frame.number:06d}.ply", tracker.surface(frame), "single")
            problems = tuple(text.removeprefix(str(frames.folder)) for text in frames.problems[known:])
            del frames.problems[known:]
            return tuple(without_points(frame) for frame in ready), tracker.state, problems

        ready, state, problems = space.step(names[-1], key, follow)
        done += ready
        frames.problems += [f"{frames.folder}{text}" for text in problems]
        if progress is not None:
            progress(first + len(mine), len(frames))
    space.drop_others(start, names)                          # the recording was longer
    return TrackedFolder(done, state, key, fresh)
