"""From marker files of one subject to a moving body: all stages of [MoSh] one after the other; by sex, if wanted."""
from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeVar

import numpy as np

from model.body import BodyModel
from model.learning.sexes import SexGuess, guess_sex, sex_plane
from model.linear import Subject
from scanprep.batch.room import Step, inside, once
from scanprep.ranges import Settings
from scanprep.threads import one_thread

from ...motion import Motion, Progress
from ..artefacts.find import find_artefacts, no_artefacts, relabelled_by_tracks
from ..artefacts.results import ArtefactConfig, MarkerArtefacts
from ..files.markers import MarkerSequence
from ..marker_sets.layout import MarkerLayout
from ..pose.follow import animate
from ..pose.marked_body import RATE, AnimateConfig
from ..soft_tissue.follow import SoftTissueConfig, follow_soft_tissue
from ..soft_tissue.soft_tissue import SoftTissue
from ..subject.person import PersonConfig, PersonFit, find_person, one_or_more
from ..subject.worn_elsewhere import Worn, find_worn

T = TypeVar("T")
STEPS = 100                          # of progress, of each stage


@dataclass(frozen=True)
class PoseConfig(AnimateConfig):
    """Settings of the poses of a person whose shape and marker places are known: as of `animate`."""

    @classmethod
    def weighted(cls, data: float, pose: float, velocity: float, outlier: float = 0.06) -> PoseConfig:
        """Settings of weights on squared centimetres, on the pose prior, and on squared radians.

        A weight is the inverse of a squared deviation. That of the velocity's change from frame to frame is meant for
        120 frames per second; at another rate the acceleration that it allows is the same.

        [MoSh] Eq. 17, Eq. 21, Eq. 22
        """
        return cls(marker_sd=0.01 * data**-0.5, prior_weight=pose, angle_acceleration=RATE**2 * velocity**-0.5,
                   outlier=outlier)


@dataclass(frozen=True)
class MoshConfig(Settings):
    """Settings of `mosh`.

    Attributes
    ----------
    person : PersonConfig
        Shape and marker places, from some frames.
    poses : PoseConfig
        Poses of all frames of a person whose shape and marker places are known. Markers are held closer than by
        `animate`, whose layout may be off. In weights of the paper they are 2, the prior 0.3 and the change of
        velocity 57600 instead of 0.75, 1 and 6.25: the prior of a few dozen scans is narrow and must not outweigh
        markers, and joints accelerate by 60 radians per second squared, not by 5760.
    soft : SoftTissueConfig
        How the skin, or the shape, moves with time.
    artefacts : ArtefactConfig
        What counts as wrong with the markers.
    soft_tissue : bool
        Let the skin move on the body.
    repair : bool
        Put swapped labels right, seek markers that are worn elsewhere than in the layout, and leave out markers that
        slip, jitter or stray.
    exaggeration : float
        Factor on soft tissue in exaggerated.glb and on a character; 0 leaves it out there.
    """

    person: PersonConfig = field(default_factory=PersonConfig)
    poses: PoseConfig = field(default_factory=lambda: PoseConfig.weighted(2.0, 0.3, 57600.0))
    soft: SoftTissueConfig = field(default_factory=SoftTissueConfig)
    artefacts: ArtefactConfig = field(default_factory=ArtefactConfig)
    soft_tissue: bool = True
    repair: bool = True
    exaggeration: float = 1.0

    @classmethod
    def published(cls) -> MoshConfig:
        """The weights of [MoSh], every marker believed alike, nothing repaired, shrunk or smoothed beyond them.

        Not as in the paper: covariances of poses have at least (0.05 radians)² along every direction. The first frame
        is found by a search, then all frames are solved together, by Gauss-Newton. The weight of the velocity is meant
        for 120 frames a second, and scaled for others.
        """
        poses = replace(PoseConfig.weighted(0.75, 1.0, 6.25, outlier=1000.0), place_acceleration=1e6,
                        prior_shrinkage=0.0)
        return cls(PersonConfig.published(), poses, SoftTissueConfig.published(), repair=False)


@dataclass(frozen=True, eq=False)
class MoshResult:
    """People and motions from markers alone.

    Attributes
    ----------
    betas : (k,) float
    layout : MarkerLayout
        Where the markers really sat.
    person : PersonFit
        How they were found.
    motions : one Motion for each sequence
        With the shape fixed; residuals in the order of the sequence's labels, NaN where the layout does not know one.
    soft_tissue : one SoftTissue for each sequence, or none
    artefacts : one MarkerArtefacts for each sequence
    worn : Worn
        Markers that are worn elsewhere than in the layout, and pairs that bear each other's name.
    seconds : {str: (2,) float}
        How long each stage took, by the clock and of the processor: "person", "poses", "artefacts", "soft tissue".
    """

    betas: np.ndarray
    layout: MarkerLayout
    person: PersonFit
    motions: tuple[Motion, ...]
    soft_tissue: tuple[SoftTissue, ...]
    artefacts: tuple[MarkerArtefacts, ...]
    worn: Worn = field(default_factory=Worn)
    seconds: dict[str, np.ndarray] = field(default_factory=dict)


@one_thread()
def mosh(model: BodyModel, sequences: MarkerSequence | Sequence[MarkerSequence], layout: MarkerLayout,
         config: MoshConfig | None = None, progress: Progress | None = None, step: Step = once) -> MoshResult:
    """Body shape, marker places, poses and soft tissue of one subject from marker sequences.

    Labels are put right as far as tracks tell. The person is found from a few frames of all sequences; markers that are
    far from where the layout has them are sought over the whole body. Then the pose of every frame is found. The motion
    tells which labels were swapped and which markers were not on the body; where that concerns the frames that told of
    the person, the person is found again, and so is what is wrong. At last the skin may move.

    Parameters
    ----------
    model : BodyModel
    sequences : MarkerSequence, or several of one subject
    layout : MarkerLayout
        Where markers usually sit on the model's template. Markers that only one of the two knows are left out.
    config : MoshConfig, optional
    progress : callable, optional
        Called with (done, total).
    step : callable, optional
        Keeps what each stage finds, as `Room.step` does.

    Raises
    ------
    ValueError
        A model without betas, no sequence, fewer than 3 markers in common, no frame with 3 of them, a layout of
        another body.

    [MoSh] Eq. 23, Eq. 24
    """
    config, sequences = config or MoshConfig(), one_or_more(sequences)
    stages = _Stages(step, progress, STEPS * (1 + len(sequences) * (2 + config.soft_tissue)))
    used = [_relabelled(stages, i, each, config) for i, each in enumerate(sequences)]
    person = _person(stages, model, used, layout, config)                       # [MoSh] Eq. 23, shape and markers
    worn = _worn(stages, person, used, layout, config)
    orders, seen = [worn.order(each, layout) for each in sequences], [each.seen for each in sequences]
    if worn.changes:
        sequences, used = ([worn.named(each, layout) for each in some] for some in (sequences, used))
        layout = worn.placed(layout)
        person = _person(stages, model, used, layout, config, "worn")
    none, motions, artefacts = (None,) * len(used), list[Motion](), list[MarkerArtefacts]()
    for n in range(3):  # most times that a person is followed and the markers are judged
        motions = [_motion(stages, f"poses {n} {i}", person, each, config, near)    # [MoSh] Eq. 23, poses
                   for i, (each, near) in enumerate(zip(used, motions or none, strict=True))]
        artefacts = [_artefacts(stages, f"artefacts {n} {i}", person, each, motion, config, known) for i, (
            each, motion, known) in enumerate(zip(sequences, motions, artefacts or none, strict=True))]
        before, used = used, [each.repaired for each in artefacts]
        settled = all(_same(before[i], used[i], t) for i, t in person.fit.frames)
        if settled:
            break
        person = _person(stages, model, used, layout, config, f"again {n}")
    motions = [motion if settled and _same(old, new) else _motion(
        stages, f"poses last {i}", person, new, config, motion)
               for i, (motion, old, new) in enumerate(zip(motions, before, used, strict=True))]
    soft = [_soft_tissue(stages, i, person, each, motion, config)               # [MoSh] Eq. 24
            for i, (each, motion) in enumerate(zip(used, motions, strict=True)) if config.soft_tissue]
    told = tuple(each.renamed(*names) for each, *names in zip(artefacts, orders, seen, strict=True))
    return MoshResult(person.fit.betas, person.fit.layout, person.fit, tuple(motions), tuple(soft), told, worn,
                      stages.seconds)


def _same(first: MarkerSequence, second: MarkerSequence, frames: int | slice = slice(None)) -> bool:
    """Whether two sequences hold the same markers in the same places, in some frames."""
    return np.array_equal(first.positions[frames], second.positions[frames], equal_nan=True)


@dataclass(frozen=True, eq=False)
class _Person:
    """A person, and the body, which is made when a stage needs it."""

    model: BodyModel
    fit: PersonFit

    @cached_property
    def subject(self) -> Subject:
        return self.model.subject(self.fit.betas)


def clocks() -> np.ndarray:
    """(2,) seconds, of which differences count: by the clock, and of the processor for this process."""
    return np.array([time.perf_counter(), time.process_time()])


@dataclass
class _Stages:
    """What runs the stages of a call: each is kept by what it depends on, its seconds count, the bar moves."""

    step: Step
    progress: Progress | None
    total: int
    done: int = 0
    seconds: dict[str, np.ndarray] = field(default_factory=dict)

    def run(self, stage: str, name: str, inputs: Any, make: Callable[[Progress | None], T], told: bool = False) -> T:
        """What `make` finds, or found in an earlier run; it moves the bar if it is told."""
        before, self.done = self.done, self.done + STEPS * told

        def tell(done: int, total: int) -> None:
            if self.progress:
                self.progress(before + round(STEPS * done / max(total, 1)), self.total)

        def timed() -> tuple[T, np.ndarray]:
            start = clocks()
            return make(tell if told else None), clocks() - start

        value, seconds = self.step(name, inputs, timed)
        self.seconds[stage] = self.seconds.get(stage, 0) + seconds
        return value


def _relabelled(stages: _Stages, i: int, markers: MarkerSequence, config: MoshConfig) -> MarkerSequence:
    """A sequence with labels put right as far as tracks tell."""
    if not config.repair:
        return markers
    return stages.run("artefacts", f"tracks {i}", markers, lambda _: relabelled_by_tracks(markers))


def _person(stages: _Stages, model: BodyModel, sequences: Sequence[MarkerSequence], layout: MarkerLayout,
            config: MoshConfig, again: str = "") -> _Person:
    """Shape and marker places; `again` names it where it was found before, of other markers."""
    step = inside(stages.step, again) if again else stages.step
    return _Person(model, stages.run(
        "person", f"{again} person".strip(), (model, sequences, layout, config.person),
        lambda tell: find_person(model, sequences, layout, config.person, tell, step), not again))


def _worn(stages: _Stages, person: _Person, sequences: Sequence[MarkerSequence], layout: MarkerLayout,
          config: MoshConfig) -> Worn:
    """Which markers are not worn as the layout says."""
    if not config.repair:
        return Worn()
    model = person.model
    return stages.run("person", "worn", (model, sequences, layout, person.fit, config.person), lambda _: find_worn(
        model, sequences, layout, person.fit, config.person))


def _motion(stages: _Stages, name: str, person: _Person, markers: MarkerSequence, config: MoshConfig,
            near: Motion | None) -> Motion:
    """The motion of a person of fixed shape; `near` is that of a person who was thought to be a little different."""
    fit, poses = person.fit, config.poses
    return stages.run("poses", name, (person.model, fit.betas, fit.layout, markers, poses, near),
                      lambda tell: animate(person.subject, markers, fit.layout, poses, tell, near), near is None)


def _artefacts(stages: _Stages, name: str, person: _Person, markers: MarkerSequence, motion: Motion,
               config: MoshConfig, known: MarkerArtefacts | None) -> MarkerArtefacts:
    """What is wrong with the markers, by the body that carries them; `known` is what the person before has told."""
    fit, judge = person.fit, config.artefacts
    if not config.repair:
        return no_artefacts(person.subject, markers, fit.layout, motion)
    return stages.run("artefacts", name, (person.model, fit.betas, fit.layout, markers, motion, judge, known),
                      lambda tell: find_artefacts(person.subject, markers, fit.layout, judge, motion, tell, known),
                      known is None)


def _soft_tissue(stages: _Stages, i: int, person: _Person, markers: MarkerSequence, motion: Motion, config: MoshConfig
                 ) -> SoftTissue:
    """The motion with a shape that changes."""
    model, layout, soft = person.model, person.fit.layout, config.soft
    ground, floor = config.poses.ground, config.poses.floor
    return stages.run("soft tissue", f"soft tissue {i}", (model, layout, markers, motion, soft, ground, floor),
                      lambda tell: follow_soft_tissue(model, motion, markers, layout, soft, tell, ground, floor), True)


@dataclass(frozen=True, eq=False)
class SexedMosh:
    """A person and their motions with the model of their sex.

    Attributes
    ----------
    guess : SexGuess
        What the markers told.
    model : BodyModel
        The model of that sex.
    neutral : PersonFit
        The person with the neutral model, by which it was told.
    result : MoshResult
        With the model of that sex; the motions say it as their gender.
    """

    guess: SexGuess
    model: BodyModel
    neutral: PersonFit
    result: MoshResult


@one_thread()
def mosh_by_sex(models: Mapping[str, BodyModel], sequences: MarkerSequence | Sequence[MarkerSequence],
                layout: MarkerLayout, config: MoshConfig | None = None, progress: Progress | None = None,
                step: Step = once) -> SexedMosh:
    """As `mosh`, with the model of the person's sex.

    The neutral model finds a body, its betas tell the sex, and all is done with the model of that sex.

    Parameters
    ----------
    models : {"neutral", "female", "male": BodyModel}
        As `learn_by_sex` makes them, of one topology; the neutral one keeps what tells women from men.
    sequences, layout, config, progress, step
        As for `mosh`.

    Raises
    ------
    ValueError
        A model that is missing or of another topology, a neutral one that cannot tell, and as `mosh`.

    [MoSh]
    """
    checked_models(models)
    config = config or MoshConfig()
    neutral = find_person(models["neutral"], sequences, layout, config.person, None, inside(step, "neutral"))
    guess = guess_sex(models["neutral"], neutral.betas)
    result = mosh(models[guess.sex], sequences, layout, config, progress, step)
    motions = tuple(replace(motion, gender=guess.sex) for motion in result.motions)
    soft = tuple(replace(one, motion=replace(one.motion, gender=guess.sex)) for one in result.soft_tissue)
    return SexedMosh(guess, models[guess.sex], neutral, replace(result, motions=motions, soft_tissue=soft))


def checked_models(models: Mapping[str, BodyModel]) -> None:
    """ValueError for models with which a sex cannot be told or used."""
    missing = [name for name in ("neutral", "female", "male") if name not in models]
    if missing:
        raise ValueError(f"models: expected 'neutral', 'female' and 'male', {' and '.join(missing)} missing")
    sex_plane(models["neutral"])
    faces = models["neutral"].template.faces
    for name in ("female", "male"):
        if models[name].template.faces.shape != faces.shape or (models[name].template.faces != faces).any():
            raise ValueError(f"models: expected the triangles of the neutral model in that of '{name}', found others")
