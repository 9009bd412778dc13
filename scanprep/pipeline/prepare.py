"""A folder of scans to a registered set: one task a scan, resumable, and one bad scan stops no other.

    scans/name.ply, its landmarks, scans.csv  ->  set/meshes/name.ply, set.csv, skeleton.json,
                                                  registration.csv, limbs.csv, failures.csv, report.html
"""
from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from ..batch.opening import workspace
from ..batch.pool import Workers
from ..batch.workspace import Task, Workspace
from ..dataset import RegisteredSet, SetEntry, read_entries, write_set
from ..geometry.landmarks import write_landmarks
from ..geometry.mesh import Mesh, check_template
from ..ranges import Count, Settings
from ..registration.figures import ScanFigures, read_failures, write_doubts, write_failures, write_figures
from ..registration.lead import Lead, lead_of
from ..registration.person import person_parts
from ..registration.schedule import RegistrationConfig
from ..skeleton.find import find_skeleton
from ..skeleton.parts import SkeletonConfig
from ..threads import one_thread
from .bootstrap import bootstrap_set, drop_rounds, find_better_scans
from .page import PICTURES, write_set_page
from .rivals import RIVALS, TWO_BODIES, has_rival, load_figures, rival_file, save_figures
from .scan import RegisterScan, ScanSettings, mesh_file
from .scans import ScanTask

Progress = Callable[[int, int], None]
SCANS = "scans/"                    # before the names of the results that are registered scans


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
    workers : Workers
    """

    scan: ScanSettings = field(default_factory=ScanSettings)
    skeleton: SkeletonConfig = field(default_factory=SkeletonConfig)
    min_poses: Count = 5
    workers: Workers = field(default_factory=Workers)

    @classmethod
    def from_paper(cls) -> PrepareConfig:
        """Scans registered as [SCAPE] did, from landmarks.

        Not as in the paper: landmarks are not multiplied by Correlated Correspondence, which finds all of them for a
        scan that has none. How soft links are, and when, it does not tell. Triangles that end inverted are mended, and
        soles are pressed to a scan that ends flat around the feet.
        """
        return cls(scan=ScanSettings(RegistrationConfig.from_paper()))


@dataclass(frozen=True, eq=False)
class Prepared:
    """What `prepare` did."""

    registered: RegisteredSet
    figures: tuple[ScanFigures, ...]    # of all scans in the set
    failures: tuple[str, ...]           # one line a scan that could not be registered: which file, and why
    fresh: int = 0                      # scans that were registered now; the others had been before


def prepare(tasks: Sequence[ScanTask], template: Mesh, template_landmarks: Mapping[str, int], folder: str | Path,
            config: PrepareConfig | None = None, progress: Progress | None = None,
            skeleton_progress: Progress | None = None, person_progress: Progress | None = None,
            scan_progress: Progress | None = None) -> Prepared:
    """Register the template to every scan, find the skeleton, and write a page that shows how it went.

    What the folder already holds is done again only where something that it depends on has changed. A scan that cannot
    be read or registered is listed; scans of earlier calls, and a skeleton that was edited, stay as they are. Nothing
    that is written depends on the number of workers, their order or interruptions, but for `times.csv`. ValueError for
    a template that cannot serve, or a folder of other scans registered with another template or settings.
    `scan_progress` is told of the steps of each scan that is registered in this process.
    """
    config = config or PrepareConfig()
    check_template(template)
    with workspace(folder) as space, one_thread():
        work, tasks = _set_up(space, tasks, template, template_landmarks, config, person_progress)
        if not space.results(work):                   # the first call, or all is to be done anew
            space.drop("skeleton")
        failures: dict[str, str] = {}
        fresh: set[str] = set()
        _write_tables(space, work, tasks, failures)
        try:
            done = space.run(work, [Task(SCANS + task.name, task) for task in tasks], config.workers, progress,
                             scan_progress)
            failures = {name.removeprefix(SCANS): line for name, line in done.failures.items()}
            fresh = {name.removeprefix(SCANS) for name in done.fresh}
            if config.scan.through not in ("none", "pose"):
                _write_tables(space, work, tasks, failures)
                fresh |= bootstrap_set(space, work, tasks, _first_figures(space, work), config.min_poses,
                                       config.skeleton, config.workers, progress)
                failures = {name: line for name, line in failures.items() if name not in find_better_scans(space, work)}
            _write_tables(space, work, tasks, failures)
            _write_skeleton(space, config, skeleton_progress)
        finally:
            prepared = _write_all(space, work, tasks, failures, len(fresh))
    return prepared


def take_rival(tasks: Sequence[ScanTask], template: Mesh, template_landmarks: Mapping[str, int], folder: str | Path,
               config: PrepareConfig, name: str) -> Prepared:
    """Exchange the two bodies that explain a scan: the rival is its registration now, and `prepare` leaves it so.

    Tasks, template and settings as the set was prepared with. ValueError for a scan without a rival, or one that was
    not registered from its files as they are now.
    """
    with workspace(folder) as space, one_thread():
        work, tasks = _set_up(space, tasks, template, template_landmarks, config, None)
        task = next((Task(SCANS + task.name, task) for task in tasks if task.name == name), None)
        # where both bodies lie: in the folder of a later round, if that was better
        former, file = find_better_scans(space, work).get(name, (None, mesh_file(name)))
        place = (space.folder / file).parent.parent
        if task is None or not has_rival(place, name):
            raise ValueError(f"{name}: there is no other body that explains this scan")
        if not space.is_done(work, task):
            raise ValueError(f"{name}: its files, or scapekit, have changed since; register it again first")
        former = former or space.value(task.name)
        rival = load_figures(place, name)
        with space.instead(work, task) as staged:
            pairs = [(mesh_file(name), rival_file(name))]
            pairs += [(f"{PICTURES}/{name}.{ending}", f"{RIVALS}/{name}.{ending}") for ending in ("webp", "scene")]
            for one, other in pairs:
                for source, target in ((one, other), (other, one)):
                    if (place / source).is_file():                       # there may be no pictures
                        (staged.folder / target).parent.mkdir(exist_ok=True)
                        shutil.copyfile(place / source, staged.folder / target)
            # somebody chose, so that there are two is no doubt of either; the time is that of finding both
            doubts = tuple(doubt for doubt in former.doubts if doubt != TWO_BODIES)
            save_figures(staged.folder, replace(former, doubts=doubts, seconds=np.nan), chosen=True)
            staged.value = replace(rival, seconds=former.seconds)
        drop_rounds(space, name)                                         # the choice counts, and no later round
        return _write_all(space, work, tasks, read_failures(space.folder), 0)


def _set_up(space: Workspace, tasks: Sequence[ScanTask], template: Mesh, template_landmarks: Mapping[str, int],
            config: PrepareConfig, progress: Progress | None) -> tuple[RegisterScan, list[ScanTask]]:
    """The work on each scan of a set, and the scans with the model that leads the template to them."""
    # without what the template has worked out about itself: it is sent around
    bare = Mesh(template.vertices, template.faces, template.colors)
    parts = space.step("person", bare, lambda folder: person_parts(bare, progress))
    model = Path(config.scan.through) if Path(config.scan.through).is_file() else None
    tasks = [replace(task, model=model) for task in tasks]
    lead = _lead(space, bare, tasks, config.scan.through, progress)
    return RegisterScan(bare, {name: int(v) for name, v in template_landmarks.items()}, config.scan,
                        parts if lead is None else parts or lead.parts, lead), tasks


def _write_all(space: Workspace, work: RegisterScan, tasks: Sequence[ScanTask], failures: Mapping[str, str],
               fresh: int) -> Prepared:
    """Write the tables and the page of a set; returns what is in it."""
    figures = _write_tables(space, work, tasks, failures)
    with space.staging("page") as staged:
        write_set_page(space.folder, to=staged.folder)
    return Prepared(RegisteredSet.load(space.folder), tuple(figures[name] for name in sorted(figures)),
                    tuple(failures[name] for name in sorted(failures)), fresh)


def _lead(space: Workspace, template: Mesh, tasks: Sequence[ScanTask], through: str, progress: Progress | None
          ) -> Lead | None:
    """What finds bodies on the scans, if they need it: a model laid on the template, once for the set."""
    if through in ("none", "pose") or (through == "auto" and all(task.landmarks is not None for task in tasks)):
        return None
    model = next((task.model for task in tasks), None)
    return space.step("lead", (template, through, model), lambda folder: lead_of(template, through, progress))


def _write_tables(space: Workspace, work: RegisterScan, tasks: Sequence[ScanTask], failures: Mapping[str, str]
                  ) -> dict[str, ScanFigures]:
    """Everything in the set but meshes, pictures, skeleton and page, of the results that are there: their figures."""
    better = find_better_scans(space, work)
    figures = _first_figures(space, work) | {name: found for name, (found, _) in better.items()}
    # scans of earlier calls stay, if all were registered in the same way
    names = {task.name for task in tasks}
    entries = {entry.name: entry for entry in read_entries(space.folder, names)} \
        if (space.folder / "set.json").exists() else {}
    lost = [name for name in entries if name not in figures and name not in names]
    if lost:
        raise ValueError(f"{space.folder}: holds {len(lost)} other scans that were registered with "
                         f"another template, settings or scapekit ({', '.join(lost[:5])}); name another folder")
    entries |= {t.name: SetEntry(t.name, t.subject, t.pose, t.sex, mesh_file(t.name)) for t in tasks}
    entries |= {name: replace(entries[name], file=file) for name, (_, file) in better.items() if name in entries}
    with space.staging("tables") as staged:
        write_set(staged.folder, work.template, [entries[name] for name in sorted(entries) if name in figures],
                  {"settings": asdict(work.settings)})
        write_landmarks(staged.folder / "landmarks.json", dict(work.landmarks))
        write_figures(staged.folder, figures.values())
        if work.parts is not None:
            write_doubts(staged.folder, {name: each.doubts for name, each in figures.items()})
        write_failures(staged.folder, failures)
    return figures


def _first_figures(space: Workspace, work: RegisterScan) -> dict[str, ScanFigures]:
    """The figures of all scans as they were registered first."""
    return {name.removeprefix(SCANS): found for name, found in space.results(work).items() if name.startswith(SCANS)}


def _write_skeleton(space: Workspace, config: PrepareConfig, progress: Progress | None) -> None:
    """The skeleton of the subject with the most meshes, found anew when one of them has changed."""
    registered, path = RegisteredSet.load(space.folder), space.folder / "skeleton.json"
    if path.exists() and not space.is_ours(path.name):
        return                                                  # edited by hand: it is the user's now
    subjects = [entry.subject for entry in registered.entries]
    most = max(subjects, key=subjects.count, default="")
    if subjects.count(most) < config.min_poses:
        space.drop("skeleton")
        return
    meshes = [space.folder / entry.file for entry in registered.entries if entry.subject == most]

    def find(folder: Path) -> None:
        find_skeleton(registered.template, registered.poses(most), config.skeleton,
                      progress=progress).save(folder / path.name)

    space.step("skeleton", (registered.template, meshes, config.skeleton), find)
