"""Tasks on the workers of a Dask cluster."""
from __future__ import annotations

import contextlib
import pickle
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from pathlib import Path
from typing import Any

import numpy as np

from ..geometry import storage
from .digests import paths_of, program, with_paths
from .room import Failure, Job, attempt_elsewhere

ANSWER = 10                    # seconds that a scheduler may take


def run_on_cluster(address: str, work: Any, jobs: Sequence[Job]) -> Iterator[tuple[Job, Any]]:
    """Each job with what the work returned, or a Failure, as they finish; ValueError where no scheduler serves.

    The work travels to each worker once. Files come back to this process, which alone writes, so workers need no
    place to write to. One thread a worker is best (`dask worker --nthreads 1 --nworkers auto`). Where a
    worker does not see the files under the same path, those of each job travel along.
    """
    from distributed import Client, as_completed

    try:
        client = Client(address, timeout=ANSWER, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ValueError(f"workers: expected the address of a Dask scheduler, none answers at {address} "
                         f"({' '.join(str(error).split())})") from None
    with client:
        try:
            client.wait_for_workers(1, timeout=60)          # of a cluster that was just started
        except TimeoutError:
            raise ValueError(f"workers: {address} has no workers; start some with: dask worker {address}") from None
        # a task that gives its argument back: unlike scattered data it is made anew where all copies are lost
        shared = client.submit(bytes, pickle.dumps((work, _versions())), pure=False)
        there = _entrance()
        ship = not all(_has_same_files(client, job.given) for job in jobs[:1])
        waiting = iter(jobs)
        job_of: dict[Any, Job] = {}
        running = as_completed([], loop=client.loop)

        def submit() -> None:
            """The next job; few at a time, so that shipped files do not pile up at the scheduler."""
            for job in waiting:
                given = with_paths(job.given, Path.absolute)
                sent = job.name, job.place, given, _files(given) if ship else {}
                future = client.submit(there, shared, pickle.dumps(sent), pure=False)
                job_of[future] = job
                running.add(future)
                return

        for _ in range(2 * sum(client.nthreads().values())):
            submit()
        for future in running:
            job = job_of.pop(future)
            submit()
            yield job, _outcome(future, job, address)


def _has_same_files(client: Any, given: Any) -> bool:
    """Whether every worker has the files of a job, by path and size."""
    def same(files: list[tuple[str, int]]) -> bool:
        import os

        return all(os.path.exists(path) and os.path.getsize(path) == size for path, size in files)

    files = [(str(path.absolute()), path.stat().st_size) for path in paths_of(given) if path.is_file()]
    return all(client.run(same, files).values())


def _entrance() -> Callable[[bytes, bytes], tuple[Any, dict[str, bytes], list[str]]]:
    """What is sent to the workers. Dask sends a function without a name of its own as code, and all else are
    bytes, so that a scheduler needs nothing of ours."""
    def there(shared: bytes, job: bytes) -> tuple[Any, dict[str, bytes], list[str]]:
        from scanprep.batch.cluster import do_there

        return do_there(shared, job)

    return there


def _outcome(future: Any, job: Job, address: str) -> Any:
    """What came of a job, its files written to its folder."""
    from distributed import KilledWorker

    try:
        error = future.exception()
    except CancelledError:
        raise ValueError(f"workers: {address} has gone; what was done is kept, start again to go on") from None
    if error is None:
        value, files, notes = future.result()
        for note in notes:
            warnings.warn(note, stacklevel=2)
        for name, data in files.items():
            path = storage.path_inside(job.folder, name, address)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        return value
    if isinstance(error, KilledWorker):
        return Failure(f"{job.name}: the workers at work on it died, one after another")
    raise ValueError(f"workers: a worker of {address} cannot run this ({type(error).__name__}: "
                     f"{' '.join(str(error).split())}); expected {_describe_versions(_versions())} on every worker")


def do_there(shared: bytes, packed: bytes) -> tuple[Any, dict[str, bytes], list[str]]:
    """One job on the machine of a worker: what the work returned, the files that it wrote, and our warnings."""
    work, versions = pickle.loads(shared)
    if versions != _versions():
        raise RuntimeError(f"the worker has {_describe_versions(_versions())}")
    name, place, given, sent = pickle.loads(packed)
    with tempfile.TemporaryDirectory() as temporary:
        here, paths = Path(temporary), dict[Path, Path]()
        for i, (path, data) in enumerate(sent.items()):         # names stay, as they tell what is in the files
            paths[path] = here / "sent" / str(i) / path.name
            paths[path].parent.mkdir(parents=True)
            paths[path].write_bytes(data)
        job = Job(name, with_paths(given, lambda path: paths.get(path, path)), here / "made", place, here / "steps")
        outcome, notes = attempt_elsewhere(work, job)
        for theirs, mine in paths.items():
            notes = [note.replace(str(mine), str(theirs)) for note in notes]
            if isinstance(outcome, Failure):
                outcome = Failure(outcome.reason.replace(str(mine), str(theirs)))
        if isinstance(outcome, Failure):
            return outcome, {}, notes
        made = {path.relative_to(here / "made").as_posix(): path.read_bytes()
                for path in sorted((here / "made").rglob("*")) if path.is_file()}
    return outcome, made, notes


def _files(given: Any) -> dict[Path, bytes]:
    """Path -> contents of the files of a job; one that cannot be read is left for the worker to miss."""
    found: dict[Path, bytes] = {}
    for path in paths_of(given):
        with contextlib.suppress(OSError):
            found[path] = path.read_bytes()
    return found


def _versions() -> dict[str, str]:
    return {"scapekit": program(), "numpy": np.__version__}


def _describe_versions(versions: dict[str, str]) -> str:
    return " and ".join(f"{name} {version}" for name, version in versions.items())
