"""Rounds of registering all scans with a model and learning the model again from what comes of it."""
from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.meaning import extent, unit_problem
from scanprep.skeleton.find import find_skeleton
from scanprep.skeleton.tree import Skeleton

from ..body import BodyModel
from ..learning.scape import BlendConfig, learn_blendscape, learn_scape
from ..linear import Subject
from .config import CoregistrationConfig
from .single import Landmarks, ModelRegistration, register_with_model

Progress = Callable[[int, int], None]
Scan = Mesh | np.ndarray
LOST = 0.5                           # mean share of the scans explained below which they mean nothing


@dataclass(frozen=True)
class Round:
    """What one round brought.

    Attributes
    ----------
    failed : int
        Scans that the template does not explain.
    explained : float
        Mean share of the points of a scan that it explains.
    apart : float, metres
        Median over the scans of the root mean square distance from mesh to model.
    change : float, metres
        How far the mean vertex of the scans that have not failed moved since the round before; NaN in the first.
    """

    failed: int
    explained: float
    apart: float
    change: float


@dataclass(frozen=True, eq=False)
class Coregistration:
    """All scans registered with one model, and the model learned from them.

    Attributes
    ----------
    registrations : ModelRegistration of every scan
    good : (n,) bool
        Scans that have not failed; the model was learned from these.
    model : BodyModel
    rounds : int
    converged : bool
    history : tuple of Round
    """

    registrations: tuple[ModelRegistration, ...]
    good: np.ndarray
    model: BodyModel
    rounds: int
    converged: bool
    history: tuple[Round, ...]


class Store(Protocol):
    """Where the work of every round is kept, so that it can go on when it was interrupted."""

    def found(self, turn: int, scan: int) -> ModelRegistration | None:
        """What is kept of a scan in a round."""
        ...

    def keep(self, turn: int, scan: int, registration: ModelRegistration) -> None: ...

    def model(self, turn: int) -> BodyModel | None:
        """What was learned in a round."""
        ...

    def keep_model(self, turn: int, model: BodyModel) -> None: ...


def coregister(model: BodyModel, scans: Sequence[Scan], landmarks: Sequence[Landmarks | None] | None = None,
               config: CoregistrationConfig | None = None, starts: Sequence[np.ndarray | None] | None = None,
               subjects: Sequence[str] | None = None, progress: Progress | None = None, store: Store | None = None
               ) -> Coregistration:
    """Register every scan with the model as prior, learn the model again from that, until it settles.

    Parameters
    ----------
    model : BodyModel
        A first model, learned from whatever registrations there are.
    scans : n Meshes or (k, 3) float, metres
    landmarks : n pairs of (L,) int and (L, 3) float, metres, or None, optional
    config : CoregistrationConfig, optional
    starts : n of (N, 3) float, metres, or (J, 3) float, radians, or None, optional
        Earlier registrations, right or wrong, or poses.
    subjects : n labels, optional
        Whose scan each is. The one with the most is the template's own person, who teaches the poses; one scan of
        each of the others teaches the shapes. Without labels all scans are of the template's person.
    progress : callable, optional
        Called as progress(done, total), with scans registered of all rounds.
    store : Store, optional
        Where work is kept and found again.

    Raises
    ------
    ValueError
        Lists of different length, a model that cannot be learned again, scans that cannot be used; fewer than two
        scans of the template's person that have not failed.

    [BlendSCAPE]
    """
    config = config or CoregistrationConfig()
    n = len(scans)
    for name, given in (("landmarks", landmarks), ("starts", starts), ("subjects", subjects)):
        if given is not None and len(given) != n:
            raise ValueError(f"{name}: expected {n}, one a scan, got {len(given)}")
    if model.kind not in ("scape", "blendscape"):
        raise ValueError(f"model: expected one of the kind scape or blendscape, got {model.kind}")
    marks = list(landmarks) if landmarks is not None else [None for _ in scans]
    before: Sequence[np.ndarray | None] = list(starts) if starts is not None else [None for _ in scans]
    own = _own(subjects, n)
    history: list[Round] = []
    good, registrations = np.zeros(n, dtype=bool), list[ModelRegistration]()
    while len(history) < config.rounds and not _settled(history, model, config):
        turn, last = len(history), registrations
        registrations = _register_all(model, scans, marks, before, own, config, turn, store, progress)
        good = np.array([r.explained >= 1 - config.failed for r in registrations])
        history.append(_summary(registrations, good, last))
        model = _taught(model, registrations, good, own, subjects, config, turn, store)
        before = [r.mesh.vertices for r in registrations]
    return Coregistration(tuple(registrations), good, model, len(history), _settled(history, model, config),
                          tuple(history))


def learn_again(model: BodyModel, poses: np.ndarray, shapes: np.ndarray | None, config: CoregistrationConfig
                ) -> BodyModel:
    """A model of the same kind from registered poses (M, N, 3) of the template's person and others (S, N, 3)."""
    template = model.template
    skeleton: Skeleton = model.skeleton if config.skeleton is None \
        else find_skeleton(template, poses, config.skeleton)
    bodies = np.concatenate([template.vertices[None], poses])
    if model.kind == "blendscape":
        blend = config.learn if isinstance(config.learn, BlendConfig) else BlendConfig(**vars(config.learn))
        learned: BodyModel = learn_blendscape(template, bodies, shapes, skeleton, blend)
    else:
        learned = learn_scape(template, bodies, shapes, skeleton, config.learn)
    marks = {"landmarks": model.info["landmarks"]} if "landmarks" in model.info else {}
    return replace(learned, info={**learned.info, **marks})                                 # type: ignore[type-var]


def _own(subjects: Sequence[str] | None, n: int) -> np.ndarray:
    """(n,) bool: scans of the template's person."""
    if subjects is None or not n:
        return np.ones(n, dtype=bool)
    most = max(dict.fromkeys(subjects), key=list(subjects).count)
    return np.array([subject == most for subject in subjects])


def _register_all(model: BodyModel, scans: Sequence[Scan], marks: Sequence[Landmarks | None],
                  starts: Sequence[np.ndarray | None], own: np.ndarray, config: CoregistrationConfig, turn: int,
                  store: Store | None, progress: Progress | None) -> list[ModelRegistration]:
    """One round of registrations, in the order of the scans."""
    out = {i: store.found(turn, i) if store else None for i in range(len(scans))}
    missing = [i for i, found in out.items() if found is None]
    tell = progress or (lambda done, total: None)
    done, total = (turn + 1) * len(scans) - len(missing), config.rounds * len(scans)
    tell(done, total)
    person: BodyModel | Subject = model.subject() if missing else model
    jobs = [(i, person if own[i] or not model.n_betas else model, scans[i], marks[i], starts[i], config)
            for i in missing]
    for i, found in _in_parallel(jobs, config.workers):
        out[i] = found
        if store:
            store.keep(turn, i, found)
        done += 1
        tell(done, total)
    return [found for found in out.values() if found is not None]


def _in_parallel(jobs: Sequence[tuple[int, BodyModel | Subject, Scan, Landmarks | None, np.ndarray | None,
                                      CoregistrationConfig]], workers: int) -> Iterator[tuple[int, ModelRegistration]]:
    from joblib import Parallel, delayed, parallel_config

    workers = min(workers or os.cpu_count() or 1, max(len(jobs), 1))
    if workers == 1:
        yield from (_numbered(*job) for job in jobs)
        return
    # one thread for linear algebra in each process, so that they do not take each other's cores
    with parallel_config("loky", n_jobs=workers, inner_max_num_threads=1):
        yield from Parallel(return_as="generator_unordered", batch_size=1)(delayed(_numbered)(*job) for job in jobs)


def _numbered(i: int, body: BodyModel | Subject, scan: Scan, marks: Landmarks | None, start: np.ndarray | None,
              config: CoregistrationConfig) -> tuple[int, ModelRegistration]:
    return i, register_with_model(body, scan, marks, start, config)


def _taught(model: BodyModel, registrations: Sequence[ModelRegistration], good: np.ndarray, own: np.ndarray,
            subjects: Sequence[str] | None, config: CoregistrationConfig, turn: int, store: Store | None) -> BodyModel:
    """The model of a round, from its registrations that have not failed."""
    kept = store.model(turn) if store else None
    if kept is not None:
        return kept
    poses = [registrations[i].mesh.vertices for i in np.flatnonzero(good & own).tolist()]
    if len(poses) < 2:
        raise ValueError(f"scans: only {len(poses)} of {int(own.sum())} of the template's person could be registered; "
                         "at least 2 are needed to learn from")
    others = {subjects[i]: i for i in np.flatnonzero(good & ~own)[::-1].tolist()} if subjects is not None else {}
    shapes = np.stack([registrations[i].mesh.vertices for i in others.values()]) if len(others) > 1 else None
    learned = learn_again(model, np.stack(poses), shapes, config)
    if store:
        store.keep_model(turn, learned)
    return learned


def _summary(registrations: Sequence[ModelRegistration], good: np.ndarray, before: Sequence[ModelRegistration]
             ) -> Round:
    moved = [float(np.linalg.norm(registrations[i].mesh.vertices - before[i].mesh.vertices, axis=1).mean())
             for i in np.flatnonzero(good).tolist()] if before else []
    return Round(int((~good).sum()), float(np.mean([r.explained for r in registrations])),
                 float(np.median([r.apart for r in registrations])), float(np.mean(moved)) if moved else np.nan)


def _settled(history: Sequence[Round], model: BodyModel, config: CoregistrationConfig) -> bool:
    size = float(np.sqrt(model.template.face_areas.sum()))
    return bool(history and history[-1].change <= config.tolerance * size)


def coregistration_problem(done: Coregistration, scans: Sequence[Scan]) -> str | None:
    """Why co-registered scans mean nothing, with the likely cause; None where they mean something."""
    explained = float(np.mean([r.explained for r in done.registrations]))
    if done.good.any() and explained >= LOST:
        return None
    spans = [extent(scan.vertices if isinstance(scan, Mesh) else scan) for scan in scans]
    cause = unit_problem(float(np.median(spans)), extent(done.model.template.vertices), "the scans are", 0.05)
    return (f"{int(done.good.sum())} of {len(done.good)} scans fit the model, which explains {100 * explained:.0f}% of "
            f"them; {cause or 'scans of something else, another model, or landmarks of other places?'}")
