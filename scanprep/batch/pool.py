"""Tasks side by side: in this process, in processes of this machine, or on a Dask cluster."""
from __future__ import annotations

import contextlib
import os
import shutil
import threading
import time
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import quote

from ..geometry import storage
from ..ranges import Processes, Settings
from ..threads import begin_worker, one_thread
from .digests import Digests, paths_of
from .values import load_header, load_value, save_value

Progress = Callable[[int, int], None]
T = TypeVar("T")
WATCH = 0.2                    # seconds between two looks whether the process that wants the work is still there


@dataclass(frozen=True)
class Workers(Settings):
    """Who does the work.

    Parameters
    ----------
    workers : int
        Processes on this machine; 0 for one a core.
    scheduler : str, optional
        Address of a Dask scheduler, whose workers do the work instead, such as tcp://host:8786.
    ship : bool
        Send the files of each task to those workers, which otherwise read them under the same path.
    """

    workers: Processes = 0
    scheduler: str | None = None
    ship: bool = False


@dataclass(frozen=True, eq=False)
class Job:
    """A task on its way to a worker.

    Attributes
    ----------
    name, given, place
        As in `Task`.
    folder : Path
        Where it is made; its files are in `folder / place`.
    steps : Path, optional
        Where its steps are kept.
    force : bool
        Take no step as done.
    """

    name: str
    given: Any
    folder: Path
    place: str = ""
    steps: Path | None = None
    force: bool = False


@dataclass(frozen=True)
class Failure:
    """Why a task failed, in one line that names the file."""

    reason: str


class Room:
    """Where a task is worked on.

    Parameters
    ----------
    folder : Path
        For its files.
    steps : Path, optional
        For results of its steps, which are found again when the task was interrupted.
    tell : callable
        Called with (done, total).
    force : bool
        Take no step as done that an earlier run made.
    """

    def __init__(self, folder: Path, steps: Path | None = None, tell: Progress | None = None, force: bool = False
                 ) -> None:
        self.folder, self._steps, self.tell = folder, steps, tell or (lambda done, total: None)
        self._digests, self._force, self._made = Digests(), force, set[str]()

    def step(self, name: str, inputs: Any, make: Callable[[], T]) -> T:
        """What `make` returns, or returned when it was last called with the same inputs."""
        if self._steps is None:
            return make()
        path, key = self._step_file(name), self._digests.of(inputs)
        if (not self._force or name in self._made) and (load_header(path) or {}).get("digest") == key:
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
            return make(kept), self._held(kept)

        value, files = self.step(name, inputs, made)
        if self._held(kept) != files:                    # other ones than those of the step
            self._step_file(name).unlink()
            value, files = self.step(name, inputs, made)
        for file in files:
            (self.folder / file).parent.mkdir(parents=True, exist_ok=True)
            _link(kept / file, self.folder / file)
        return value

    def _step_file(self, name: str) -> Path:
        assert self._steps is not None, "steps are kept"
        return self._steps / f"{quote(name, safe=' ')}.npz"

    def _held(self, folder: Path) -> dict[str, str]:
        return {path.relative_to(folder).as_posix(): self._digests.of_file(path)
                for path in sorted(folder.rglob("*")) if path.is_file()}


def _link(path: Path, place: Path) -> None:
    """The same file under another name, or a copy where that cannot be."""
    try:
        os.link(path, place)
    except OSError:
        shutil.copyfile(path, place)


def run_jobs(work: Any, jobs: Sequence[Job], workers: Workers, inside: Progress | None = None
             ) -> Iterator[tuple[Job, Any]]:
    """Each job with what the work returned, or a Failure, as they finish."""
    if not jobs:
        return iter(())
    if workers.scheduler is not None:
        from .cluster import run_on_cluster

        return run_on_cluster(workers.scheduler, work, jobs, workers.ship)
    count = min(workers.workers or os.cpu_count() or 1, len(jobs))
    if count == 1:
        return ((job, attempt(work, job, inside)) for job in jobs)
    return _run_in_processes(work, jobs, count)


def attempt(work: Any, job: Job, tell: Progress | None = None) -> Any:
    """What the work returns, or a Failure; an error in our code stops no other task."""
    folder = job.folder / job.place
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with one_thread():              # so that bytes do not depend on where it is done
            return work(job.given, Room(folder, job.steps, tell, job.force))
    except Exception as error:
        text = " ".join(str(error).split())
        if not isinstance(error, ValueError | OSError | ModuleNotFoundError):
            text = f"{type(error).__name__}: {text}"
        files = [str(path) for path in paths_of(job.given)] or [job.name]
        return Failure(text if any(file in text for file in files) else f"{files[0]}: {text}")


def _run_in_processes(work: Any, jobs: Sequence[Job], count: int) -> Iterator[tuple[Job, Any]]:
    """A process that dies, say for want of memory, stops no other job: those under way are tried again one at a
    time, so that the guilty one is known."""
    left = list(jobs)
    for at_once in (len(jobs), 1):
        while left:
            group = left[:at_once]
            try:
                with contextlib.closing(_in_parallel(work, group, count)) as outcomes:
                    for job, outcome in outcomes:
                        left.remove(job)
                        yield job, outcome
            except _Died as death:
                if at_once > 1:
                    break
                left.remove(group[0])
                yield group[0], Failure(f"{group[0].name}: the process at work on it died: {death}")


class _Died(Exception):
    """A process ended without an answer."""


def _in_parallel(work: Any, jobs: Sequence[Job], count: int) -> Generator[tuple[Job, Any], None, None]:
    from loky import ProcessPoolExecutor, as_completed
    from loky.process_executor import BrokenProcessPool

    pool = ProcessPoolExecutor(min(count, len(jobs)), initializer=_begin, initargs=(work, os.getpid()))
    try:
        job_of = {pool.submit(_do, job): job for job in jobs}
        for future in as_completed(job_of):
            yield job_of[future], future.result()
    except BrokenProcessPool as error:
        raise _Died(" ".join(str(error).split())) from None
    finally:
        pool.shutdown(kill_workers=True)


_work: Any = None


def _begin(work: Any, parent: int) -> None:
    """A worker keeps what all jobs have in common, says nothing, and goes when the process that wants it goes."""
    global _work
    _work = work
    begin_worker()
    warnings.simplefilter("ignore")
    threading.Thread(target=_watch, args=(parent,), daemon=True).start()


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(WATCH)
    os.kill(os.getpid(), 9)


def _do(job: Job) -> Any:
    return attempt(_work, job)
