"""An output and what scapekit knows of it: what it wrote there, what is whole, and what must be done anew.

    OUTPUT/.scapekit/lock           held while a run is at work
                     making/        what is being made; a killed run's is removed at the next start
                     ready/NAME/    whole, on its way to its place; a killed run's is brought there at the next start
                     done/NAME.npz  a result: digest of what it depends on, digests of its files, its value
                     steps/         results that later ones are made of
                     files.json     digests of files by size and times of change

A file is replaced or removed only when it is as scapekit wrote it.
"""
from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import quote, unquote

from ..geometry import storage
from .digests import Digests
from .ownership import HOME, ForeignFileError, add_written, digests_in_report, refusal, report_path
from .pool import Failure, Job, Progress, Workers, run_jobs
from .values import load_step_header, load_value, save_value

RECORD = ".record.npz"
NOTHING: Any = object()                   # no result; None may be one
T = TypeVar("T")


@dataclass(frozen=True)
class Task:
    """One thing of many, worked on once."""

    name: str               # its own in the output
    given: Any              # frozen dataclass that is worked on; Paths in it count as what the files hold
    place: str = ""         # folder of its files inside the output


@dataclass(frozen=True)
class Results:
    """What became of tasks, by their names."""

    values: dict[str, Any]          # what the work returned, in the order of the tasks
    failures: dict[str, str]        # one line each
    fresh: tuple[str, ...]          # those that were done now; the others had been done before

    @property
    def only(self) -> Any:
        """The value of the only task; ValueError where it failed."""
        if self.failures:
            raise ValueError(*self.failures.values())
        return next(iter(self.values.values()))


class NothingMadeError(ValueError):
    """All the tasks of a run failed: of an output that it made itself nothing stays."""

    def __init__(self, failures: Sequence[str]) -> None:
        super().__init__("all failed; nothing was written")
        self.failures = tuple(failures)


class Workspace:
    """An output that is open for one run; see `workspace`."""

    def __init__(self, folder: Path, home: Path, force: bool = False, output: Path | None = None) -> None:
        self.folder, self.home, self.force, self.output = folder, home, force, output
        self.digests = Digests(home / "files.json")
        self.is_new = False                 # this run made the folder
        self.all_failed = False             # there were tasks, and of all that were run none was done
        self._some_done = False
        self._made: set[str] = set()

    @cached_property
    def _written(self) -> dict[str, set[str]]:
        """File of the output -> digests that it was written with."""
        found: dict[str, set[str]] = {}
        for place in {self.folder, self.output or self.folder}:
            for record in (place / HOME / "done").glob("*.npz"):
                add_written(found, _files_of(record, place), place.relative_to(self.folder))
        if self.output is not None:
            add_written(found, digests_in_report(self.output), report_path(self.output).parent.relative_to(self.folder))
        return found

    def run(self, work: Any, tasks: Sequence[Task], workers: Workers | None = None, progress: Progress | None = None,
            inside: Progress | None = None) -> Results:
        """Every task whose result is not there, or depends on something that has changed since.

        A task that fails stops no other. Files and value of each take their place when they are whole. `work`, a frozen
        dataclass, is what tasks have in common and sent to every worker once: called with (given, room), it writes
        files into `room.folder` and returns a value that can be kept. `progress` counts tasks, `inside` is `room.tell`
        of those that are done in this process.
        """
        tell = progress or (lambda done, total: None)
        common = self.digests.of(work)
        keys = {task.name: self._key(common, task) for task in tasks}
        assert len(keys) == len(tasks), "names of tasks differ"
        # what is kept, what has no place to write to, and the jobs that are left
        outcomes: dict[str, Any] = {name: self._load_if_valid(name, key) for name, key in keys.items()}
        wanted = [task for task in tasks if outcomes[task.name] is NOTHING]
        outcomes |= {task.name: Failure(line) for task in wanted if (line := self._why_blocked(task))}
        jobs = [Job(task.name, task.given, self._making(), task.place, self.home / "steps" / _plain(task.name),
                    self.force) for task in wanted if outcomes[task.name] is NOTHING]
        done = len(tasks) - len(jobs)
        tell(done, len(tasks))
        try:
            for job, outcome in run_jobs(work, jobs, workers or Workers(), inside):
                outcomes[job.name] = self._accept(job, outcome, keys[job.name], common)
                done += 1
                tell(done, len(tasks))
        finally:
            for job in jobs:
                shutil.rmtree(job.folder, ignore_errors=True)
        failures = {name: one.reason for name, one in outcomes.items() if isinstance(one, Failure)}
        self._some_done |= len(failures) < len(tasks)
        self.all_failed = not self._some_done and (self.all_failed or bool(tasks))
        return Results({name: value for name, value in outcomes.items() if name not in failures}, failures,
                       tuple(job.name for job in jobs if job.name not in failures))

    def _accept(self, job: Job, outcome: Any, key: str, work: str) -> Any:
        """The value of a job as it is kept, its files in their place; or a Failure, which tells of that place."""
        if isinstance(outcome, Failure):
            self.drop(job.name)                     # what was made of other inputs than there are now
            return Failure(outcome.reason.replace(str(job.folder / job.place), str(self.folder / job.place)))
        try:
            self._publish(job.name, job.folder, key, outcome, work)
        except ForeignFileError as error:
            return Failure(str(error))
        return self.value(job.name)

    def step(self, name: str, inputs: Any, make: Callable[[Path], T]) -> T:
        """What `make` returns, or returned for the same inputs before; it gets a folder for files of the output."""
        key = self.digests.key(inputs)
        kept = self._load_if_valid(name, key)
        if kept is not NOTHING:
            return kept
        with self.staging(name, key) as staged:
            staged.value = make(staged.folder)
        return self.value(name)

    def is_done(self, work: Any, task: Task) -> bool:
        """Whether `run` would leave a task as it is."""
        return self._load_if_valid(task.name, self._key(self.digests.of(work), task)) is not NOTHING

    @contextlib.contextmanager
    def instead(self, work: Any, task: Task) -> Iterator[Staged]:
        """As `staging`, of a task that somebody does in another way: for `run` it is done."""
        if line := self._why_blocked(task):
            raise ForeignFileError(line)
        common = self.digests.of(work)
        with self.staging(task.name, self._key(common, task), common) as staged:
            yield staged

    @contextlib.contextmanager
    def staging(self, name: str, key: str = "", work: str = "") -> Iterator[Staged]:
        """A folder for files that take their place in the output, all of them, when the block ends well."""
        staged = Staged(self._making())
        try:
            yield staged
            self._publish(name, staged.folder, key, staged.value, work)
        finally:
            shutil.rmtree(staged.folder, ignore_errors=True)

    def drop(self, name: str) -> None:
        """Remove a result and its files, as far as they are as scapekit wrote them."""
        for file, digest in _files_of(self._record(name), self.folder).items():
            self._remove(file, digest)
        self.drop_record(name)

    def drop_record(self, name: str) -> None:
        """Remove what is kept of a result, but none of its files."""
        self._record(name).unlink(missing_ok=True)

    def list_results(self, start: str) -> list[str]:
        """The results that are kept and whose names begin so."""
        return [unquote(path.stem) for path in sorted((self.home / "done").glob(f"{_plain(start)}*.npz"))]

    def drop_others(self, start: str, names: Collection[str] = ()) -> None:
        """Remove the results whose names begin so, but for those named."""
        for name in self.list_results(start):
            if name not in names:
                self.drop(name)

    def results(self, work: Any) -> dict[str, Any]:
        """What is kept of some work, whichever program made it, by name: whole, with all its files."""
        common = self.digests.of(work)
        found = {}
        for path in sorted((self.home / "done").glob("*.npz")):
            header = _read_record(path, self.folder)
            if header and header["work"] == common and all((self.folder / f).is_file() for f in header["files"]):
                with contextlib.suppress(storage.StorageError):         # damaged, or of a program with other values
                    found[unquote(path.stem)] = load_value(path)
        return found

    def is_ours(self, file: str) -> bool:
        """Whether a file of the output is as scapekit wrote it, and has not been changed since."""
        return self.digests.of_file(self.folder / file) in self._written.get(file, ())

    def value(self, name: str) -> Any:
        """A result as it is kept: how arrays lie in memory decides the last digits of sums."""
        return load_value(self._record(name))

    def _key(self, common: str, task: Task) -> str:
        """What a task depends on; `common` is the digest of the work."""
        return self.digests.key(common, task.place, task.given)

    def _load_if_valid(self, name: str, key: str) -> Any:
        """A result made from the same inputs whose files are all there; NOTHING where it must be made anew."""
        header = _read_record(self._record(name), self.folder)
        if header is None or header["digest"] != key or (self.force and name not in self._made) \
                or not all((self.folder / file).is_file() for file in header["files"]):
            return NOTHING
        try:
            return load_value(self._record(name))
        except storage.StorageError:                        # damaged
            return NOTHING

    def _why_blocked(self, task: Task) -> str:
        """Why a task has no place to write to, before any work is done for it."""
        place = self.folder / task.place
        if not task.place or not place.exists() or self._record(task.name).exists():
            return ""
        if place.is_dir() and not any(place.iterdir()):
            return ""
        return refusal(place)

    def _making(self) -> Path:
        (self.home / "making").mkdir(exist_ok=True)
        return Path(tempfile.mkdtemp(dir=self.home / "making"))

    def _record(self, name: str) -> Path:
        return self.home / "done" / f"{_plain(name)}.npz"

    def _publish(self, name: str, staged: Path, key: str, value: Any, work: str = "") -> None:
        """Whole from the moment at which the folder gets its name among the ready ones."""
        files, taken = self.digests.of_files(staged), list[Path]()
        for file, digest in files.items():
            place = storage.path_inside(self.folder, file, self.folder)      # no link leads the file elsewhere
            if place.is_dir() or any(p.is_file() for p in place.parents if self.folder in p.parents) \
                    or (place.exists() and self.digests.of_file(place) != digest and not self.is_ours(file)):
                taken.append(place)
        if taken:
            raise ForeignFileError(refusal(*taken))
        save_value(staged / RECORD, value, {"digest": key, "work": work, "files": files})
        ready = self.home / "ready" / _plain(name)
        ready.parent.mkdir(exist_ok=True)
        os.replace(staged, ready)
        self._settle(ready)
        self._made.add(name)

    def _settle(self, ready: Path) -> None:
        """Bring the files of a result to their place, and take away those that it had before and has no more."""
        header = _read_record(ready / RECORD, self.folder)
        if header is None:                                  # results get their name when they are whole
            raise storage.StorageError(f"{ready / RECORD}: expected the record of a result, cannot read it; remove "
                                       f"the folder {ready} to make that result anew")
        record = self._record(unquote(ready.name))
        before = self._before(unquote(ready.name))
        for file in header["files"]:
            if (ready / file).exists():                     # else it was brought before the run was killed
                (self.folder / file).parent.mkdir(parents=True, exist_ok=True)
                os.replace(ready / file, self.folder / file)
        for file, digest in before.items():
            if file not in header["files"]:
                self._remove(file, digest)
        add_written(self._written, header["files"], Path())
        record.parent.mkdir(exist_ok=True)
        os.replace(ready / RECORD, record)
        shutil.rmtree(ready)

    def _remove(self, file: str, digest: str) -> None:
        """Take away a file that is as it was written, and the folders that are empty then."""
        path = self.folder / file
        if self.digests.of_file(path) != digest:
            return
        path.unlink()
        for place in path.parents:
            if place == self.folder or any(place.iterdir()):
                break
            place.rmdir()

    def _before(self, name: str) -> dict[str, str]:
        """File -> digest of what a result wrote when it was last made."""
        files = _files_of(self._record(name), self.folder)
        if files or name != "output" or self.output is None:
            return files
        # an output that is a file keeps no record of it
        place = report_path(self.output).parent.relative_to(self.folder)
        return {(place / file).as_posix(): digest for file, digest in digests_in_report(self.output).items()}

    def _recover(self) -> None:
        """What a killed run left: results that were whole come to their place, the others go."""
        for ready in sorted((self.home / "ready").glob("*")):
            if (ready / RECORD).exists():
                self._settle(ready)
            else:                                       # its record, the last to go, had come to its place
                shutil.rmtree(ready)
        shutil.rmtree(self.home / "making", ignore_errors=True)
        for half in (self.home / "steps").glob("*/.*.part*"):
            half.unlink()


@dataclass
class Staged:
    """Files and value of a result that is being made."""

    folder: Path
    value: Any = None


def _read_record(path: Path, folder: Path) -> dict[str, Any] | None:
    """What the record of a result tells; None where there is none that can be read.

    StorageError where it names a file that is not in its folder: such a record was not written here.
    """
    header = load_step_header(path)
    if header is None or not isinstance(header.get("files"), dict) or not {"digest", "work"} <= set(header):
        return None
    for file in header["files"]:
        storage.path_inside(folder, file, path)
    return header


def _files_of(record: Path, folder: Path) -> dict[str, str]:
    """File -> digest of what a result wrote; nothing where there is no record of it."""
    return dict((_read_record(record, folder) or {"files": {}})["files"])


def _plain(name: str) -> str:
    """A name as that of a file."""
    return quote(name, safe=" ")


@dataclass(frozen=True, eq=False)
class KeptSteps:
    """Steps that are kept in an output; when a step is done, those `inside` it are forgotten."""

    space: Workspace
    found: list[str] = field(default_factory=list)          # the steps that had been done before this run
    seconds: dict[str, float] = field(default_factory=dict)     # that those which were done now took

    def __call__(self, name: str, inputs: Any, make: Callable[[], T]) -> T:
        begun, made = time.perf_counter(), False

        def now(folder: Path) -> T:
            nonlocal made
            made = True
            return make()

        value = self.space.step(name, inputs, now)
        if made:
            self.seconds[name] = time.perf_counter() - begun
        elif name not in self.seconds:
            self.found.append(name)
        self.space.drop_others(f"{name}/")
        return value
