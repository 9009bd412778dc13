"""Long work in steps that are kept, counted for a progress callback, and timed in the log."""
from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable, Iterator
from copy import copy
from typing import Any, TypeVar

from scanprep.batch.room import Step, inside, once

Progress = Callable[[int, int], None]
T = TypeVar("T")
LOG = logging.getLogger(__name__)


class Work:
    """Steps of some work, whose progress goes from 0 to a total."""

    def __init__(self, progress: Progress | None, total: int, step: Step = once) -> None:
        self._progress, self._total, self._step, self._done = progress, total, step, [0]

    def tick(self, more: int) -> None:
        """So much more is done."""
        self._done[0] += more
        if self._progress and more:
            self._progress(self._done[0], self._total)

    def step(self, name: str, inputs: Any, count: int, make: Callable[[Work], T]) -> T:
        """What `make` returns, or returned before for the same inputs; it counts so much either way.

        `make` gets the work of its own steps, which are forgotten once it is done.
        """
        inner, goal = copy(self), self._done[0] + count
        inner._step = inside(self._step, name)
        value = self._step(name, inputs, lambda: make(inner))
        self.tick(goal - self._done[0])
        return value


@contextlib.contextmanager
def timed(step: str) -> Iterator[None]:
    """Tell the log how many seconds a step took."""
    begun = time.perf_counter()
    yield
    LOG.info("%s: %.2f s", step, time.perf_counter() - begun)
