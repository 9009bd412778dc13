"""Register doubted scans again, through a model learned from the good scans of the same set (bootstrapping).

    scans --register--> good ones: learn a model --> doubted ones: register through it --better?--> good; repeat

The model knows this body and its movement; the built-in people know only people in general. It also works for animals
and hands. Scans with landmarks stay as they are, and so do those where the user chose between two bodies.
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
from ..geometry.mesh import Mesh
from ..judgement import size
from ..registration.figures import UNSEEN, ScanFigures, Verdict, review
from ..registration.lead import Lead, lead_of, learn_model
from ..skeleton.find import find_skeleton
from ..skeleton.parts import SkeletonConfig
from .rivals import is_chosen
from .scan import RegisterScan, mesh_file
from .scans import ScanTask

Progress = Callable[[int, int], None]
ROUNDS = 3                          # at most; a further round needs a scan that has become good in the last one
CLEARLY = 0.8                       # a registration counts as better below this share of the former badness
MOST = 40                           # training poses at most: learning takes a second per pose, and more hardly help
MODEL = "set_model.npz"             # file of the learned model, in the folder of the round


@dataclass(frozen=True, eq=False)
class RegisterAgain:
    """The work on each doubted scan: register it through the set's model, and write it if clearly better."""

    first: RegisterScan
    number: int                     # of the round, from 1

    def __call__(self, doubted: tuple[ScanTask, float], context: TaskContext) -> ScanFigures | None:
        """Register a scan again; return its figures, or None where it is not clearly better.

        With it comes its badness: how many times it was over a limit, infinite where it failed.
        """
        scan, badness = doubted
        try:
            registered = self.first.register(scan, context)
        except ValueError:              # the model fails too: the first registration, or its failure, stays
            return None
        if not judge_alone(registered.figures, self.first).badness < CLEARLY * badness:
            return None
        self.first.write(context.folder / folder_of(self.number), scan.name, registered)
        return registered.figures


@dataclass(frozen=True, eq=False)
class Lessons:
    """Training data of a model: mesh files of one subject in several poses, and one mesh of every other subject."""

    subject: str
    poses: tuple[Path, ...]
    shapes: tuple[Path, ...]


def folder_of(number: int) -> str:
    """Return the folder of a round inside the set: its meshes, pictures and model."""
    return f"again{number}"


def judge_alone(figures: ScanFigures, work: RegisterScan) -> Verdict:
    """Judge one scan by itself, without comparing it to the rest of its set."""
    doubts = None if work.parts is None else {figures.name: figures.doubts}
    return review([figures], {}, size(work.template), len(work.template.faces), doubts=doubts, usual=UNSEEN)[0]


def find_better_scans(space: Workspace, work: RegisterScan) -> dict[str, tuple[ScanFigures, str]]:
    """Find scans whose later registration was better: name -> its figures and the path of its mesh in the set."""
    better = {}
    for number in range(1, ROUNDS + 1):
        for figures in space.results(RegisterAgain(work, number)).values():
            if figures is not None:
                better[figures.name] = figures, f"{folder_of(number)}/{mesh_file(figures.name)}"
    return better


def drop_rounds(space: Workspace, name: str) -> None:
    """Remove all later registrations of a scan."""
    for number in range(1, ROUNDS + 1):
        space.drop(f"{folder_of(number)}/{name}")


def drop_round(space: Workspace, number: int, names: Collection[str]) -> None:
    """Remove the registrations of some scans in a round, and its model and lead if no other scan used them.

    Scans of earlier calls, which are not among the names, keep theirs.
    """
    prefix = f"{folder_of(number)}/"
    for name in names:
        space.drop(prefix + name)
    if not space.list_results(prefix):
        space.drop(f"model {number}")
        space.drop(f"lead {number}")


def bootstrap_set(space: Workspace, work: RegisterScan, tasks: Sequence[ScanTask], first: Mapping[str, ScanFigures],
                  min_poses: int, skeleton: SkeletonConfig, workers: Workers, progress: Progress | None = None
                  ) -> set[str]:
    """Register doubted scans without landmarks through models learned from the good ones, round by round.

    Parameters
    ----------
    space : Workspace
        The folder of the set.
    work : RegisterScan
        How all scans were registered first.
    tasks : sequence of ScanTask
        The scans of this call.
    first : mapping of str to ScanFigures
        Figures of the first registrations by scan, without those that failed.
    min_poses : int
        How many good meshes of one subject a model needs.
    skeleton : SkeletonConfig
        How parts are found on a template that is not a person.
    workers : Workers
        Where the work runs.
    progress : callable, optional
        Called as progress(done, total) in every round.

    Returns
    -------
    set of str
        Names of the scans that were registered again in this run.
    """
    fresh = set[str]()
    best = {name: judge_alone(f, work) for name, f in first.items()}
    files = {name: mesh_file(name) for name in best}
    chosen = {name for name in best if is_chosen(space.folder, name)}
    lead_name = "of this set"  # appears in figures as "model of this set"
    for number in range(1, ROUNDS + 1):
        prefix = f"{folder_of(number)}/"
        # doubted scans, and the good ones that can teach a model
        doubted = [task for task in tasks if task.landmarks is None and task.name not in chosen
                   and (task.name not in best or best[task.name].suspect)]
        lessons = choose_lessons(space.folder, tasks, best, files, min_poses)
        if lessons is not None and not lessons.shapes:          # without other shapes the model fits this subject only
            doubted = [task for task in doubted if task.subject == lessons.subject]
        if lessons is None or not doubted:
            drop_round(space, number, {task.name for task in tasks})
            continue
        # learn a model of the good scans; the lead is that model fitted to the template
        model_file = Path(folder_of(number)) / MODEL
        model = space.folder / model_file
        teach = partial(_teach, model_file, work, skeleton, lessons)
        space.step(f"model {number}", (work.template, work.parts, skeleton, lessons), teach)
        lead = space.step(f"lead {number}", (work.template, model), partial(_lay, work.template, model))
        assert lead is not None, "a model was named"
        again = RegisterAgain(replace(work, lead=replace(lead, name=lead_name)), number)      # type: ignore[type-var]
        # register the doubted scans through it
        jobs = [Task(prefix + task.name, (replace(task, model=model), best[task.name].badness if task.name in best
                                          else np.inf)) for task in doubted]
        done = space.run(again, jobs, workers, progress)
        drop_round(space, number, {task.name for task in tasks} - {task.name for task in doubted})
        fresh |= {name.removeprefix(prefix) for name in done.fresh}
        # better registrations replace the earlier ones in the rounds to come
        good_before = sum(not verdict.suspect for verdict in best.values())
        for figures in done.values.values():
            if figures is not None:
                best[figures.name] = judge_alone(figures, work)
                files[figures.name] = f"{folder_of(number)}/{mesh_file(figures.name)}"
        # no scan has become good: further rounds would learn the same model
        if sum(not verdict.suspect for verdict in best.values()) == good_before:
            for later in range(number + 1, ROUNDS + 1):
                drop_round(space, later, {task.name for task in tasks})
            break
    return fresh


def choose_lessons(folder: Path, tasks: Sequence[ScanTask], best: Mapping[str, Verdict], files: Mapping[str, str],
                   min_poses: int) -> Lessons | None:
    """Choose training meshes: good ones of the subject that has most, and one of each other subject.

    None where the subject has fewer than `min_poses`.
    """
    good = [task for task in tasks if task.name in best and not best[task.name].suspect]
    counts = Counter(task.subject for task in good)
    subject = max(counts, key=lambda name: counts[name], default="")
    if counts[subject] < min_poses:
        return None
    places = {task.name: folder / files[task.name] for task in good}
    other_subjects = {task.subject: places[task.name] for task in good if task.subject != subject}
    return Lessons(subject, tuple(places[task.name] for task in good if task.subject == subject),
                   # a single other body does not span shape differences
                   tuple(other_subjects.values()) if len(other_subjects) > 1 else ())


def _lay(template: Mesh, model: Path, _folder: Path) -> Lead | None:
    """Lay a learned model on the template, so that it leads to scans; nothing is written."""
    return lead_of(template, str(model))


def _teach(place: Path, work: RegisterScan, config: SkeletonConfig, lessons: Lessons, folder: Path) -> None:
    """Learn a model from good meshes and write it; parts are those of a person, or found from the poses."""
    poses = np.stack([read_mesh(file, unit="m").vertices for file in lessons.poses])
    if len(poses) > MOST:           # keep those that differ most from each other
        poses = poses[farthest_points((poses - poses.mean(axis=1, keepdims=True)).reshape(len(poses), -1), MOST)]
    shapes = np.stack([read_mesh(file, unit="m").vertices for file in lessons.shapes]) if lessons.shapes else None
    skeleton = find_skeleton(work.template, poses, config) if work.parts is None else work.parts.skeleton
    (folder / place).parent.mkdir(parents=True, exist_ok=True)
    learn_model(work.template, skeleton, poses, shapes, folder / place)
