"""Where one task is worked on: its files, its steps, and what became of it; and steps that need not be kept."""
from __future__ import annotations

import contextlib
import os
import shutil
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar
from urllib.parse import quote

from ..geometry import storage
from ..threads import one_thread
from ..words import OUR_MODULES
from .digests import Digests, paths_of
from .values import load_step_header, load_value, save_value

Progress = Callable[[int, int], None]
T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Job:
    """A `Task` on its way to a worker."""

    name: str
    given: Any
    folder: Path                    # where it is made; its files are in `folder / place`
    place: str = ""
    steps: Path | None = None       # where its steps are kept
    force: bool = False             # take no step as done


@dataclass(frozen=True)
class Failure:
    """Why a task failed, in one line that names the file."""

    reason: str


class TaskContext:
    """Where one task is worked on.

    `folder` takes its files, `step` keeps results that are found again when the task was interrupted,
    `tell(done, total)` reports progress. With `force` no step of an earlier run counts as done.
    """

    def __init__(self, folder: Path, steps: Path | None = None, tell: Progress | None = None, force: bool = False
                 ) -> None:
        self.folder, self._steps, self.tell = folder, steps, tell or (lambda done, total: None)
        self._digests, self._force, self._made = Digests(), force, set[str]()

    def step(self, name: str, inputs: Any, make: Callable[[], T]) -> T:
        """What `make` returns, or returned when it was last called with the same inputs."""
        if self._steps is None:
            return make()
        path, key = self._step_file(name), self._digests.key(inputs)
        if (not self._force or name in self._made) and (load_step_header(path) or {}).get("digest") == key:
            with contextlib.suppress(storage.StorageError):
                return load_value(path)
        save_value(path, make(), {"digest": key})
        self._made.add(name)
        return load_value(path)          # arrays as they are stored: their order in memory tells in the last digits

    def files(self, name: str, inputs: Any, make: Callable[[Path], T]) -> T:
        """As `step`; `make` gets a folder, and what it writes there comes into `self.folder`."""
        if self._steps is None:
            return make(self.folder)
        kept = self._step_file(name).with_suffix(".files")

        def made() -> tuple[T, dict[str, str]]:
            shutil.rmtree(kept, ignore_errors=True)
            kept.mkdir(parents=True)
            return make(kept), self._digests.of_files(kept)

        value, files = self.step(name, inputs, made)
        if self._digests.of_files(kept) != files:        # other ones than those of the step
            self._step_file(name).unlink()
            value, files = self.step(name, inputs, made)
        for file in files:
            (self.folder / file).parent.mkdir(parents=True, exist_ok=True)
            try:
                os.link(kept / file, self.folder / file)
            except OSError:                              # where that cannot be
                shutil.copyfile(kept / file, self.folder / file)
        return value

    def _step_file(self, name: str) -> Path:
        assert self._steps is not None, "steps are kept"
        return self._steps / f"{quote(name, safe=' ')}.npz"


def attempt(work: Any, job: Job, tell: Progress | None = None) -> Any:
    """What the work returns, or a Failure; an error in our code stops no other task."""
    folder = job.folder / job.place
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with one_thread():              # so that bytes do not depend on where it is done
            return work(job.given, TaskContext(folder, job.steps, tell, job.force))
    except Exception as error:
        text = " ".join(str(error).split())
        if not isinstance(error, ValueError | OSError | ModuleNotFoundError):
            text = f"{type(error).__name__}: {text}"
        files = [str(path) for path in paths_of(job.given)] or [job.name]
        return Failure(text if any(file in text for file in files) else f"{files[0]}: {text}")


def attempt_elsewhere(work: Any, job: Job) -> tuple[Any, list[str]]:
    """The same on behalf of another process: with our warnings, for that one to tell."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("ignore")
        warnings.filterwarnings("always", category=UserWarning, module=OUR_MODULES)
        outcome = attempt(work, job)
    return outcome, [str(warning.message) for warning in caught]


class Step(Protocol):
    """A result that is made once for the same inputs: `TaskContext.step`, or `KeptSteps`."""

    def __call__(self, name: str, inputs: Any, make: Callable[[], T]) -> T: ...


def run_uncached(name: str, inputs: Any, make: Callable[[], T]) -> T:
    """A step that is not kept."""
    return make()


def substeps(step: Step, outer: str) -> Step:
    """Steps of which a larger one consists."""
    def inner(name: str, inputs: Any, make: Callable[[], T]) -> T:
        return step(f"{outer}/{name}", inputs, make)

    return inner
