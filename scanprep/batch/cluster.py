"""Scans on the workers of a Dask cluster."""
from __future__ import annotations

import contextlib
import importlib.metadata
import pickle
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from .tasks import ScanTask
from .workers import Outcome, Work

ANSWER, WAIT = 10, 60          # seconds for the scheduler, and for the first worker of a cluster just started


def run_on_cluster(address: str, work: Work, tasks: Sequence[ScanTask], ship: bool = False
                   ) -> Iterator[tuple[ScanTask, Outcome]]:
    """Each task with its outcome, as they finish.

    The template travels to each worker once. Results come back to this process, which alone writes, so workers
    need no place to write to. One thread a worker is best (`dask worker --nthreads 1 --nworkers auto`).

    Parameters
    ----------
    address : str
        Of the scheduler, such as "tcp://host:8786".
    ship : bool
        Send the files of each scan along, for workers that do not see the folder of the scans.

    Raises
    ------
    ModuleNotFoundError
        Dask is not installed.
    ValueError
        No scheduler at that address, no workers, or workers that cannot run this version.
    """
    Client, as_completed, KilledWorker = _distributed()
    tasks = [task.absolute() for task in tasks]
    try:
        client = Client(address, timeout=ANSWER, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ValueError(f"scheduler: expected the address of a Dask scheduler, none answers at {address} "
                         f"({' '.join(str(error).split())})") from None
    with client:
        _await_workers(client, address)
        # a task that gives its argument back: unlike scattered data it is made anew where all copies are lost
        shared = client.submit(bytes, pickle.dumps((work, _versions())), pure=False)
        there = _entrance()
        waiting = iter(tasks)
        task_of: dict[Any, ScanTask] = {}
        running = as_completed([], loop=client.loop)

        def submit() -> None:
            """The next task; few at a time, so that shipped files do not pile up at the scheduler."""
            for task in waiting:
                future = client.submit(there, shared, pickle.dumps((task, _files(task) if ship else None)), pure=False)
                task_of[future] = task
                running.add(future)
                return

        for _ in range(2 * sum(client.nthreads().values())):
            submit()
        for future in running:
            task = task_of.pop(future)
            submit()
            yield task, _outcome(future, task, address, KilledWorker)


def _entrance() -> Callable[[bytes, bytes], Outcome]:
    """What is sent to the workers. Dask sends a function without a name of its own as code, and all else are
    bytes, so that a scheduler needs nothing of ours."""
    def there(shared: bytes, task: bytes) -> Outcome:
        from scanprep.batch.cluster import do_there

        return do_there(shared, task)

    return there


def _distributed() -> tuple[Any, Any, Any]:
    try:
        from distributed import Client, KilledWorker, as_completed
    except ModuleNotFoundError:
        raise ModuleNotFoundError("a scheduler needs Dask: pip install distributed") from None
    return Client, as_completed, KilledWorker


def _await_workers(client: Any, address: str) -> None:
    try:
        client.wait_for_workers(1, timeout=WAIT)
    except TimeoutError:
        raise ValueError(f"scheduler: {address} has no workers; start some with: dask worker {address}") from None


def _outcome(future: Any, task: ScanTask, address: str, KilledWorker: type) -> Outcome:
    try:
        error = future.exception()
    except CancelledError:
        raise ValueError(f"scheduler: {address} has gone; what was done is kept, start again to go on") from None
    if error is None:
        return future.result()
    if isinstance(error, KilledWorker):
        return f"{task.scan}: the workers at work on it died, one after another"
    raise ValueError(f"scheduler: a worker of {address} cannot run this ({type(error).__name__}: "
                     f"{' '.join(str(error).split())}); expected {_described(_versions())} on every worker")


def do_there(shared: bytes, packed: bytes) -> Outcome:
    """One scan, on the machine of a worker.

    Raises
    ------
    RuntimeError
        Other versions here than where the work comes from.
    """
    work, versions = pickle.loads(shared)
    if versions != _versions():
        raise RuntimeError(f"the worker has {_described(_versions())}")
    task, files = pickle.loads(packed)
    return work.do(task) if files is None else _unpacked(work, task, files)


def _unpacked(work: Work, task: ScanTask, files: dict[str, bytes]) -> Outcome:
    """One scan whose files came along."""
    with tempfile.TemporaryDirectory() as folder:
        for name, data in files.items():
            Path(folder, name).write_bytes(data)
        here = replace(task, scan=Path(folder, task.scan.name),
                       landmarks=task.landmarks and Path(folder, task.landmarks.name))
        outcome = work.do(here)
    if isinstance(outcome, str):
        for mine, theirs in ((here.scan, task.scan), (here.landmarks, task.landmarks)):
            outcome = outcome.replace(str(mine), str(theirs))
    return outcome


def _files(task: ScanTask) -> dict[str, bytes]:
    """Name -> contents of the files of a task; one that cannot be read is left for the worker to miss."""
    found = {}
    for path in (task.scan, task.landmarks):
        if path is not None:
            with contextlib.suppress(OSError):
                found[path.name] = path.read_bytes()
    return found


def _versions() -> dict[str, str]:
    try:
        own = importlib.metadata.version("scapekit")
    except importlib.metadata.PackageNotFoundError:
        own = "not installed"
    return {"scapekit": own, "numpy": np.__version__}


def _described(versions: dict[str, str]) -> str:
    return " and ".join(f"{name} {version}" for name, version in versions.items())
