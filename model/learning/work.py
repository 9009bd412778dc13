"""Long work in steps that are kept, and counted for a progress callback."""
from __future__ import annotations

from collections.abc import Callable
from copy import copy
from typing import Any, TypeVar

from scanprep.batch.room import Step, inside, once

Progress = Callable[[int, int], None]
T = TypeVar("T")


class Work:
    """Steps of some work, each a share of the whole, of which progress is told in thousandths."""

    def __init__(self, progress: Progress | None, step: Step = once) -> None:
        self._progress, self._step, self._part, self._done = progress, step, 1.0, [0.0]

    def tick(self, share: float) -> None:
        """So much of this work is done."""
        self._done[0] += share * self._part
        if self._progress:
            self._progress(round(1000 * self._done[0]), 1000)

    def step(self, name: str, inputs: Any, share: float, make: Callable[[Work], T]) -> T:
        """What `make` returns, or returned before for the same inputs; it is a share of this work either way.

        `make` gets the work of its own steps, which are forgotten once it is done.
        """
        inner, end = copy(self), self._done[0] + share * self._part
        inner._step, inner._part = inside(self._step, name), share * self._part
        value = self._step(name, inputs, lambda: make(inner))
        self.tick((end - self._done[0]) / self._part)
        return value
