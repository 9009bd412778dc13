"""Scans side by side in processes of this machine."""
from __future__ import annotations

import contextlib
import os
import warnings
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass

from ..geometry.mesh import Mesh
from .scan import RegisteredScan, ScanSettings, attempt
from .tasks import ScanTask

Outcome = RegisteredScan | str


@dataclass(frozen=True, eq=False)
class Work:
    """What all scans of a run have in common, so that it travels to each worker once.

    Attributes
    ----------
    template : Mesh
    template_landmarks : name -> vertex
    settings : ScanSettings
    """

    template: Mesh
    template_landmarks: dict[str, int]
    settings: ScanSettings

    def do(self, task: ScanTask) -> Outcome:
        """One scan: what it became, or the reason of its failure."""
        return attempt(task, self.template, self.template_landmarks, self.settings)


def run_in_processes(work: Work, tasks: Sequence[ScanTask], workers: int = 0) -> Iterator[tuple[ScanTask, Outcome]]:
    """Each task with its outcome, as they finish.

    Parameters
    ----------
    workers : int
        Processes; 0 for one a core. With one, or a single task, all is done in this process.

    A process that dies, say for want of memory, stops no other scan: those that were under way are tried again
    one at a time, so that the guilty one is known.
    """
    tasks = [task.absolute() for task in tasks]
    workers = min(workers or os.cpu_count() or 1, max(len(tasks), 1))
    if workers == 1:
        for task in tasks:
            yield task, work.do(task)
        return
    left = set(range(len(tasks)))
    for group in (range(len(tasks)), *([i] for i in range(len(tasks)))):
        wanted = [i for i in group if i in left]
        try:
            with contextlib.closing(_parallel(work, tasks, wanted, workers)) as outcomes:
                for i, outcome in outcomes:
                    left.discard(i)
                    yield tasks[i], outcome
        except _Died as death:
            if len(group) == 1:
                left.discard(wanted[0])
                yield tasks[wanted[0]], f"{tasks[wanted[0]].scan}: the process at work on it died: {death}"


class _Died(Exception):
    """A process ended without an answer."""


def _parallel(work: Work, tasks: Sequence[ScanTask], wanted: Sequence[int], workers: int
              ) -> Generator[tuple[int, Outcome], None, None]:
    from joblib import Parallel, delayed, parallel_config
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    if not wanted:
        return
    with parallel_config("loky", n_jobs=workers, inner_max_num_threads=1), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "A worker stopped while some jobs")      # one that has grown is begun anew
        jobs = (delayed(_numbered)(i, work, tasks[i]) for i in wanted)
        try:
            yield from Parallel(return_as="generator_unordered", batch_size=1)(jobs)
        except TerminatedWorkerError as error:
            raise _Died(" ".join(str(error).split())) from None


def _numbered(i: int, work: Work, task: ScanTask) -> tuple[int, Outcome]:
    return i, work.do(task)
