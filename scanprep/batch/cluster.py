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

ANSWER = 10                    # seconds to wait for a scheduler: longer means a wrong address


def run_on_cluster(address: str, work: Any, jobs: Sequence[Job]) -> Iterator[tuple[Job, Any]]:
    """Run jobs on a Dask cluster and yield each with its result or Failure, in the order in which they finish.

    The work travels to each worker once. Result files come back to this process, which alone writes to disk.
    One thread per worker is best (`dask worker --nthreads 1 --nworkers auto`). Where a worker does not see the
    input files under the same path, they are sent with each job.

    Raises
    ------
    ValueError
        No scheduler answers at the address, it has no workers, they run other versions, or Dask is not installed.
    """
    try:
        from distributed import Client, as_completed
    except ImportError:
        raise ValueError(f'workers: {address} is a Dask cluster, which needs: pip install "scapekit[cluster]"'
                         ) from None
    try:
        client = Client(address, timeout=ANSWER, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ValueError(f"workers: expected the address of a Dask scheduler, none answers at {address} "
                         f"({' '.join(str(error).split())})") from None
    with client:
        try:
            client.wait_for_workers(1, timeout=60)          # seconds: a cluster that was just started needs time
        except TimeoutError:
            raise ValueError(f"workers: {address} has no workers; start some with: dask worker {address}") from None
        # send the work as a task that returns its argument: scattered data would be lost with the worker that holds it
        shared = client.submit(bytes, pickle.dumps((work, _versions())), pure=False)
        remote_entry = _entrance()
        # files travel with the jobs unless every worker sees those of the first job
        send_files = not all(_has_same_files(client, job.given) for job in jobs[:1])
        waiting = iter(jobs)
        job_of: dict[Any, Job] = {}
        running = as_completed([], loop=client.loop)

        def submit() -> None:
            """Submit the next job."""
            for job in waiting:
                job_input = with_paths(job.given, Path.absolute)
                message = job.name, job.place, job_input, _files(job_input) if send_files else {}
                future = client.submit(remote_entry, shared, pickle.dumps(message), pure=False)
                job_of[future] = job
                running.add(future)
                return

        # two jobs per thread keep workers busy; more would pile up sent files at the scheduler
        for _ in range(2 * sum(client.nthreads().values())):
            submit()
        # as one job finishes the next one is submitted
        for future in running:
            job = job_of.pop(future)
            submit()
            yield job, _outcome(future, job, address)


def _has_same_files(client: Any, job_input: Any) -> bool:
    """Return whether every worker has the files of a job, judged by path and size."""
    def same(files: list[tuple[str, int]]) -> bool:
        import os

        return all(os.path.exists(path) and os.path.getsize(path) == size for path, size in files)

    files = [(str(path.absolute()), path.stat().st_size) for path in paths_of(job_input) if path.is_file()]
    return all(client.run(same, files).values())


def _entrance() -> Callable[[bytes, bytes], tuple[Any, dict[str, bytes], list[str]]]:
    """Return the function that Dask sends to the workers.

    Dask sends a function without a global name as code. All else are bytes, so the scheduler needs no scapekit.
    """
    def there(shared: bytes, job: bytes) -> tuple[Any, dict[str, bytes], list[str]]:
        from scanprep.batch.cluster import do_there

        return do_there(shared, job)

    return there


def _outcome(future: Any, job: Job, address: str) -> Any:
    """Return the result of a finished job, or a Failure, and write its files into the job's folder."""
    try:
        error = future.exception()
    except CancelledError:
        raise ValueError(f"workers: {address} has gone; what was done is kept, start again to go on") from None
    if error is None:
        # success: repeat the worker's warnings here and write the files that came back
        value, files, notes = future.result()
        for note in notes:
            warnings.warn(note, stacklevel=2)
        for name, data in files.items():
            path = storage.path_inside(job.folder, name, address)
            path.parent.mkdir(parents=True, exist_ok=True)
            storage.create_file(path, data)
        return value
    from distributed import KilledWorker

    if isinstance(error, KilledWorker):
        return Failure(f"{job.name}: the workers at work on it died, one after another")
    raise ValueError(f"workers: a worker of {address} cannot run this ({type(error).__name__}: "
                     f"{' '.join(str(error).split())}); expected {_describe_versions(_versions())} on every worker")


def do_there(shared: bytes, packed: bytes) -> tuple[Any, dict[str, bytes], list[str]]:
    """Run one job on the machine of a worker; return its result, the files it wrote, and our warnings."""
    work, versions = pickle.loads(shared)
    if versions != _versions():
        raise RuntimeError(f"the worker has {_describe_versions(_versions())}")
    name, place, job_input, file_contents = pickle.loads(packed)
    with tempfile.TemporaryDirectory() as temporary:
        here, paths = Path(temporary), dict[Path, Path]()
        # write the files that came with the job, and point the job to them
        for i, (path, data) in enumerate(file_contents.items()):         # file names stay: their endings say the format
            paths[path] = here / "sent" / str(i) / path.name
            paths[path].parent.mkdir(parents=True)
            paths[path].write_bytes(data)
        job = Job(name, with_paths(job_input, lambda path: paths.get(path, path)), here / "made", place, here / "steps")
        outcome, notes = attempt_elsewhere(work, job)
        # messages name files as the sender knows them
        for sender_path, local_path in paths.items():
            notes = [note.replace(str(local_path), str(sender_path)) for note in notes]
            if isinstance(outcome, Failure):
                outcome = Failure(outcome.reason.replace(str(local_path), str(sender_path)))
        if isinstance(outcome, Failure):
            return outcome, {}, notes
        # read the results back, as this folder is temporary
        written_files = {path.relative_to(here / "made").as_posix(): path.read_bytes()
                         for path in sorted((here / "made").rglob("*")) if path.is_file()}
    return outcome, written_files, notes


def _files(job_input: Any) -> dict[Path, bytes]:
    """Read the files of a job: path -> contents. A file that cannot be read is left for the worker to report."""
    contents: dict[Path, bytes] = {}
    for path in paths_of(job_input):
        with contextlib.suppress(OSError):
            contents[path] = path.read_bytes()
    return contents


def _versions() -> dict[str, str]:
    """Return the versions that must agree on all machines: results depend on both."""
    return {"scapekit": program(), "numpy": np.__version__}


def _describe_versions(versions: dict[str, str]) -> str:
    """Return versions as words for a message."""
    return " and ".join(f"{name} {version}" for name, version in versions.items())
