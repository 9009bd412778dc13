"""From a folder of scans to a registered set: one task per scan, resumable; one bad scan stops no other.

    scans/name.ply, its landmarks, scans.csv  ->  set/meshes/name.ply, set.csv, skeleton.json,
                                                  registration.csv, limbs.csv, failures.csv, report.html
"""
from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated

import numpy as np

from ..batch.opening import workspace
from ..batch.pool import Workers
from ..batch.workspace import Task, Workspace
from ..dataset import RegisteredSet, SetEntry, read_entries, write_set
from ..geometry.landmarks import write_landmarks
from ..geometry.members import ONE_BODY, check_members
from ..geometry.mesh import Mesh, check_template
from ..judgement import Judgement
from ..judgement import size as size_of
from ..ranges import NO_FLAGS, Count, Settings
from ..registration.figures import ScanFigures, read_failures, review, write_doubts, write_failures, write_figures
from ..registration.lead import Lead, lead_of
from ..registration.person import person_parts
from ..registration.schedule import RegistrationConfig
from ..skeleton.find import find_skeleton
from ..skeleton.parts import SkeletonConfig
from ..threads import one_thread
from ..words import describe_result
from .bootstrap import bootstrap_set, drop_rounds, find_better_scans
from .page import PICTURES, judge_set, judge_whole, write_set_page
from .rivals import RIVALS, TWO_BODIES, doubt_rivals, has_rival, load_figures, rival_file, save_figures
from .scan import RegisterScan, ScanSettings, mesh_file
from .scans import ScanTask

Progress = Callable[[int, int], None]
SCANS = "scans/"                    # prefix of the names under which registered scans are kept


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
    skeleton: Annotated[SkeletonConfig, NO_FLAGS] = field(default_factory=SkeletonConfig)
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
    """The result of `prepare`."""

    registered: RegisteredSet
    figures: tuple[ScanFigures, ...]    # of all scans in the set
    failures: tuple[str, ...]           # one line a scan that could not be registered: which file, and why
    fresh: int = 0                      # scans that were registered now; the others had been before
    parts: int | None = None            # that the skeleton was to have
    __repr__ = describe_result

    @property
    def judgement(self) -> Judgement:
        """The verdict on the whole set; `set.csv` and the page have that on each scan."""
        return judge_whole(judge_set(self.registered.folder), self.registered, parts=self.parts)


def prepare(tasks: Sequence[ScanTask], template: Mesh, template_landmarks: Mapping[str, int], folder: str | Path,
            config: PrepareConfig | None = None, progress: Progress | None = None,
            skeleton_progress: Progress | None = None, person_progress: Progress | None = None,
            scan_progress: Progress | None = None) -> Prepared:
    """Register the template to every scan, find the skeleton, and write a page that shows the result.

    A result already in the folder is computed again only if something it depends on has changed. Scans that cannot be
    read or registered are listed. Scans of earlier calls and an edited skeleton stay. Apart from `times.csv` nothing
    depends on the number of workers, their order, or interruptions.

    Parameters
    ----------
    tasks : sequence of ScanTask
        The scans.
    template : Mesh
        One closed or bordered manifold component.
    template_landmarks : mapping of str to int
        Landmark name -> vertex of the template.
    folder : str or Path
        Folder of the set.
    config : PrepareConfig, optional
        Settings.
    progress, skeleton_progress, person_progress : callable, optional
        Called as progress(done, total) for scans, for the skeleton, and for the parts of a person.
    scan_progress : callable, optional
        The same for the steps of each scan that is registered in this process.

    Returns
    -------
    Prepared

    Raises
    ------
    ValueError
        An unsuitable template, or a folder with other scans registered with another template or settings.
    """
    config = config or PrepareConfig()
    check_template(template)
    with workspace(folder) as space, one_thread():
        work, tasks = _set_up(space, tasks, template, template_landmarks, config, person_progress)
        if not space.results(work):                   # the first call, or everything is computed again
            space.drop("skeleton")
        failures: dict[str, str] = {}
        fresh: set[str] = set()
        _write_tables(space, work, tasks, failures)
        try:
            # register the scans; then doubted ones again, through a model of the good ones
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
            # also after an error or Ctrl-C: tables and page show what is finished
            prepared = _write_all(space, work, tasks, failures, len(fresh), config.skeleton.parts)
    return prepared


def take_rival(tasks: Sequence[ScanTask], template: Mesh, template_landmarks: Mapping[str, int], folder: str | Path,
               config: PrepareConfig, name: str) -> Prepared:
    """Swap the two bodies that explain a scan: the rival becomes the registration, and `prepare` keeps that choice.

    Tasks, template and settings as the set was prepared with. ValueError for a scan without a rival, or one that was
    not registered from its files as they are now.
    """
    with workspace(folder) as space, one_thread():
        work, tasks = _set_up(space, tasks, template, template_landmarks, config, None)
        task = next((Task(SCANS + task.name, task) for task in tasks if task.name == name), None)
        # the folder of both bodies: that of a later round, if that was better
        former_figures, file = find_better_scans(space, work).get(name, (None, mesh_file(name)))
        place = (space.folder / file).parent.parent
        if task is None or not has_rival(place, name):
            raise ValueError(f"{name}: there is no other body that explains this scan")
        if not space.is_done(work, task):
            raise ValueError(f"{name}: its files, or scapekit, have changed since; register it again first")
        former_figures = former_figures or space.value(task.name)
        rival = load_figures(place, name)
        with space.instead(work, task) as staged:
            # swap mesh and pictures, as far as there are any
            pairs = [(mesh_file(name), rival_file(name))]
            pairs += [(f"{PICTURES}/{name}.{ending}", f"{RIVALS}/{name}.{ending}") for ending in ("webp", "scene")]
            for file_name, rival_name in pairs:
                for source, target in ((file_name, rival_name), (rival_name, file_name)):
                    if (place / source).is_file():                       # there may be no pictures
                        (staged.folder / target).parent.mkdir(exist_ok=True)
                        shutil.copyfile(place / source, staged.folder / target)
            # once chosen, having a rival is no doubt any more; the time was that of finding both
            doubts = tuple(doubt for doubt in former_figures.doubts if doubt != TWO_BODIES)
            save_figures(staged.folder, replace(former_figures, doubts=doubts, seconds=np.nan), chosen=True)
            staged.value = replace(rival, seconds=former_figures.seconds)
        drop_rounds(space, name)               # the choice replaces registrations of later rounds
        return _write_all(space, work, tasks, read_failures(space.folder), 0, config.skeleton.parts)


def _set_up(space: Workspace, tasks: Sequence[ScanTask], template: Mesh, template_landmarks: Mapping[str, int],
            config: PrepareConfig, progress: Progress | None) -> tuple[RegisterScan, list[ScanTask]]:
    """Prepare the work on each scan of a set, and the scans with the model that leads the template to them."""
    # a fresh copy without cached properties, as it is sent to the workers
    bare = Mesh(template.vertices, template.faces, template.colors)
    tasks = name_model(tasks, config)
    lead = _lead(space, bare, tasks, config.scan.through, progress)
    # a model of people that lies on the template knows its parts; else the average person is registered to it
    parts = None if lead is None else lead.parts
    if parts is None:
        parts = space.step("person", bare, lambda folder: person_parts(bare, progress))
    return RegisterScan(bare, {name: int(v) for name, v in template_landmarks.items()}, config.scan, parts, lead), tasks


def name_model(tasks: Sequence[ScanTask], config: PrepareConfig) -> list[ScanTask]:
    """Return the scans with the file of the model that leads the template, if there is one."""
    model = Path(config.scan.through) if Path(config.scan.through).is_file() else None
    return [replace(task, model=model) for task in tasks]


def _write_all(space: Workspace, work: RegisterScan, tasks: Sequence[ScanTask], failures: Mapping[str, str],
               fresh: int, parts: int | None) -> Prepared:
    """Write the tables and the page of a set; return what is in it."""
    figures = _write_tables(space, work, tasks, failures)
    with space.staging("page") as staged:
        write_set_page(space.folder, to=staged.folder)
    return Prepared(RegisteredSet.load(space.folder), tuple(figures[name] for name in sorted(figures)),
                    tuple(failures[name] for name in sorted(failures)), fresh,
                    # a skeleton that was edited is as its user wants it
                    parts if space.is_ours("skeleton.json") else None)


def _lead(space: Workspace, template: Mesh, tasks: Sequence[ScanTask], through: str, progress: Progress | None
          ) -> Lead | None:
    """Build the model that leads the template to scans without landmarks, once for the set; None if not needed."""
    if through in ("none", "pose") or (through == "auto" and all(task.landmarks is not None for task in tasks)):
        return None
    model = next((task.model for task in tasks), None)
    return space.step("lead", (template, through, model), lambda folder: lead_of(template, through, progress))


def _write_tables(space: Workspace, work: RegisterScan, tasks: Sequence[ScanTask], failures: Mapping[str, str]
                  ) -> dict[str, ScanFigures]:
    """Write everything but meshes, pictures, skeleton and page, from the results that exist; return the figures."""
    better = find_better_scans(space, work)
    figures = _first_figures(space, work) | {name: better_figures for name, (better_figures, _) in better.items()}
    # scans of earlier calls stay if they were registered with the same template and settings
    names = {task.name for task in tasks}
    entries = {entry.name: entry for entry in read_entries(space.folder, names)} \
        if (space.folder / "set.json").exists() else {}
    foreign = [name for name in entries if name not in figures and name not in names]
    if foreign:
        raise ValueError(f"{space.folder}: holds {len(foreign)} other scans that were registered with "
                         f"another template, settings or scapekit ({', '.join(foreign[:5])}); name another folder")
    entries |= {t.name: SetEntry(t.name, t.subject, t.pose, t.sex, mesh_file(t.name)) for t in tasks}
    entries |= {name: replace(entries[name], file=file) for name, (_, file) in better.items() if name in entries}
    with space.staging("tables") as staged:
        registered = [entries[name] for name in sorted(entries) if name in figures]
        write_set(staged.folder, work.template, registered,
                  {"settings": asdict(work.settings)})
        write_landmarks(staged.folder / "landmarks.json", dict(work.landmarks))
        doubts = None if work.parts is None else {name: each.doubts for name, each in figures.items()}
        if doubts is not None:
            write_doubts(staged.folder, doubts)
        verdicts = review([figures[entry.name] for entry in registered], failures, size_of(work.template),
                          len(work.template.faces), doubts=doubts)
        write_figures(staged.folder, doubt_rivals(verdicts, space.folder, registered))
        write_failures(staged.folder, failures)
    return figures


def _first_figures(space: Workspace, work: RegisterScan) -> dict[str, ScanFigures]:
    """Return the figures of all scans as they were registered first."""
    return {name.removeprefix(SCANS): each for name, each in space.results(work).items() if name.startswith(SCANS)}


def _write_skeleton(space: Workspace, config: PrepareConfig, progress: Progress | None) -> None:
    """Find the skeleton from the subject with most meshes, again when one of them has changed."""
    registered, path = RegisteredSet.load(space.folder), space.folder / "skeleton.json"
    if path.exists() and not space.is_ours(path.name):
        return                                                  # edited by hand: it is the user's now
    subjects = [entry.subject for entry in registered.entries]
    subject = max(subjects, key=subjects.count, default="")
    if subjects.count(subject) < config.min_poses:
        space.drop("skeleton")
        return
    meshes = [space.folder / entry.file for entry in registered.entries if entry.subject == subject]

    def find(folder: Path) -> None:
        """Find the skeleton and write it; ValueError for a scan that is no pose of this body, by its name."""
        poses = registered.poses(subject)
        check_members(registered.template, poses, f"scans of {subject}", registered.names_of(subject), ONE_BODY)
        find_skeleton(registered.template, poses, config.skeleton, progress=progress).save(folder / path.name)

    space.step("skeleton", (registered.template, meshes, config.skeleton), find)
