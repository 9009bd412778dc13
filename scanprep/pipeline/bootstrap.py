"""A set teaches itself: doubted scans are registered again, through a model of the scans that are not doubted.

    scans --register--> good: learn a model of them --> doubted: register through it --better?--> good, and once more

The model knows this body and how it moves, where the built-in people know people in general; and it is there for
animals and hands too. Scans with landmarks are left as they are, and those for which somebody chose between two bodies.
"""
from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from ..batch.pool import Workers
from ..batch.room import TaskContext
from ..batch.workspace import Task, Workspace
from ..geometry.farthest_points import farthest_points
from ..geometry.files import read_mesh
from ..judgement import size
from ..registration.figures import UNSEEN, ScanFigures, Verdict, review
from ..registration.lead import lead_of, learn_model
from ..skeleton.find import find_skeleton
from ..skeleton.parts import SkeletonConfig
from .rivals import is_chosen
from .scan import RegisterScan, mesh_file
from .scans import ScanTask

Progress = Callable[[int, int], None]
ROUNDS = 3                          # models that are learned at most; another one needs a scan that has become good
CLEARLY = 0.8                       # of what was wrong with a scan, below which its next registration is better
MOST = 40                           # poses that teach: learning takes a second a pose, and more hardly help a search
MODEL = "set_model.npz"             # what the set taught, in the folder of the round


@dataclass(frozen=True, eq=False)
class DoubtedScan:
    """A scan that is registered again, and how bad it was: the multiple of a limit; infinite where it failed."""

    scan: ScanTask
    badness: float


@dataclass(frozen=True, eq=False)
class RegisterAgain:
    """The work on each doubted scan: registered through the set's model, written where that is clearly better."""

    first: RegisterScan
    number: int                     # of the round, from 1

    def __call__(self, given: DoubtedScan, room: TaskContext) -> ScanFigures | None:
        try:
            found = self.first.register(given.scan, room)
        except ValueError:              # the model does not find it either: the first registration stays, or its reason
            return None
        if not judge_alone(found.figures, self.first).badness < CLEARLY * given.badness:
            return None
        self.first.write(room.folder / folder_of(self.number), given.scan.name, found)
        return found.figures


@dataclass(frozen=True, eq=False)
class Lessons:
    """What teaches a model: files of meshes of one subject in several poses, and one mesh of each of the others."""

    subject: str
    poses: tuple[Path, ...]
    shapes: tuple[Path, ...]


def folder_of(number: int) -> str:
    """Where the meshes, pictures and model of a round are, inside the folder of the set."""
    return f"again{number}"


def judge_alone(figures: ScanFigures, work: RegisterScan) -> Verdict:
    """The verdict on one scan, whatever is usual in its set."""
    doubts = None if work.parts is None else {figures.name: figures.doubts}
    return review([figures], {}, size(work.template), len(work.template.faces), doubts=doubts, usual=UNSEEN)[0]


def find_better_scans(space: Workspace, work: RegisterScan) -> dict[str, tuple[ScanFigures, str]]:
    """Scans whose later registration was better: their figures, and where the mesh is inside the set."""
    found = {}
    for number in range(1, ROUNDS + 1):
        for figures in space.results(RegisterAgain(work, number)).values():
            if figures is not None:
                found[figures.name] = figures, f"{folder_of(number)}/{mesh_file(figures.name)}"
    return found


def drop_rounds(space: Workspace, name: str) -> None:
    """Remove the later registrations of a scan."""
    for number in range(1, ROUNDS + 1):
        space.drop(f"{folder_of(number)}/{name}")


def drop_round(space: Workspace, number: int, names: Collection[str]) -> None:
    """Remove the registrations of some scans in a round, and its model when nothing else was made with it.

    Scans of earlier calls, which are not among the names, keep theirs.
    """
    kept = f"{folder_of(number)}/"
    for name in names:
        space.drop(kept + name)
    if not space.list_results(kept):
        space.drop(f"model {number}")


def bootstrap_set(space: Workspace, work: RegisterScan, tasks: Sequence[ScanTask], first: Mapping[str, ScanFigures],
                  min_poses: int, skeleton: SkeletonConfig, workers: Workers, progress: Progress | None = None
                  ) -> set[str]:
    """Register doubted scans without landmarks through models that the others teach, round by round.

    Parameters
    ----------
    space : Workspace
        The folder of the set.
    work : RegisterScan
        How all were registered first.
    tasks : scans of this call
    first : name -> figures of the first registrations
        Without those that failed.
    min_poses : int
        Good meshes of one subject that are needed.
    skeleton : SkeletonConfig
        How parts are found on a template that is no person.
    workers : Workers
    progress : callable, optional
        Called as progress(done, total) in every round.

    Returns
    -------
    names of the scans that were registered again now
    """
    fresh = set[str]()
    best = {name: judge_alone(f, work) for name, f in first.items()}
    files = {name: mesh_file(name) for name in best}
    chosen = {name for name in best if is_chosen(space.folder, name)}
    own = "of this set"  # what such a lead is called in figures: "model of this set"
    for number in range(1, ROUNDS + 1):
        kept = f"{folder_of(number)}/"
        doubted = [task for task in tasks if task.landmarks is None and task.name not in chosen
                   and (task.name not in best or best[task.name].suspect)]
        lessons = choose_lessons(space.folder, tasks, best, files, min_poses)
        if lessons is not None and not lessons.shapes:          # it knows the body of one subject alone
            doubted = [task for task in doubted if task.subject == lessons.subject]
        if lessons is None or not doubted:
            drop_round(space, number, {task.name for task in tasks})
            continue
        # a model of what is good; its file is in the folder of the round
        place = Path(folder_of(number)) / MODEL
        model = space.folder / place
        teach = partial(_teach, place, work, skeleton, lessons)
        space.step(f"model {number}", (work.template, work.parts, skeleton, lessons), teach)
        lead = lead_of(work.template, str(model))
        assert lead is not None, "a model was named"
        again = RegisterAgain(replace(work, lead=replace(lead, name=own)), number)      # type: ignore[type-var]
        given = [DoubtedScan(replace(task, model=model), best[task.name].badness if task.name in best else np.inf)
                 for task in doubted]
        done = space.run(again, [Task(kept + one.scan.name, one) for one in given], workers, progress)
        drop_round(space, number, {task.name for task in tasks} - {task.name for task in doubted})
        fresh |= {name.removeprefix(kept) for name in done.fresh}
        # what became better counts from now on
        before = sum(not verdict.suspect for verdict in best.values())
        for figures in done.values.values():
            if figures is not None:
                best[figures.name] = judge_alone(figures, work)
                files[figures.name] = f"{folder_of(number)}/{mesh_file(figures.name)}"
        if sum(not verdict.suspect for verdict in best.values()) == before:
            for later in range(number + 1, ROUNDS + 1):
                drop_round(space, later, {task.name for task in tasks})
            break
    return fresh


def choose_lessons(folder: Path, tasks: Sequence[ScanTask], best: Mapping[str, Verdict], files: Mapping[str, str],
                   min_poses: int) -> Lessons | None:
    """Good meshes of the subject with the most of them, and one of each other subject; None where they are too few."""
    good = [task for task in tasks if task.name in best and not best[task.name].suspect]
    counts = Counter(task.subject for task in good)
    subject = max(counts, key=lambda name: counts[name], default="")
    if counts[subject] < min_poses:
        return None
    places = {task.name: folder / files[task.name] for task in good}
    others = {task.subject: places[task.name] for task in good if task.subject != subject}
    return Lessons(subject, tuple(places[task.name] for task in good if task.subject == subject),
                   tuple(others.values()) if len(others) > 1 else ())


def _teach(place: Path, work: RegisterScan, config: SkeletonConfig, lessons: Lessons, folder: Path) -> None:
    """Write a model of meshes that are good, with the parts of a person, or those that the poses show."""
    poses = np.stack([read_mesh(file, unit="m").vertices for file in lessons.poses])
    if len(poses) > MOST:           # those that differ most from one another
        poses = poses[farthest_points((poses - poses.mean(axis=1, keepdims=True)).reshape(len(poses), -1), MOST)]
    shapes = np.stack([read_mesh(file, unit="m").vertices for file in lessons.shapes]) if lessons.shapes else None
    skeleton = find_skeleton(work.template, poses, config) if work.parts is None else work.parts.skeleton
    (folder / place).parent.mkdir(parents=True, exist_ok=True)
    learn_model(work.template, skeleton, poses, shapes, folder / place)
