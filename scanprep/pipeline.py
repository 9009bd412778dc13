"""A folder of scans to a registered set: one task a scan, resumable, and one bad scan stops no other.

    scans/name.ply, its landmarks, scans.csv  ->  set/meshes/name.ply, set.csv, skeleton.json,
                                                  registration.csv, failures.csv, pictures/name.webp, report.html
"""
from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from .batch.figures import Failure, ScanFigures, read_failures, read_figures, write_failures, write_figures
from .batch.lock import locked
from .batch.page import PICTURES, write_set_page
from .batch.scan import RegisteredScan, ScanSettings, one_thread, register_scan
from .batch.tasks import LANDMARK_ENDINGS, TABLE, ScanTask, find_scans, read_scan
from .batch.workers import Outcome, Work, run_in_processes
from .dataset import RegisteredSet
from .geometry import storage
from .geometry.landmarks import write_landmarks
from .geometry.mesh import Mesh, check_template
from .ranges import Count, Settings, Workers
from .skeleton.find import find_skeleton
from .skeleton.parts import SkeletonConfig

__all__ = ["LANDMARK_ENDINGS", "TABLE", "PrepareConfig", "Prepared", "ScanFigures", "ScanSettings", "ScanTask",
           "find_scans", "prepare", "read_scan", "register_scan"]

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class PrepareConfig(Settings):
    """Settings of `prepare`.

    Attributes
    ----------
    scan : ScanSettings
        How each scan is registered.
    skeleton : SkeletonConfig
    min_poses : int
        A skeleton is sought when one subject has at least so many meshes.
    workers : int
        Processes on this machine; 0 for one a core.
    scheduler : str, optional
        Address of a Dask scheduler, whose workers then do the work.
    ship : bool
        Send the files of the scans to those workers, which otherwise read them under the same path.
    """

    scan: ScanSettings = field(default_factory=ScanSettings)
    skeleton: SkeletonConfig = field(default_factory=SkeletonConfig)
    min_poses: Count = 5
    workers: Workers = 0
    scheduler: str | None = None
    ship: bool = False


@dataclass(frozen=True, eq=False)
class Prepared:
    """What `prepare` did.

    Attributes
    ----------
    registered : RegisteredSet
    figures : tuple of ScanFigures, of all scans in the set
    failures : tuple of str
        One line a scan that could not be registered: which file, and why.
    fresh : int
        Scans that were registered now; the others had been before.
    """

    registered: RegisteredSet
    figures: tuple[ScanFigures, ...]
    failures: tuple[str, ...]
    fresh: int = 0


def prepare(tasks: Sequence[ScanTask], template: Mesh, template_landmarks: dict[str, int], folder: str | Path,
            config: PrepareConfig | None = None, progress: Progress | None = None,
            skeleton_progress: Progress | None = None) -> Prepared:
    """Register the template to every scan, find the skeleton, and write a page that shows how it went.

    Scans that the folder already holds are not registered again unless their files have changed, so the same call
    goes on where it was interrupted. A scan that cannot be read or registered is listed and the others go on.
    What is written does not depend on the number of workers, on their order or on interruptions; only `times.csv`
    does.

    Parameters
    ----------
    tasks : from `find_scans`
    template : Mesh
        One connected manifold component.
    template_landmarks : name -> vertex
        May be empty where no scan has landmarks.
    folder : path
        Of the registered set.

    Raises
    ------
    ValueError
        A template that cannot serve, a folder that holds a set made with another template or settings or where
        another run is at work, a scheduler that does not answer.
    """
    config = config or PrepareConfig()
    folder = Path(folder)
    check_template(template)
    with locked(folder), one_thread():
        registered = _open_set(folder, template, config)
        write_landmarks(folder / "landmarks.json", {name: int(v) for name, v in template_landmarks.items()})
        run = _Run(registered, tasks, progress or (lambda done, total: None))
        try:
            run.register(_outcomes(run.wanted, _work(template, template_landmarks, config), config))
            run.registered = _with_skeleton(run.registered.in_order(), config, skeleton_progress)
        finally:
            write_set_page(folder)
    return run.result()


class _Run:
    """A run under way: what the set holds, what is still to be done, what failed."""

    def __init__(self, registered: RegisteredSet, tasks: Sequence[ScanTask], progress: Progress) -> None:
        self.registered, self.tasks, self.progress = registered, tasks, progress
        self.folder = registered.folder
        for stale in self.folder.rglob(".*.part*"):         # half-written when an earlier run was killed
            stale.unlink()
        self.figures = {f.name: f for f in read_figures(self.folder) if f.name in registered.names}
        names = {task.name for task in tasks}
        self.failures = {f.name: f for f in read_failures(self.folder) if f.name in names}
        self.wanted = [task for task in tasks if not self.is_done(task)]

    def is_done(self, task: ScanTask) -> bool:
        """Whether the set holds the scan as its files are now."""
        known = self.figures.get(task.name)
        return known is not None and known.inputs == task.fingerprint()

    def register(self, outcomes: Iterator[tuple[ScanTask, Outcome]]) -> None:
        """Write each outcome as it comes, the row of figures last: with it the scan is done."""
        done = len(self.tasks) - len(self.wanted)
        self.progress(done, len(self.tasks))
        for task, outcome in outcomes:
            if isinstance(outcome, str):
                self.failures[task.name] = Failure(task.name, outcome)
                write_failures(self.folder, self.failures.values())
            else:
                self.keep(task, outcome)
            done += 1
            self.progress(done, len(self.tasks))

    def keep(self, task: ScanTask, found: RegisteredScan) -> None:
        """A registered scan into the set."""
        if found.picture:
            with storage.writing(self.folder / PICTURES / f"{task.name}.webp") as beside:
                beside.write_bytes(found.picture)
        self.registered = self.registered.add(task.name, found.vertices, task.subject, task.pose, task.sex)
        if self.failures.pop(task.name, None):
            write_failures(self.folder, self.failures.values())
        self.figures[task.name] = found.figures
        write_figures(self.folder, self.figures.values())

    def result(self) -> Prepared:
        """What this run leaves."""
        fresh = sum(task.name in self.figures and task.name not in self.failures for task in self.wanted)
        return Prepared(self.registered, tuple(self.figures[n] for n in self.registered.names if n in self.figures),
                        tuple(f.reason for _, f in sorted(self.failures.items())), fresh)


def _outcomes(tasks: Sequence[ScanTask], work: Work, config: PrepareConfig) -> Iterator[tuple[ScanTask, Outcome]]:
    if config.scheduler is None or not tasks:
        return run_in_processes(work, tasks, config.workers)
    from .batch.cluster import run_on_cluster

    return run_on_cluster(config.scheduler, work, tasks, config.ship)


def _work(template: Mesh, template_landmarks: dict[str, int], config: PrepareConfig) -> Work:
    """What the scans have in common, without what the template has worked out about itself: it is sent around."""
    return Work(Mesh(template.vertices, template.faces, template.colors), template_landmarks, config.scan)


def _open_set(folder: Path, template: Mesh, config: PrepareConfig) -> RegisteredSet:
    settings = asdict(replace(config.scan, pictures=True))          # pictures change no mesh
    registered = RegisteredSet.create(folder, template, {"settings": settings})
    # through JSON, as the stored settings have been
    if storage.as_json(registered.info.get("settings")) != storage.as_json(settings):
        raise ValueError(f"{folder}: the set was begun with other settings; name another folder, or remove it")
    return registered


def _with_skeleton(registered: RegisteredSet, config: PrepareConfig, progress: Progress | None) -> RegisteredSet:
    subjects = [entry.subject for entry in registered.entries]
    if registered.skeleton is not None or not subjects or max(map(subjects.count, subjects)) < config.min_poses:
        return registered
    skeleton = find_skeleton(registered.template, registered.poses(), config.skeleton, progress=progress)
    return registered.with_skeleton(skeleton)
