"""Co-registration: rounds of registering all scans with a model and learning the model again [BlendSCAPE]."""
from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from scanprep.batch.opening import workspace
from scanprep.batch.room import TaskContext
from scanprep.batch.workspace import Task, Workspace
from scanprep.geometry.mesh import Mesh
from scanprep.judgement import extent
from scanprep.plausible import unit_problem
from scanprep.threads import one_thread

from ..body import BodyModel
from ..learning.config import LearnConfig
from ..learning.scape import learn_blendscape, learn_scape
from ..linear import Subject
from .config import CoregistrationConfig
from .single import Landmarks, ModelRegistration, register_with_model

Progress = Callable[[int, int], None]
Scan = Mesh | np.ndarray
SETTLED = 0.0007                     # share of √area, 1 mm on a man: a round that moves the mean vertex less ends it
Lessons = tuple[np.ndarray, np.ndarray | None]       # poses (M, N, 3) of the template's person, shapes (S, N, 3)


@dataclass(frozen=True, eq=False)
class Coregistration:
    """Result of `coregister`: all n scans registered with one model, and the model learned from them.

    Attributes
    ----------
    registrations : n of ModelRegistration or None
        None where a scan could not be registered at all.
    good : (n,) bool
        Scans that have not failed; the model was learned from these.
    model : BodyModel
        The model of the last round.
    rounds : int
        Rounds that were done.
    converged : bool
        Whether the last round moved the mean vertex less than the tolerance.
    failed : tuple of int
        Scans that failed in every round.
    changes : tuple of float, metres
        How far the mean vertex moved in every round; NaN in the first.
    failures : dict of str to str
        By the name of a scan, why it could not be registered at all.

    Examples
    --------
    >>> done = Coregistration((), np.ones(3, dtype=bool), None, 2, True, (0, 0), (np.nan, 0.001))
    >>> int(done.good.sum()), done.converged
    (3, True)

    [BlendSCAPE]
    """

    registrations: tuple[ModelRegistration | None, ...]
    good: np.ndarray
    model: BodyModel
    rounds: int
    converged: bool
    failed: tuple[int, ...]
    changes: tuple[float, ...]
    failures: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class RegisterWithModel:
    """The task of registering one scan of a round; its fields are all that the result depends on."""

    model: BodyModel
    config: CoregistrationConfig

    @cached_property
    def person(self) -> Subject:
        """The template's own body, made once for all scans."""
        return self.model.subject()

    def __call__(self, one: OneScan, context: TaskContext) -> ModelRegistration:
        body = self.person if one.own or not self.model.n_betas else self.model
        return register_with_model(body, one.scan, one.landmarks, one.start, self.config)


@dataclass(frozen=True, eq=False)
class OneScan:
    """A scan and what is known of it before a round; `own` is True for scans of the template's person."""

    scan: Scan
    landmarks: Landmarks | None
    start: np.ndarray | None
    own: bool


@one_thread()
def coregister(model: BodyModel, scans: Sequence[Scan], landmarks: Sequence[Landmarks | None] | None = None,
               config: CoregistrationConfig | None = None, starts: Sequence[np.ndarray | None] | None = None,
               subjects: Sequence[str] | None = None, progress: Progress | None = None,
               names: Sequence[str] | None = None, space: Workspace | None = None) -> Coregistration:
    """Register every scan with the model as prior, learn the model again, and repeat until it converges.

    A scan that cannot be registered stops no other. With a `space` all results are kept, and an interrupted run
    resumes. A registration depends on the scan, its landmarks, its start and the model of its round. So after a change
    of one scan, the first round registers only that scan again. Later rounds register all, if the model was learned
    from it.

    Parameters
    ----------
    model : BodyModel
        A first model of the kind scape or blendscape, learned from any registrations at hand.
    scans : n of Mesh or (k, 3) float, metres
        The scans, or bare points.
    landmarks : n of ((L,) int, (L, 3) float, metres) or None, optional
        Vertices of the template and their places on each scan.
    config : CoregistrationConfig, optional
        Settings.
    starts : n of (N, 3) float, metres, or (J, 3) float, radians, or None, optional
        Earlier registrations, right or wrong, or poses.
    subjects : n of str, optional
        Whose scan each is. The subject with the most scans is the template's own person, from whom poses are learned.
        Shapes are learned from one scan of each other subject. Without labels all scans are of the template's person.
    progress : callable, optional
        Called as progress(done, total), counting registered scans of all rounds.
    names : n of str, all different, optional
        Names of the scans, for messages and kept results; numbers by default.
    space : Workspace, optional
        Where results are kept.

    Returns
    -------
    Coregistration
        Registrations of all scans, the model, and figures of the rounds.

    Raises
    ------
    ValueError
        Lists of different length, a model of another kind, or fewer than two good scans of the template's person.

    Examples
    --------
    Two bodies of the built-in model, registered once with the model that they are from:

    >>> from model import load_built_in_model
    >>> model = load_built_in_model()
    >>> try:
    ...     coregister(model, [model.template], names=["one", "two"])
    ... except ValueError as error:
    ...     print(error)
    names: expected 1, one a scan, got 2

    [BlendSCAPE]
    """
    config = config or CoregistrationConfig()
    n = len(scans)
    for name, values in (("landmarks", landmarks), ("starts", starts), ("subjects", subjects), ("names", names)):
        if values is not None and len(values) != n:
            raise ValueError(f"{name}: expected {n}, one a scan, got {len(values)}")
    if model.kind not in ("scape", "blendscape"):
        raise ValueError(f"model: expected one of the kind scape or blendscape, got {model.kind}")
    # what is not given: names are numbers, and there are no landmarks or starts
    labels = [f"scan {i}" for i in range(n)] if names is None else list(names)
    marks = list(landmarks) if landmarks is not None else [None for _ in scans]
    before: list[np.ndarray | None] = list(starts) if starts is not None else [None for _ in scans]
    own = _own(subjects, n)
    failed, changes = list[int](), list[float]()
    good, registrations, failures = np.zeros(n, dtype=bool), list[ModelRegistration | None](), dict[str, str]()
    with workspace_or_temporary(space) as kept:
        while len(changes) < config.rounds and not _has_settled(changes, model):
            # 1. register all scans with the model of this round
            turn, last = len(changes), registrations
            ready = [OneScan(scans[i], marks[i], before[i], bool(own[i])) for i in range(n)]
            registrations, failures = _register_round(kept, model, ready, labels, config, turn, progress)
            good = np.array([r is not None and r.explained >= 1 - config.failed for r in registrations], dtype=bool)
            # 2. learn the model again from the good registrations, which also start the next round
            lessons = _lessons(registrations, good, own, subjects, failures)
            failed.append(int((~good).sum()))
            changes.append(_mean_move(registrations, good, last))
            model = _taught(kept, model, lessons, config, turn)
            before = [start if r is None else r.mesh.vertices for r, start in zip(registrations, before, strict=True)]
    return Coregistration(tuple(registrations), good, model, len(changes), _has_settled(changes, model),
                          tuple(failed), tuple(changes), failures)


def task_name(turn: int, name: str) -> str:
    """Return the name of a scan's registration among the results of a workspace; rounds count from 0."""
    return f"round {turn + 1}/{name}"


@contextlib.contextmanager
def workspace_or_temporary(space: Workspace | None) -> Iterator[Workspace]:
    """Yield the workspace, or else a temporary one."""
    with contextlib.ExitStack() as stack:
        yield space or stack.enter_context(workspace(stack.enter_context(tempfile.TemporaryDirectory())))


def learn_again(model: BodyModel, poses: np.ndarray, shapes: np.ndarray | None, config: LearnConfig) -> BodyModel:
    """Learn a model of the same kind from poses (M, N, 3) of the template's person and other people (S, N, 3)."""
    bodies = np.concatenate([model.template.vertices[None], poses])
    learn = learn_blendscape if model.kind == "blendscape" else learn_scape
    learned: BodyModel = learn(model.template, bodies, shapes, model.skeleton, config)
    marks = {"landmarks": model.info["landmarks"]} if "landmarks" in model.info else {}
    return replace(learned, info={**learned.info, **marks})                                 # type: ignore[type-var]


def _own(subjects: Sequence[str] | None, n: int) -> np.ndarray:
    """Find the scans of the template's person, (n,) bool: those of the subject with the most scans."""
    if subjects is None or not n:
        return np.ones(n, dtype=bool)
    most = max(dict.fromkeys(subjects), key=list(subjects).count)
    return np.array([subject == most for subject in subjects])


def _register_round(space: Workspace, model: BodyModel, scans: Sequence[OneScan], names: Sequence[str],
                    config: CoregistrationConfig, turn: int, progress: Progress | None
                    ) -> tuple[list[ModelRegistration | None], dict[str, str]]:
    """Register all scans once; return registrations in the order of the scans, and failures by name."""
    def report_progress(done: int, total: int) -> None:
        if progress is not None:
            progress(turn * total + done, config.rounds * total)

    tasks = {name: Task(task_name(turn, name), scan) for name, scan in zip(names, scans, strict=True)}
    with one_thread():
        one = CoregistrationConfig(fit=config.fit, registration=config.registration)
        results = space.run(RegisterWithModel(model, one), list(tasks.values()), config.workers, report_progress)
    return ([results.values.get(task.name) for task in tasks.values()],
            {name: results.failures[task.name] for name, task in tasks.items() if task.name in results.failures})


def _taught(space: Workspace, model: BodyModel, lessons: Lessons, config: CoregistrationConfig, turn: int
            ) -> BodyModel:
    """Learn the model of a round, or take it from the workspace."""
    return space.step(f"model of round {turn + 1}", (model, lessons, config.learn),
                      lambda _: learn_again(model, *lessons, config.learn))


def _lessons(registrations: Sequence[ModelRegistration | None], good: np.ndarray, own: np.ndarray,
             subjects: Sequence[str] | None, failures: Mapping[str, str]) -> Lessons:
    """Collect what the model is learned from: good scans of the template's person, and one of every other subject."""
    vertices = {i: r.mesh.vertices for i, r in enumerate(registrations) if r is not None and good[i]}
    poses = [v for i, v in vertices.items() if own[i]]
    if len(poses) < 2:
        first = "".join(f"; {line}" for line in list(failures.values())[:1])
        raise ValueError(f"scans: only {len(poses)} of {int(own.sum())} of the template's person could be registered; "
                         f"at least 2 are needed to learn from{first}")
    # reversed, so that the first good scan of a subject is the one that stays
    others = {subjects[i]: i for i in np.flatnonzero(good & ~own)[::-1].tolist()} if subjects is not None else {}
    shapes = np.stack([vertices[i] for i in others.values()]) if len(others) > 1 else None
    return np.stack(poses), shapes


def _mean_move(registrations: Sequence[ModelRegistration | None], good: np.ndarray,
               before: Sequence[ModelRegistration | None]) -> float:
    """Compute how far the mean vertex of good scans moved since the round before, metres; NaN in the first round."""
    moved = [float(np.linalg.norm(r.mesh.vertices - b.mesh.vertices, axis=1).mean())
             for r, b, fine in zip(registrations, before, good, strict=False)
             if fine and r is not None and b is not None]
    return float(np.mean(moved)) if moved else np.nan


def _has_settled(changes: Sequence[float], model: BodyModel) -> bool:
    size = float(np.sqrt(model.template.face_areas.sum()))
    return bool(changes and changes[-1] <= SETTLED * size)


def coregistration_doubts(done: Coregistration, names: Sequence[str]) -> list[str]:
    """List the co-registered scans, by name, that do not fit the model and should be looked at."""
    return [f"{name} does not fit the model" for name, fits in zip(names, done.good, strict=True) if not fits]


def coregistration_problem(done: Coregistration, scans: Sequence[Scan]) -> str | None:
    """Explain why a co-registration is useless, with the likely cause; None where it is usable."""
    explained = float(np.mean([0.0 if r is None else r.explained for r in done.registrations]))
    # a model that explains less than half of the scans is not a model of them
    if done.good.any() and explained >= 0.5:
        return None
    spans = [extent(scan.vertices if isinstance(scan, Mesh) else scan) for scan in scans]
    cause = unit_problem(float(np.median(spans)), extent(done.model.template.vertices), "the scans are", 0.05)
    return (f"{int(done.good.sum())} of {len(done.good)} scans fit the model, which explains {100 * explained:.0f}% of "
            f"them; {cause or 'scans of something else, another model, or landmarks of other places?'}")
