"""What reading a file may cost, counted in one place: bytes, visits and seconds, all in proportion to its size.

A few hundred bytes may unpack to gigabytes, or show one part of a scene without end. `reading` opens the budget of a
file, and what reads a part of it calls `spend`. Beyond its budget a file fails with its name.
"""
from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path

# Bytes of arrays for every byte of a file: text makes up to 60, and packed text as many. Our own arrays of zeros pack
# a thousand times, so the first 128 MB are free.
FREE, PER_BYTE = 2**27, 100
# Nodes, primitives, and rows that are read one by one: each is a byte or more.
VISITS = 100_000
# Seconds of the processor, and as many for each MB: a file of small polygons takes 1 s for a MB, on a fast machine.
SECONDS, PER_MB = 6.0, 4.0


@dataclass
class Budget:
    """What is left for a file that is being read."""

    path: Path
    error: type[ValueError]
    files: dict[Path, int]           # bytes of the file and of those that it names
    memory: int = FREE               # bytes of arrays
    visits: int = VISITS
    end: float = SECONDS             # processor time of this thread

    def add(self, path: Path) -> None:
        """Widen the budget by that of a file, once."""
        if path not in self.files:
            self.files[path] = size = os.path.getsize(path)
            self.memory += PER_BYTE * size
            self.visits += size
            self.end += PER_MB * size / 2**20


_budget: ContextVar[Budget | None] = ContextVar("budget", default=None)


def memory_for(size: int) -> int:
    """Return how many bytes of arrays a file of `size` bytes may make."""
    return FREE + PER_BYTE * size


@contextlib.contextmanager
def reading(path: Path, error: type[ValueError]) -> Iterator[None]:
    """Open the budget of a file; one that another file names widens the budget of that one.

    Parameters
    ----------
    path : Path
        A file that is there.
    error : type of ValueError
        Raised by `spend` beyond the budget.

    Examples
    --------
    >>> _ = Path("tiny.txt").write_text("0 0 0")
    >>> with reading(Path("tiny.txt"), ValueError):
    ...     spend(memory=10**9)
    Traceback (most recent call last):
    ValueError: tiny.txt: its 5 bytes would make more than 134 MB of arrays: damaged, or made to fill the memory
    """
    outer = _budget.get()
    if outer is not None:
        outer.add(path)
        yield
        return
    budget = Budget(path, error, {}, end=time.thread_time() + SECONDS)
    budget.add(path)
    token = _budget.set(budget)
    try:
        yield
    finally:
        _budget.reset(token)


def spend(memory: int = 0, visits: int = 0) -> None:
    """Take bytes of arrays and visits off the budget of the file that is being read, and look at the clock.

    Parameters
    ----------
    memory : int
        Bytes of the arrays that are made next.
    visits : int
        Nodes or primitives that are looked at next.

    Raises
    ------
    ValueError
        Or the error of `reading`, beyond the budget.

    Examples
    --------
    >>> spend(memory=10**12)           # nothing is read: nothing is counted
    """
    budget = _budget.get()
    if budget is None:
        return
    budget.memory -= memory
    budget.visits -= visits
    size = sum(budget.files.values())
    if budget.memory < 0:
        raise budget.error(f"{budget.path}: its {size} bytes would make more than {memory_for(size) / 1e6:.0f} MB of "
                           "arrays: damaged, or made to fill the memory")
    if budget.visits < 0:
        raise budget.error(f"{budget.path}: its {size} bytes show their parts more than {VISITS + size} times: "
                           "damaged, or made to be read without end")
    if time.thread_time() > budget.end:
        raise budget.error(f"{budget.path}: its {size} bytes take more than {SECONDS + PER_MB * size / 2**20:.0f} s to "
                           "read: damaged, or made to be read without end")
