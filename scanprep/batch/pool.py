"""Tasks in parallel: in this process, in processes of this machine, or on a Dask cluster."""
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
    """Where the work is done.

    Attributes
    ----------
    workers : int or str
        Processes on this machine, 0 for one a core; or the address of a Dask scheduler, whose workers do the work
        instead, such as tcp://host:8786.
    """

    workers: Annotated[Processes, FLAG] = 0


def run_jobs(work: Any, jobs: Sequence[Job], workers: Workers, inside: Progress | None = None
             ) -> Iterator[tuple[Job, Any]]:
    """Run jobs and yield each with its result or Failure, in the order in which they finish."""
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
    """Run jobs in several processes of this machine.

    When a process dies, for example for lack of memory, its job and those beside it are tried again one at a time.
    So the job that killed it is known, and no other job is lost.
    """
    from loky import ProcessPoolExecutor, as_completed
    from loky.process_executor import BrokenProcessPool

    remaining = list(jobs)
    # first all jobs at once; after a crash those that remain, one by one
    for at_once in (len(jobs), 1):
        while remaining:
            group = remaining[:at_once]
            pool = ProcessPoolExecutor(min(count, len(group)), initializer=_begin, initargs=(work, os.getpid()))
            try:
                job_of = {pool.submit(_do, job): job for job in group}
                for future in as_completed(job_of):
                    outcome, notes = future.result()
                    for note in notes:
                        warnings.warn(note, stacklevel=2)
                    remaining.remove(job_of[future])
                    yield job_of[future], outcome
            except BrokenProcessPool as error:
                # several were at work: which one is guilty shows in the second round
                if at_once > 1:
                    break
                remaining.remove(group[0])
                why = " ".join(str(error).split())
                yield group[0], Failure(f"{group[0].name}: the process at work on it died: {why}")
            finally:
                pool.shutdown(kill_workers=True)


class SideBySide(Generic[T, R]):
    """Results of a function for items asked for in order, computed ahead in other processes.

    The first item is computed in this process. So are the others when starting processes would take longer, on a
    machine with one core, and after a process has died. The results are the same. Use it as a context manager:
    leaving the block ends the processes.
    """

    WORTH = 10.0                    # seconds of remaining work that repay the start of processes
    AT_MOST = 4                     # processes: each needs memory for the function's data and results

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
        """Return the result of one item, and start on the items that follow."""
        if self._pool is None:
            return self._here(number)
        from loky.process_executor import BrokenProcessPool

        try:
            # two items per process are under way: enough to keep all busy, little to hold in memory
            for ahead in range(number, min(number + 2 * self._helpers, len(self._items))):
                if ahead not in self._futures:
                    self._futures[ahead] = self._pool.submit(_call, self._items[ahead])
            return cast(R, self._futures.pop(number).result())
        except BrokenProcessPool:
            # a process died: go on without any
            self.__exit__()
            self._helpers = 0
            return self._here(number)

    def _here(self, number: int) -> R:
        """Compute an item in this process, and start processes if enough work remains."""
        begun = time.perf_counter()
        result = self._function(self._items[number])
        left = (time.perf_counter() - begun) * (len(self._items) - number - 1)
        if self._helpers and left > self.WORTH:
            from loky import ProcessPoolExecutor

            self._pool = ProcessPoolExecutor(self._helpers, initializer=_begin, initargs=(self._function, os.getpid()))
        return result


_work: Any = None               # in a worker process: what all its jobs have in common


def _begin(work: Any, parent: int) -> None:
    """Prepare a worker process: keep the common work, silence warnings, and end with the parent process."""
    global _work
    _work = work
    begin_worker()
    warnings.simplefilter("ignore")
    threading.Thread(target=_watch, args=(parent,), daemon=True).start()


def _watch(parent: int) -> None:
    """End this process when its parent has ended."""
    # an orphan gets another parent; checked five times a second, which costs nothing
    while os.getppid() == parent:
        time.sleep(0.2)
    os.kill(os.getpid(), 9)


def _do(job: Job) -> tuple[Any, list[str]]:
    """Run a job in a worker process."""
    return attempt_elsewhere(_work, job)


def _call(item: Any) -> Any:
    """Apply the function of `SideBySide` in a worker process."""
    return _work(item)
