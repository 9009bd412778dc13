"""A thread that runs one job after another, and does not keep the program from ending."""
from __future__ import annotations

import threading
from collections.abc import Callable

from .waiting import Waiting

Job = Callable[[], None]


class Stopped(BaseException):
    """The server has ended: jobs let this exception pass. It is no Exception, so that no handler swallows it."""


class Worker:
    """Runs jobs one at a time in one thread.

    Parameters
    ----------
    name : str
        Name of the thread.
    failed : callable
        Called, in the thread, with every exception of a job except `Stopped`.
    """

    def __init__(self, name: str, failed: Callable[[BaseException], None]) -> None:
        self._waiting: Waiting[Job] = Waiting()
        self._news = threading.Condition()
        self._failed = failed
        self._ending = False
        self._thread = threading.Thread(target=self._work, name=name, daemon=True)
        self._thread.start()

    def put(self, job: Job, key: str = "") -> None:
        """Queue a job, in place of a waiting one with the same key; see `Waiting`."""
        with self._news:
            self._waiting.put(job, key)
            self._news.notify()

    def stop(self, seconds: float) -> bool:
        """Finish the waiting jobs, for at most `seconds`; False where a job still runs, which ends with the program."""
        with self._news:
            self._ending = True
            self._news.notify()
        self._thread.join(seconds)
        return not self._thread.is_alive()

    def _work(self) -> None:
        """Run jobs until the end."""
        while (job := self._next()) is not None:
            try:
                job()
            except Stopped:
                pass
            except (Exception, SystemExit) as problem:
                self._failed(problem)

    def _next(self) -> Job | None:
        """Wait for the next job; None at the end."""
        with self._news:
            self._news.wait_for(lambda: len(self._waiting) or self._ending)
            return self._waiting.take()[1] if len(self._waiting) else None
