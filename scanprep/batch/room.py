"""The context in which one task runs: its files, its steps, its outcome; and steps that are not kept."""
from __future__ import annotations

import contextlib
import os
import re
import shutil
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar
from urllib.parse import quote

from ..geometry import storage
from ..threads import one_thread
from ..words import OUR_MODULES, explain_os_error
from .digests import Digests, paths_of
from .values import load_step_header, load_value, save_value

Progress = Callable[[int, int], None]
T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Job:
    """A `Task` on its way to a worker."""

    name: str
    given: Any
    folder: Path                    # temporary folder; the files are in `folder / place`
    place: str = ""
    steps: Path | None = None       # folder in which the results of steps are kept
    force: bool = False             # compute every step again


@dataclass(frozen=True)
class Failure:
    """Why a task failed: one line that names the file."""

    reason: str


class TaskContext:
    """What a task gets to work with.

    `folder` is for its files. `step` keeps intermediate results, which an interrupted task finds again.
    `report_progress(done, total)` reports progress. With `force` no step of an earlier run counts as done.
    """

    def __init__(self, folder: Path, steps: Path | None = None, report_progress: Progress | None = None,
                 force: bool = False
                 ) -> None:
        self.folder, self._steps, self.report_progress = folder, steps, report_progress or (lambda done, total: None)
        self._digests, self._force, self._made = Digests(), force, set[str]()

    def step(self, name: str, inputs: Any, make: Callable[[], T]) -> T:
        """Return what `make` returns, or what it returned before for the same inputs."""
        if self._steps is None:
            return make()
        path, key = self._step_file(name), self._digests.key(inputs)
        if (not self._force or name in self._made) and (load_step_header(path) or {}).get("digest") == key:
            with contextlib.suppress(storage.StorageError):
                return load_value(path)
        save_value(path, make(), {"digest": key})
        self._made.add(name)
        return load_value(path)          # read back: the memory order of arrays changes the last digits of sums

    def files(self, name: str, inputs: Any, make: Callable[[Path], T]) -> T:
        """Run a step that also writes files: `make` gets a folder, whose files come into `self.folder`."""
        if self._steps is None:
            return make(self.folder)
        kept = self._step_file(name).with_suffix(".files")

        def run_make() -> tuple[T, dict[str, str]]:
            """Run `make` in an empty folder; return its result and the digests of its files."""
            shutil.rmtree(kept, ignore_errors=True)
            kept.mkdir(parents=True)
            return make(kept), self._digests.of_files(kept)

        value, files = self.step(name, inputs, run_make)
        if self._digests.of_files(kept) != files:        # somebody changed the kept files: make them again
            self._step_file(name).unlink()
            value, files = self.step(name, inputs, run_make)
        # hard links cost neither time nor space; some file systems need a copy
        for file in files:
            (self.folder / file).parent.mkdir(parents=True, exist_ok=True)
            try:
                os.link(kept / file, self.folder / file)
            except OSError:
                shutil.copyfile(kept / file, self.folder / file)
        return value

    def _step_file(self, name: str) -> Path:
        """Return the file of a step; its name may hold any character."""
        assert self._steps is not None, "steps are kept"
        return self._steps / f"{plain_name(name)}.npz"


def plain_name(name: str) -> str:
    """Return a name as a file name; `unquote` gives it back."""
    quoted = quote(name, safe=" ")
    # what is not ASCII is three times as long when quoted: where that is too long for a disk, it stays
    return quoted if len(quoted) <= 200 else re.sub(r'[%/\\:*?"<>|]', lambda sign: quote(sign[0], safe=""), name)


def attempt(work: Any, job: Job, report_progress: Progress | None = None) -> Any:
    """Run a job; return its result, or a Failure, so that an error stops no other task."""
    folder, files = job.folder / job.place, [str(path) for path in paths_of(job.given)] or [job.name]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with _notes_of(files), one_thread():              # results are the same to the last digit wherever it runs
            return work(job.given, TaskContext(folder, job.steps, report_progress, job.force))
    except Exception as error:
        text = explain_os_error(error, job.name) if isinstance(error, OSError) else " ".join(str(error).split())
        # an unexpected kind of error is named, for whoever reports it
        if not isinstance(error, ValueError | OSError | ModuleNotFoundError):
            text = f"{type(error).__name__}: {text}"
        return Failure(_name_file(text, files))


def _name_file(text: str, files: Sequence[str]) -> str:
    """Return a text that names a file of a task; one that names none gets the first in front."""
    return text if any(file in text for file in files) else f"{files[0]}: {text.removeprefix('scan: ')}"


@contextlib.contextmanager
def _notes_of(files: Sequence[str]) -> Iterator[None]:
    """Make our warnings name a file of the task while the block runs, as they come from several tasks."""
    show = warnings.showwarning

    def show_with_file(message: Warning | str, *rest: Any, **named: Any) -> None:
        show(UserWarning(_name_file(str(message), files)), *rest, **named)

    warnings.showwarning = show_with_file
    try:
        yield
    finally:
        warnings.showwarning = show


def attempt_elsewhere(work: Any, job: Job) -> tuple[Any, list[str]]:
    """Run a job for another process; return its outcome and our warnings, which that process shows."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("ignore")
        warnings.filterwarnings("always", category=UserWarning, module=OUR_MODULES)
        outcome = attempt(work, job)
    return outcome, [str(warning.message) for warning in caught]


class Step(Protocol):
    """A result computed once for the same inputs: `TaskContext.step`, or `KeptSteps`."""

    def __call__(self, name: str, inputs: Any, make: Callable[[], T]) -> T: ...


def run_uncached(name: str, inputs: Any, make: Callable[[], T]) -> T:
    """Run a step without keeping its result."""
    return make()


def substeps(step: Step, outer: str) -> Step:
    """Return a step function whose names begin with that of the larger step."""
    def inner(name: str, inputs: Any, make: Callable[[], T]) -> T:
        return step(f"{outer}/{name}", inputs, make)

    return inner
