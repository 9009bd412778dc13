"""A first model from scans alone: plain registration, a skeleton, and learning from what came out well."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from scanprep.batch.room import Room
from scanprep.batch.workspace import Task, Workspace
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.target import orient, target_of
from scanprep.ranges import Settings
from scanprep.registration.nonrigid import register
from scanprep.registration.schedule import RegistrationConfig
from scanprep.skeleton.find import find_skeleton
from scanprep.skeleton.parts import SkeletonConfig
from scanprep.skeleton.tree import Skeleton
from scanprep.threads import one_thread

from ..learning.scape import learn_scape
from ..scape import ScapeModel
from .attraction import apart
from .config import CoregistrationConfig
from .rounds import Coregistration, coregister, kept_or_not
from .single import Landmarks

Progress = Callable[[int, int], None]
DETAIL = 0.01                        # share of √area to which scans are thinned before it is asked what is explained


@dataclass(frozen=True)
class FirstConfig(Settings):
    """Settings of `learn_from_scans`.

    Attributes
    ----------
    registration : RegistrationConfig
        Of the template, without a model.
    skeleton : SkeletonConfig
    rounds : CoregistrationConfig
        Of the co-registration that follows.
    """

    registration: RegistrationConfig = field(default_factory=RegistrationConfig)
    skeleton: SkeletonConfig = field(default_factory=SkeletonConfig)
    rounds: CoregistrationConfig = field(default_factory=CoregistrationConfig)


@dataclass(frozen=True, eq=False)
class FirstModel:
    """A model from scans alone.

    Attributes
    ----------
    registered : (n, N, 3) float, metres
        The first registrations, without a model.
    explained : (n,) float
        Share of the points of each scan that its first registration explains.
    good : (n,) bool
        The first model was learned from these.
    model : ScapeModel
        The first model.
    coregistration : Coregistration
        What came of it.
    """

    registered: np.ndarray
    explained: np.ndarray
    good: np.ndarray
    model: ScapeModel
    coregistration: Coregistration


@dataclass(frozen=True, eq=False)
class PlainScan:
    """A scan and its landmarks."""

    scan: Mesh | np.ndarray
    landmarks: Landmarks | None


@dataclass(frozen=True, eq=False)
class RegisterPlainly:
    """The work on each scan before there is a model."""

    template: Mesh
    config: RegistrationConfig

    def __call__(self, given: PlainScan, room: Room) -> np.ndarray:
        return register(self.template, given.scan, given.landmarks, self.config).mesh.vertices


@one_thread()
def learn_from_scans(template: Mesh, scans: Sequence[Mesh | np.ndarray], landmarks: Sequence[Landmarks | None],
                     skeleton: Skeleton | None = None, config: FirstConfig | None = None,
                     progress: Progress | None = None, space: Workspace | None = None) -> FirstModel:
    """A body model from scans of one person in many poses, whose first registrations may fail for some.

    Parameters
    ----------
    template : Mesh
        Of the person.
    scans : n Meshes or (k, 3) float, metres
    landmarks : n pairs of (L,) int and (L, 3) float, metres, or None
    skeleton : Skeleton, optional
        Found from the first registrations that are good unless given.
    config : FirstConfig, optional
    progress : callable, optional
        Called as progress(done, total), with scans registered.
    space : Workspace, optional
        Where work is kept and found again, as by `coregister`.

    Raises
    ------
    ValueError
        Lists of different length, scans that cannot be used, too few good registrations to find a skeleton.
    """
    config = config or FirstConfig()
    if len(landmarks) != len(scans):
        raise ValueError(f"landmarks: expected {len(scans)}, one a scan, got {len(landmarks)}")
    n, tell = len(scans), progress or (lambda done, total: None)
    total = n * (1 + config.rounds.rounds)
    tasks = [Task(f"without a model/scan {i}", PlainScan(scan, marks))
             for i, (scan, marks) in enumerate(zip(scans, landmarks, strict=True))]
    with kept_or_not(space) as kept, one_thread():
        first = kept.run(RegisterPlainly(template, config.registration), tasks, config.rounds.workers,
                         lambda done, _: tell(done, total))
    if first.failures:
        raise ValueError(f"scans: {next(iter(first.failures.values()))}")
    registered = np.stack(list(first.values.values()))
    share = np.array([explained_share(template.with_vertices(v), scan, config.rounds)
                      for v, scan in zip(registered, scans, strict=True)])
    good = share >= 1 - config.rounds.failed
    bodies = np.concatenate([template.vertices[None], registered[good]])
    if len(bodies) < 3:
        raise ValueError(f"scans: {int(good.sum())} of {n} could be registered without a model; at least 2 are needed")
    tree = find_skeleton(template, bodies, config.skeleton) if skeleton is None else skeleton
    model = learn_scape(template, bodies, None, tree, config.rounds.learn)
    found = coregister(model, scans, landmarks, config.rounds, list(registered),
                       progress=lambda done, _: tell(n + done, total), space=space)
    return FirstModel(registered, share, good, model, found)


def explained_share(mesh: Mesh, scan: Mesh | np.ndarray, config: CoregistrationConfig) -> float:
    """Share of the points of a scan that lie near a registered mesh and do not face away from it."""
    size = float(np.sqrt(mesh.face_areas.sum()))
    limit = config.explained * size
    target = orient(target_of(scan).thinned(DETAIL * size), mesh, config.fit.normal_weight * size)
    return float((apart(mesh, target, limit) < limit).mean())
