"""How many threads work at once: one place for the linear algebra, the searches and the worker processes.

===================================  =======  ========================================================================
what                                 threads  why
===================================  =======  ========================================================================
linear algebra (OpenBLAS, MKL)       1        with two, an SVD of 500 x 200 takes 21 times the processor, an eigenvalue
                                              problem of 250 rows 27 times, a product of 250 x 250 eight times: they
                                              wait by spinning. Only products of the size of a batch of whole meshes
                                              gain (a fifth of the time). And sums come out otherwise in the last digit.
searches in k-d trees                cores    nothing is summed, nobody spins; on few points one is fastest
MeshLab's Poisson reconstruction     1        of itself 16 threads that spin: 8 s of the processor in the place of 0.5
libigl (closest points)              cores    its own pool, which does not spin; IGL_NUM_THREADS limits it
a worker process, all of these       1        the workers themselves are as many as there are cores
===================================  =======  ========================================================================

Who sets OMP_NUM_THREADS, OPENBLAS_NUM_THREADS or MKL_NUM_THREADS gets that many of all, in worker processes too.
`tests/benchmarks/threads.py` measures whole commands. Importing this package changes nothing.
"""
from __future__ import annotations

import contextlib
import multiprocessing
import os
import threading
from collections.abc import Iterator
from typing import Any

VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
LIBIGL = "IGL_NUM_THREADS"

_guard = threading.Lock()
_before: list[tuple[Any, int]] = []  # libraries, and the threads they had
_users = 0
_in_worker = False


def threads_asked() -> int | None:
    """The number of threads that the user's environment asks for, or None; 1 where it cannot be read."""
    for name in VARIABLES:
        text = os.environ.get(name, "").split(",")[0].strip()
        if text:
            return max(1, int(text)) if text.isdecimal() else 1
    return None


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """One thread for linear algebra in this process, or as many as the user asked for.

    Also a decorator. The first of several users, nested or in threads of their own, sets the limit; the last lifts it.
    """
    global _users
    with _guard:
        _users += 1
        if not _before and threads_asked() is None:
            import scipy.linalg  # noqa: F401  (its own OpenBLAS; what is loaded later would not be limited)
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
    """Threads for a search of so many points in a k-d tree; the answer does not depend on them."""
    if points <= 4000:               # threads cost more than they save
        return 1
    return threads_asked() or _cores()


def helpers(at_most: int) -> int:
    """Processes that a computation may take beside this one's: as many as there are cores; none in a worker process."""
    alone = _in_worker or multiprocessing.current_process().daemon
    return 0 if alone or _cores() == 1 else min(_cores(), at_most)


def begin_worker() -> None:
    """To be called first in every worker process: one thread for all that it does, or the user's own number."""
    global _in_worker
    from threadpoolctl import threadpool_limits

    _in_worker, number = True, threads_asked() or 1
    for name in (*VARIABLES, LIBIGL):
        os.environ.setdefault(name, str(number))
    threadpool_limits(number)


def _set(library: Any, number: int) -> None:
    """Of itself threadpoolctl (3.8) listens only to the first thread that ever set a limit, and says nothing."""
    getattr(library, "_real_set_num_threads", library.set_num_threads)(number)


def _cores() -> int:
    """Those that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
