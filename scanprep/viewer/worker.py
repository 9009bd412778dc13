"""A thread that does one job after another, and does not keep the program from ending."""
from __future__ import annotations

import threading
from collections.abc import Callable

from .waiting import Waiting

Job = Callable[[], None]


class Stopped(BaseException):
    """The server has ended: a job that meets this lets it pass. No `except Exception` takes it for an error."""


class Worker:
    """Jobs, one at a time in one thread.

    Parameters
    ----------
    name : str
        Name of the thread.
    failed : (exception) -> None
        Told, in the thread, of whatever a job raised but `Stopped`.
    """

    def __init__(self, name: str, failed: Callable[[BaseException], None]) -> None:
        self._waiting: Waiting[Job] = Waiting()
        self._news = threading.Condition()
        self._failed = failed
        self._ending = False
        self._thread = threading.Thread(target=self._work, name=name, daemon=True)
        self._thread.start()

    def put(self, job: Job, key: str = "") -> None:
        """Do this job after those that wait, or in place of one with the same key; see `Waiting`."""
        with self._news:
            self._waiting.put(job, key)
            self._news.notify()

    def stop(self, seconds: float) -> bool:
        """Finish what waits, but for no longer than this; False where a job still runs, which ends with the program."""
        with self._news:
            self._ending = True
            self._news.notify()
        self._thread.join(seconds)
        return not self._thread.is_alive()

    def _work(self) -> None:
        while (job := self._next()) is not None:
            try:
                job()
            except Stopped:
                pass
            except (Exception, SystemExit) as problem:
                self._failed(problem)

    def _next(self) -> Job | None:
        with self._news:
            self._news.wait_for(lambda: len(self._waiting) or self._ending)
            return self._waiting.take()[1] if len(self._waiting) else None
