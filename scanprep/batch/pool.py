"""Tasks side by side: in this process, in processes of this machine, or on a Dask cluster."""
from __future__ import annotations

import contextlib
import os
import threading
import time
import warnings
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

from ..ranges import FLAG, Processes, Settings
from ..threads import begin_worker
from .room import Failure, Job, Progress, attempt


@dataclass(frozen=True)
class Workers(Settings):
    """Who does the work.

    Attributes
    ----------
    workers : int
        Processes on this machine; 0 for one a core.
    scheduler : str, optional
        Address of a Dask scheduler, whose workers do the work instead, such as tcp://host:8786.
    """

    workers: Annotated[Processes, FLAG] = 0
    scheduler: Annotated[str | None, FLAG] = None


def run_jobs(work: Any, jobs: Sequence[Job], workers: Workers, inside: Progress | None = None
             ) -> Iterator[tuple[Job, Any]]:
    """Each job with what the work returned, or a Failure, as they finish."""
    if not jobs:
        return iter(())
    if workers.scheduler is not None:
        from .cluster import run_on_cluster

        return run_on_cluster(workers.scheduler, work, jobs)
    count = min(workers.workers or os.cpu_count() or 1, len(jobs))
    if count == 1:
        return ((job, attempt(work, job, inside)) for job in jobs)
    return _run_in_processes(work, jobs, count)


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
        time.sleep(0.2)
    os.kill(os.getpid(), 9)


def _do(job: Job) -> Any:
    return attempt(_work, job)
