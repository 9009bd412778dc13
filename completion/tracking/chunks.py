"""Frames followed a few at a time, each few kept in the output as soon as they are done."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from scanprep.batch.workspace import Workspace
from scanprep.geometry.files import write_mesh

from .folder import FrameFolder
from .sequence import without_points
from .tracker import TrackedFrame, Tracker, TrackerState

Progress = Callable[[int, int], None]
AT_ONCE = 5                          # frames that are kept together
START = "frames/"                    # of the names of what is kept
SURFACES = "surfaces"


@dataclass(frozen=True, eq=False)
class Chunk:
    """What came of some frames."""

    ready: tuple[TrackedFrame, ...]  # tuple of TrackedFrame
    state: TrackerState     # TrackerState, after them
    problems: tuple[str, ...]  # tuple of str, what was wrong with their files, the folder left out


@dataclass(frozen=True, eq=False)
class Followed:
    """All frames of a folder."""

    frames: list[TrackedFrame]  # list of TrackedFrame
    state: TrackerState     # TrackerState, at the end
    key: str                # changes with everything they depend on
    fresh: int              # frames that were followed now; the others had been before


def follow_folder(tracker: Tracker, frames: FrameFolder, space: Workspace, key: str, surfaces: bool = False,
                  progress: Progress | None = None) -> Followed:
    """Follow a body through a folder of frames; those that were followed before are not followed again.

    Frames are followed one from the other, and the shape is found from several, so what is kept of a chunk depends
    on every file up to its last frame, and nothing after it. The state of the tracker is kept with it: when a chunk
    is missing or damaged, or a frame in it has changed, the tracker goes on from the end of the one before.
    """
    done: list[TrackedFrame] = []
    state, fresh, names = tracker.state, 0, []
    for first in (*range(0, len(frames), AT_ONCE), len(frames)):
        mine = range(first, min(first + AT_ONCE, len(frames)))
        files = [[(path.relative_to(frames.folder).as_posix(), path) for path in frames.paths(i)] for i in mine]
        key = space.digests.of(key, files)
        names.append(f"{START}{first:08d}" if mine else f"{START}end")

        def follow(folder: Path, mine: range = mine, before: TrackerState = state) -> Chunk:
            nonlocal fresh
            fresh += len(mine)
            if tracker.state.number != before.number:
                tracker.resume(before)
            return _followed(tracker, frames, mine, folder / SURFACES if surfaces else None)

        chunk = space.step(names[-1], key, follow)
        state = chunk.state
        done += chunk.ready
        frames.problems += [f"{frames.folder}{text}" for text in chunk.problems]
        if progress is not None:
            progress(first + len(mine), len(frames))
    space.drop_others(START, names)                          # the recording was longer
    return Followed(done, state, key, fresh)


def _followed(tracker: Tracker, frames: FrameFolder, mine: range, surfaces: Path | None) -> Chunk:
    """Some frames, or none for those that were waiting at the end."""
    told = len(frames.problems)
    ready = [frame for i in mine for frame in tracker.push(frames[i])] if mine else tracker.finish()
    if surfaces is not None:
        for frame in ready:
            write_mesh(surfaces / f"{frame.number:06d}.ply", tracker.surface(frame), "single")
    problems = tuple(text.removeprefix(str(frames.folder)) for text in frames.problems[told:])
    del frames.problems[told:]
    return Chunk(tuple(without_points(frame) for frame in ready), tracker.state, problems)
