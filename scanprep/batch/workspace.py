"""Resume: the records of an output folder say what is complete, and what must be computed again.

    OUTPUT/.scapekit/lock           held while a run is at work
                     making/        unfinished results; those of a killed run are removed at the next start
                     ready/NAME/    finished results on the way to their place; moved there at the next start
                     done/NAME.npz  record of a result: digest of its inputs, digests of its files, its value
                     steps/         intermediate results
                     files.json     digests of files by size and modification time

A file is replaced or removed only when it is unchanged since scapekit wrote it.
"""
from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import unquote

from ..geometry import storage
from ..words import check_names
from .digests import Digests
from .ownership import HOME, ForeignFileError, add_written, digests_in_report, refusal, report_path
from .pool import Failure, Job, Progress, Workers, run_jobs
from .room import plain_name
from .values import load_step_header, load_value, save_value

RECORD = ".record.npz"                    # hidden, as it lies among the files of the result until all are moved
NOTHING: Any = object()                   # stands for no result, because None can be a result
T = TypeVar("T")


@dataclass(frozen=True)
class Task:
    """One piece of work among many, done once."""

    name: str               # unique in the output
    given: Any              # input, a frozen dataclass; a Path in it counts as the file's contents
    place: str = ""         # folder for its files inside the output


@dataclass(frozen=True)
class Results:
    """Outcomes of tasks by name."""

    values: dict[str, Any]          # results, in the order of the tasks
    failures: dict[str, str]        # one line per failed task
    fresh: tuple[str, ...]          # computed in this run; the others were kept from before

    @property
    def only(self) -> Any:
        """Return the value of the only task; ValueError where it failed."""
        if self.failures:
            raise ValueError(*self.failures.values())
        return next(iter(self.values.values()))


class NothingMadeError(ValueError):
    """All tasks of a run failed: an output that this run created is removed again."""

    def __init__(self, failures: Sequence[str]) -> None:
        super().__init__("all failed; nothing was written")
        self.failures = tuple(failures)


class Workspace:
    """An output that is open for one run; see `workspace`."""

    def __init__(self, folder: Path, home: Path, force: bool = False, output: Path | None = None) -> None:
        self.folder, self.home, self.force, self.output = folder, home, force, output
        self.digests = Digests(home / "files.json")
        self.is_new = False                 # this run created the folder
        self.all_failed = False             # there were tasks, and every one of them failed
        self._some_done = False
        self._made: set[str] = set()

    @cached_property
    def _written(self) -> dict[str, set[str]]:
        """Return file of the output -> digests that scapekit wrote it with."""
        known: dict[str, set[str]] = {}
        for place in {self.folder, self.output or self.folder}:
            for record in (place / HOME / "done").glob("*.npz"):
                add_written(known, _files_of(record, place), place.relative_to(self.folder))
        if self.output is not None:
            add_written(known, digests_in_report(self.output), report_path(self.output).parent.relative_to(self.folder))
        return known

    def run(self, work: Any, tasks: Sequence[Task], workers: Workers | None = None, progress: Progress | None = None,
            inside: Progress | None = None) -> Results:
        """Run every task whose result is missing, or whose inputs have changed since.

        A failed task stops no other. Files and value of a task take their place together when both are complete.

        Parameters
        ----------
        work : callable, frozen dataclass
            What the tasks have in common, sent to every worker once. Called as work(given, context), it writes
            files into `context.folder` and returns a value that can be stored.
        tasks : sequence of Task
            Tasks with different names.
        workers : Workers, optional
            Where the tasks run.
        progress : callable, optional
            Called as progress(done, total) with the number of tasks.
        inside : callable, optional
            The same for the steps inside tasks that run in this process.

        Returns
        -------
        Results
        """
        report_progress = progress or (lambda done, total: None)
        common = self.digests.of(work)
        keys = {task.name: self._key(common, task) for task in tasks}
        assert len(keys) == len(tasks), "names of tasks differ"
        check_names((task.place or task.name for task in tasks), str(self.folder))
        # look up kept results, find tasks whose place is taken, and make jobs of the rest
        outcomes: dict[str, Any] = {name: self._load_if_valid(name, key) for name, key in keys.items()}
        pending = [task for task in tasks if outcomes[task.name] is NOTHING]
        outcomes |= {task.name: Failure(line) for task in pending if (line := self._why_blocked(task))}
        jobs = [Job(task.name, task.given, self._making(), task.place, self.home / "steps" / plain_name(task.name),
                    self.force) for task in pending if outcomes[task.name] is NOTHING]
        done = len(tasks) - len(jobs)
        report_progress(done, len(tasks))
        try:
            # run the jobs, and accept each result as it comes
            for job, outcome in run_jobs(work, jobs, workers or Workers(), inside):
                outcomes[job.name] = self._accept(job, outcome, keys[job.name], common)
                done += 1
                report_progress(done, len(tasks))
        finally:
            for job in jobs:
                shutil.rmtree(job.folder, ignore_errors=True)
        # sort the outcomes into values and failures
        failures = {name: outcome.reason for name, outcome in outcomes.items() if isinstance(outcome, Failure)}
        self._some_done |= len(failures) < len(tasks)
        self.all_failed = not self._some_done and (self.all_failed or bool(tasks))
        return Results({name: value for name, value in outcomes.items() if name not in failures}, failures,
                       tuple(job.name for job in jobs if job.name not in failures))

    def _accept(self, job: Job, outcome: Any, key: str, work: str) -> Any:
        """Publish the outcome of a job; return its value as stored, or a Failure that names the final place."""
        if isinstance(outcome, Failure):
            self.drop(job.name)                     # a result of earlier inputs is no longer true
            return Failure(outcome.reason.replace(str(job.folder / job.place), str(self.folder / job.place)))
        try:
            self._publish(job.name, job.folder, key, outcome, work)
        except ForeignFileError as error:
            return Failure(str(error))
        return self.value(job.name)

    def step(self, name: str, inputs: Any, make: Callable[[Path], T]) -> T:
        """Return what `make` returns, or returned before for the same inputs; it gets a folder for output files."""
        key = self.digests.key(inputs)
        kept = self._load_if_valid(name, key)
        if kept is not NOTHING:
            return kept
        with self.staging(name, key) as staged:
            staged.value = make(staged.folder)
        return self.value(name)

    def is_done(self, work: Any, task: Task) -> bool:
        """Return whether `run` would keep the existing result of a task."""
        return self._load_if_valid(task.name, self._key(self.digests.of(work), task)) is not NOTHING

    def has_changed(self, task: Task) -> bool:
        """Return whether the inputs of a task alone, not those of all, have changed since its result was made.

        True where there is no result.
        """
        header = _read_record(self._record(task.name), self.folder)
        return header is None or header["digest"] != self._key(header["work"], task)

    @contextlib.contextmanager
    def instead(self, work: Any, task: Task) -> Iterator[Staged]:
        """Stage a result that replaces the one of a task; afterwards `run` takes the task as done."""
        if line := self._why_blocked(task):
            raise ForeignFileError(line)
        common = self.digests.of(work)
        with self.staging(task.name, self._key(common, task), common) as staged:
            yield staged

    @contextlib.contextmanager
    def staging(self, name: str, key: str = "", work: str = "") -> Iterator[Staged]:
        """Provide a temporary folder; its files move into the output together when the block ends without error."""
        staged = Staged(self._making())
        try:
            yield staged
            self._publish(name, staged.folder, key, staged.value, work)
        finally:
            shutil.rmtree(staged.folder, ignore_errors=True)

    def drop(self, name: str) -> None:
        """Remove a result and those of its files that are unchanged."""
        for file, digest in _files_of(self._record(name), self.folder).items():
            self._remove(file, digest)
        self.drop_record(name)

    def drop_record(self, name: str) -> None:
        """Remove the record of a result, but none of its files."""
        self._record(name).unlink(missing_ok=True)

    def list_results(self, start: str) -> list[str]:
        """Return the names of kept results that begin with a text."""
        return [unquote(path.stem) for path in sorted((self.home / "done").glob(f"{plain_name(start)}*.npz"))]

    def drop_others(self, start: str, names: Collection[str] = ()) -> None:
        """Remove the results whose names begin with a text, except the named ones."""
        for name in self.list_results(start):
            if name not in names:
                self.drop(name)

    def results(self, work: Any) -> dict[str, Any]:
        """Return name -> value of all complete results of some work, whichever program version made them."""
        common = self.digests.of(work)
        values = {}
        for path in sorted((self.home / "done").glob("*.npz")):
            header = _read_record(path, self.folder)
            if header and header["work"] == common and all((self.folder / f).is_file() for f in header["files"]):
                with contextlib.suppress(storage.StorageError):         # damaged, or of a version with other fields
                    values[unquote(path.stem)] = load_value(path)
        return values

    def is_ours(self, file: str) -> bool:
        """Return whether a file of the output is unchanged since scapekit wrote it."""
        return self.digests.of_file(self.folder / file) in self._written.get(file, ())

    def value(self, name: str) -> Any:
        """Read a result back from its file: the memory order of arrays changes the last digits of sums."""
        return load_value(self._record(name))

    def _key(self, common: str, task: Task) -> str:
        """Compute the digest of everything a task depends on; `common` is the digest of the work."""
        return self.digests.key(common, task.place, task.given)

    def _load_if_valid(self, name: str, key: str) -> Any:
        """Read a result made from the same inputs whose files all exist; else return NOTHING."""
        header = _read_record(self._record(name), self.folder)
        if header is None or header["digest"] != key or (self.force and name not in self._made) \
                or not all((self.folder / file).is_file() for file in header["files"]):
            return NOTHING
        try:
            return load_value(self._record(name))
        except storage.StorageError:                        # damaged
            return NOTHING

    def _why_blocked(self, task: Task) -> str:
        """Return why a task cannot write to its place, before any work is done; empty text if it can."""
        place = self.folder / task.place
        # no folder of its own, nothing there yet, or an earlier result of this task
        if not task.place or not place.exists() or self._record(task.name).exists():
            return ""
        if place.is_dir() and not any(place.iterdir()):
            return ""
        return refusal(place)

    def _making(self) -> Path:
        """Create a temporary folder for a result."""
        (self.home / "making").mkdir(exist_ok=True)
        return Path(tempfile.mkdtemp(dir=self.home / "making"))

    def _record(self, name: str) -> Path:
        """Return the file that records a result."""
        return self.home / "done" / f"{plain_name(name)}.npz"

    def _publish(self, name: str, staged: Path, key: str, value: Any, work: str = "") -> None:
        """Move a finished result into the output, or raise ForeignFileError if foreign files are in the way.

        The result counts as complete from the moment its folder is renamed into `ready`.
        """
        files, blocked = self.digests.of_files(staged), list[Path]()
        for file, digest in files.items():
            place = storage.place_to_write(self.folder, file, self.folder)
            if place.is_dir() or any(p.is_file() for p in place.parents if self.folder in p.parents) \
                    or (place.exists() and self.digests.of_file(place) != digest and not self.is_ours(file)):
                blocked.append(place)
        if blocked:
            raise ForeignFileError(refusal(*blocked))
        # one rename makes the result complete; a run killed after it is repaired at the next start
        save_value(staged / RECORD, value, {"digest": key, "work": work, "files": files})
        ready = self.home / "ready" / plain_name(name)
        ready.parent.mkdir(exist_ok=True)
        os.replace(staged, ready)
        self._settle(ready)
        self._made.add(name)

    def _settle(self, ready: Path) -> None:
        """Move the files of a complete result to their place, and remove files that only the former result had."""
        header = _read_record(ready / RECORD, self.folder)
        if header is None:                                  # a folder in `ready` always has its record
            raise storage.StorageError(f"{ready / RECORD}: expected the record of a result, cannot read it; remove "
                                       f"the folder {ready} to make that result anew")
        record = self._record(unquote(ready.name))
        former_files = _files_of(record, self.folder)
        if not former_files and self.output is not None and unquote(ready.name) == "output":
            # an output that is a single file keeps its former files in its report
            place = report_path(self.output).parent.relative_to(self.folder)
            former_files = {(place / file).as_posix(): digest for file, digest in
                            digests_in_report(self.output).items()}
        # move the new files, then remove those that only the former result had
        for file in header["files"]:
            if (ready / file).exists():                     # otherwise it was moved before the run was killed
                place = storage.place_to_write(self.folder, file, ready / RECORD)
                place.parent.mkdir(parents=True, exist_ok=True)
                os.replace(ready / file, place)
        for file, digest in former_files.items():
            if file not in header["files"]:
                self._remove(file, digest)
        # the record moves last: until then the next start repeats what is missing
        add_written(self._written, header["files"], Path())
        record.parent.mkdir(exist_ok=True)
        os.replace(ready / RECORD, record)
        shutil.rmtree(ready)

    def _remove(self, file: str, digest: str) -> None:
        """Remove a file if it is unchanged, and then the folders that have become empty."""
        path = self.folder / file
        if self.digests.of_file(path) != digest:
            return
        path.unlink()
        for place in path.parents:
            if place == self.folder or any(place.iterdir()):
                break
            place.rmdir()

    def _recover(self) -> None:
        """Repair what a killed run left: complete results move to their place, unfinished ones are removed."""
        for ready in sorted((self.home / "ready").glob("*")):
            if (ready / RECORD).exists():
                self._settle(ready)
            else:                                       # the record moves last, so all files are in place
                shutil.rmtree(ready)
        shutil.rmtree(self.home / "making", ignore_errors=True)
        # half-written files of steps
        for half in (self.home / "steps").glob("*/.*.part*"):
            half.unlink()


@dataclass
class Staged:
    """Files and value of a result that is being made."""

    folder: Path
    value: Any = None


def _read_record(path: Path, folder: Path) -> dict[str, Any] | None:
    """Read the record of a result; None where there is none that can be read.

    StorageError where it names a file outside its folder: scapekit did not write such a record.
    """
    header = load_step_header(path)
    if header is None or not isinstance(header.get("files"), dict) or not {"digest", "work"} <= set(header):
        return None
    for file in header["files"]:
        storage.path_inside(folder, file, path)
    return header


def _files_of(record: Path, folder: Path) -> dict[str, str]:
    """Return file -> digest of what a result wrote; empty where it has no record."""
    return dict((_read_record(record, folder) or {"files": {}})["files"])


@dataclass(frozen=True, eq=False)
class KeptSteps:
    """Steps kept in an output; a finished step removes the steps inside it."""

    space: Workspace

    def __call__(self, name: str, inputs: Any, make: Callable[[], T]) -> T:
        """Return the kept result of a step, or run it."""
        value = self.space.step(name, inputs, lambda folder: make())
        # its inner steps are not needed any more
        self.space.drop_others(f"{name}/")
        return value
