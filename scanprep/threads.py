"""How many threads work at once: one place for linear algebra, searches and worker processes.

===================================  =======  ========================================================================
what                                 threads  why
===================================  =======  ========================================================================
linear algebra (OpenBLAS, MKL)       1        two threads spin while they wait: an SVD of 500 x 200 takes 21 times the
                                              processor time, an eigenvalue problem of 250 rows 27 times, a product of
                                              250 x 250 eight times. Only products of whole batches of meshes gain (a
                                              fifth of the time). Sums also differ in the last digit.
searches in k-d trees                cores    no sums, no spinning; for few points one thread is fastest
MeshLab's Poisson reconstruction     1        by default 16 threads that spin: 8 s of processor time instead of 0.5
libigl (closest points)              cores    its own pool, which does not spin; IGL_NUM_THREADS limits it
a worker process, all of these       1        there are as many workers as cores
===================================  =======  ========================================================================

OMP_NUM_THREADS, OPENBLAS_NUM_THREADS or MKL_NUM_THREADS of the user set the number everywhere, also in workers.
`tests/benchmarks/threads.py` measures whole commands. Importing this package changes nothing.
"""
from __future__ import annotations

import contextlib
import multiprocessing
import os
import threading
from collections.abc import Iterator
from typing import Any

# environment variables that users set; libigl has one of its own
VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
LIBIGL = "IGL_NUM_THREADS"

_guard = threading.Lock()
_before: list[tuple[Any, int]] = []  # libraries, and the number of threads before the limit
_users = 0                           # blocks that hold the limit now
_in_worker = False                   # this is a worker process


def threads_asked() -> int | None:
    """Return the number of threads from the user's environment, or None; 1 where it cannot be read."""
    for name in VARIABLES:
        text = os.environ.get(name, "").split(",")[0].strip()
        if text:
            return max(1, int(text)) if text.isdecimal() else 1
    return None


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Limit linear algebra in this process to one thread, or to the user's number, while the block runs.

    Also a decorator. Among nested or parallel blocks the first sets the limit, and the last lifts it.
    """
    global _users
    with _guard:
        _users += 1
        if not _before and threads_asked() is None:
            import scipy.linalg  # noqa: F401  (has its own OpenBLAS, which must be loaded to be limited)
            from threadpoolctl import ThreadpoolController

            _before.extend((library, library.num_threads) for library in ThreadpoolController().lib_controllers)
            for library, _ in _before:
                _set(library, 1)
    try:
        yield
    finally:
        with _guard:
            _users -= 1
            while not _users and _before:
                _set(*_before.pop())


def search_threads(points: int) -> int:
    """Return the number of threads for a search of points in a k-d tree; results do not depend on it."""
    if points <= 4000:               # threads cost more than they save
        return 1
    return threads_asked() or _cores()


def helpers(at_most: int) -> int:
    """Return how many helper processes a computation may start: as many as cores; none inside a worker process."""
    alone = _in_worker or multiprocessing.current_process().daemon
    return 0 if alone or _cores() == 1 else min(_cores(), at_most)


def begin_worker() -> None:
    """Limit a worker process to one thread, or to the user's number; call it first in every worker."""
    global _in_worker
    from threadpoolctl import threadpool_limits

    _in_worker, number = True, threads_asked() or 1
    for name in (*VARIABLES, LIBIGL):
        os.environ.setdefault(name, str(number))
    threadpool_limits(number)


def _set(library: Any, number: int) -> None:
    """Set the threads of a library; threadpoolctl (3.8) itself obeys only the first thread that ever set a limit."""
    getattr(library, "_real_set_num_threads", library.set_num_threads)(number)


def _cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
