"""Tasks side by side: in this process, in processes of this machine, or on a Dask cluster."""
from __future__ import annotations

import os
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Generic, TypeVar, cast

from ..ranges import FLAG, Processes, Settings
from ..threads import begin_worker, helpers
from .room import Failure, Job, Progress, attempt, attempt_elsewhere

T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class Workers(Settings):
    """Who does the work.

    Attributes
    ----------
    workers : int or str
        Processes on this machine, 0 for one a core; or the address of a Dask scheduler, whose workers do the work
        instead, such as tcp://host:8786.
    """

    workers: Annotated[Processes, FLAG] = 0


def run_jobs(work: Any, jobs: Sequence[Job], workers: Workers, inside: Progress | None = None
             ) -> Iterator[tuple[Job, Any]]:
    """Each job with what the work returned, or a Failure, as they finish."""
    if not jobs:
        return iter(())
    if isinstance(workers.workers, str):
        from .cluster import run_on_cluster

        return run_on_cluster(workers.workers, work, jobs)
    count = min(workers.workers or os.cpu_count() or 1, len(jobs))
    if count == 1:
        return ((job, attempt(work, job, inside)) for job in jobs)
    return _run_in_processes(work, jobs, count)


def _run_in_processes(work: Any, jobs: Sequence[Job], count: int) -> Iterator[tuple[Job, Any]]:
    """A process that dies, say for want of memory, stops no other job: those under way are tried again one at a
    time, so that the guilty one is known."""
    from loky import ProcessPoolExecutor, as_completed
    from loky.process_executor import BrokenProcessPool

    left = list(jobs)
    for at_once in (len(jobs), 1):
        while left:
            group = left[:at_once]
            pool = ProcessPoolExecutor(min(count, len(group)), initializer=_begin, initargs=(work, os.getpid()))
            try:
                job_of = {pool.submit(_do, job): job for job in group}
                for future in as_completed(job_of):
                    outcome, notes = future.result()
                    for note in notes:
                        warnings.warn(note, stacklevel=2)
                    left.remove(job_of[future])
                    yield job_of[future], outcome
            except BrokenProcessPool as error:
                if at_once > 1:
                    break
                left.remove(group[0])
                why = " ".join(str(error).split())
                yield group[0], Failure(f"{group[0].name}: the process at work on it died: {why}")
            finally:
                pool.shutdown(kill_workers=True)


class SideBySide(Generic[T, R]):
    """What a function makes of items that are asked for one after the other, worked out in processes ahead of that.

    The first is done in this process. The others are too where that takes less than it would to start processes and to
    fetch the results, where there is one core, and where a process dies, say for want of memory. The results are the
    same. A context manager: leaving it ends the processes.
    """

    WORTH = 10.0                    # seconds of work left for which processes are started
    AT_MOST = 4                     # processes: each holds what the function needs, and what it makes

    def __init__(self, function: Callable[[T], R], items: Sequence[T]) -> None:
        self._function, self._items = function, items
        self._pool: Any = None
        self._futures: dict[int, Any] = {}
        self._helpers = helpers(self.AT_MOST)

    def __enter__(self) -> SideBySide[T, R]:
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(kill_workers=True)
        self._pool, self._futures = None, {}

    def __call__(self, number: int) -> R:
        """The result of one item; a few that come after it are begun."""
        if self._pool is None:
            return self._here(number)
        from loky.process_executor import BrokenProcessPool

        try:
            for ahead in range(number, min(number + 2 * self._helpers, len(self._items))):
                if ahead not in self._futures:
                    self._futures[ahead] = self._pool.submit(_call, self._items[ahead])
            return cast(R, self._futures.pop(number).result())
        except BrokenProcessPool:
            self.__exit__()
            self._helpers = 0
            return self._here(number)

    def _here(self, number: int) -> R:
        begun = time.perf_counter()
        result = self._function(self._items[number])
        left = (time.perf_counter() - begun) * (len(self._items) - number - 1)
        if self._helpers and left > self.WORTH:
            from loky import ProcessPoolExecutor

            self._pool = ProcessPoolExecutor(self._helpers, initializer=_begin, initargs=(self._function, os.getpid()))
        return result


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
        time.sleep(0.2)
    os.kill(os.getpid(), 9)


def _do(job: Job) -> tuple[Any, list[str]]:
    return attempt_elsewhere(_work, job)


def _call(item: Any) -> Any:
    return _work(item)
