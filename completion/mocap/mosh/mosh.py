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
from scanprep.batch.room import Step, run_uncached, substeps
from scanprep.ranges import Settings
from scanprep.threads import one_thread

from ...motion import Motion, Progress
from ..artefacts.find import find_artefacts, no_artefacts, relabel_by_tracks
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
    def from_weights(cls, data: float, pose: float, velocity: float, outlier: float = 0.06) -> PoseConfig:
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
    poses: PoseConfig = field(default_factory=lambda: PoseConfig.from_weights(2.0, 0.3, 57600.0))
    soft: SoftTissueConfig = field(default_factory=SoftTissueConfig)
    artefacts: ArtefactConfig = field(default_factory=ArtefactConfig)
    soft_tissue: bool = True
    repair: bool = True
    exaggeration: float = 1.0

    @classmethod
    def from_paper(cls) -> MoshConfig:
        """The weights of [MoSh], every marker believed alike, nothing repaired, shrunk or smoothed beyond them.

        Not as in the paper: covariances of poses have at least (0.05 radians)² along every direction. The first frame
        is found by a search, then all frames are solved together, by Gauss-Newton. The weight of the velocity is meant
        for 120 frames a second, and scaled for others.
        """
        poses = replace(PoseConfig.from_weights(0.75, 1.0, 6.25, outlier=1000.0), place_acceleration=1e6,
                        prior_shrinkage=0.0)
        return cls(PersonConfig.from_paper(), poses, SoftTissueConfig.from_paper(), repair=False)


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
         config: MoshConfig | None = None, progress: Progress | None = None, step: Step = run_uncached) -> MoshResult:
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
        Keeps what each stage finds, as `TaskContext.step` does.

    Raises
    ------
    ValueError
        A model without betas, no sequence, fewer than 3 markers in common, no frame with 3 of them, a layout of
        another body.

    [MoSh] Eq. 23, Eq. 24
    """
    config = config or MoshConfig()
    trials = [_Trial(i, each, each) for i, each in enumerate(one_or_more(sequences))]
    stages = _Stages(model, config, step, progress, STEPS * (1 + len(trials) * (2 + config.soft_tissue)))

    # shape and marker places from some frames, with labels as far as tracks tell; then what is worn elsewhere
    for trial in trials:
        stages.relabel(trial)
    person = stages.find_person(trials, layout)                                 # [MoSh] Eq. 23, shape and markers
    worn = stages.find_worn(trials, layout, person)
    if worn.changes:
        for trial in trials:
            trial.order = worn.order(trial.raw, layout)
            trial.raw, trial.markers = worn.restore_names(trial.raw, layout), worn.restore_names(trial.markers, layout)
        layout = worn.update_layout(layout)
        person = stages.find_person(trials, layout, "worn")

    # the poses of all frames, by which the markers are judged; where a frame of the person changed, it is found again
    for n in range(3):
        for trial in trials:
            stages.follow(trial, person, f"poses {n} {trial.number}")           # [MoSh] Eq. 23, poses
        for trial in trials:
            stages.judge(trial, person, f"artefacts {n} {trial.number}")
        settled = all(trials[i].is_unchanged(t) for i, t in person.fit.frames)
        if settled:
            break
        person = stages.find_person(trials, layout, f"again {n}")
    for trial in trials:
        if not (settled and trial.is_unchanged()):
            stages.follow(trial, person, f"poses last {trial.number}")
        if config.soft_tissue:
            stages.find_soft_tissue(trial, person)                              # [MoSh] Eq. 24
    every = [trial.result() for trial in trials]
    return MoshResult(person.fit.betas, person.fit.layout, person.fit, tuple(motion for motion, _, _ in every),
                      tuple(soft for _, soft, _ in every if soft is not None), tuple(found for *_, found in every),
                      worn, stages.seconds)


@dataclass(eq=False)
class _Trial:
    """A recording on its way through the stages: the markers as they came, as repaired by now, and what was found."""

    number: int
    raw: MarkerSequence                  # with names put back that were exchanged throughout
    markers: MarkerSequence
    followed: MarkerSequence | None = None       # the markers that `motion` follows
    order: np.ndarray | None = None      # (L,) from which column of the recording `raw` takes each label
    motion: Motion | None = None
    artefacts: MarkerArtefacts | None = None
    soft: SoftTissue | None = None

    def is_unchanged(self, frames: int | slice = slice(None)) -> bool:
        """Whether the markers of some frames are those that the motion follows."""
        assert self.followed is not None, "followed"
        return np.array_equal(self.followed.positions[frames], self.markers.positions[frames], equal_nan=True)

    def result(self) -> tuple[Motion, SoftTissue | None, MarkerArtefacts]:
        """What was found, artefacts by the labels of the recording as it came."""
        assert self.motion is not None and self.artefacts is not None, "followed and judged"
        if self.order is None:
            return self.motion, self.soft, self.artefacts
        return self.motion, self.soft, self.artefacts.rename_labels(self.order,
                                                                    self.raw.seen[:, np.argsort(self.order)])


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

    model: BodyModel
    config: MoshConfig
    step: Step
    progress: Progress | None
    total: int
    done: int = 0
    seconds: dict[str, np.ndarray] = field(default_factory=dict)

    def run(self, stage: str, name: str, inputs: Any, make: Callable[[Progress | None], T], bar: bool = False) -> T:
        """What `make` finds, or found in an earlier run; it moves the bar, if it has a share in it."""
        before, self.done = self.done, self.done + STEPS * bar

        def tell(done: int, total: int) -> None:
            if self.progress:
                self.progress(before + round(STEPS * done / max(total, 1)), self.total)

        def timed() -> tuple[T, np.ndarray]:
            start = clocks()
            return make(tell if bar else None), clocks() - start

        value, seconds = self.step(name, inputs, timed)
        self.seconds[stage] = self.seconds.get(stage, 0) + seconds
        return value

    def relabel(self, trial: _Trial) -> None:
        """Labels put right as far as tracks tell."""
        if self.config.repair:
            trial.markers = self.run("artefacts", f"tracks {trial.number}", trial.raw,
                                     lambda _: relabel_by_tracks(trial.raw))

    def find_person(self, trials: Sequence[_Trial], layout: MarkerLayout, again: str = "") -> _Person:
        """Shape and marker places; `again` names it where it was found before, of other markers."""
        used, config, step = [trial.markers for trial in trials], self.config.person, self.step
        step = substeps(step, again) if again else step
        return _Person(self.model, self.run(
            "person", f"{again} person".strip(), (self.model, used, layout, config),
            lambda tell: find_person(self.model, used, layout, config, tell, step), not again))

    def find_worn(self, trials: Sequence[_Trial], layout: MarkerLayout, person: _Person) -> Worn:
        """Which markers are not worn as the layout says."""
        given = self.model, [trial.markers for trial in trials], layout, person.fit, self.config.person
        return self.run("person", "worn", given, lambda _: find_worn(*given)) if self.config.repair else Worn()

    def follow(self, trial: _Trial, person: _Person, name: str) -> None:
        """The motion of a person of fixed shape, near that of one who was thought to be a little different."""
        fit, poses, markers, near = person.fit, self.config.poses, trial.markers, trial.motion
        trial.motion = self.run("poses", name, (self.model, fit.betas, fit.layout, markers, poses, near),
                                lambda tell: animate(person.subject, markers, fit.layout, poses, tell, near),
                                near is None)
        trial.followed = markers

    def judge(self, trial: _Trial, person: _Person, name: str) -> None:
        """What is wrong with the markers, by the body that carries them and by what the person before has told."""
        fit, markers, motion, known = person.fit, trial.raw, trial.motion, trial.artefacts
        assert motion is not None, "followed"
        if not self.config.repair:
            trial.artefacts = no_artefacts(person.subject, markers, fit.layout, motion)
            return
        bad = self.config.artefacts
        trial.artefacts = self.run(
            "artefacts", name, (self.model, fit.betas, fit.layout, markers, motion, bad, known),
            lambda tell: find_artefacts(person.subject, markers, fit.layout, bad, motion, tell, known), known is None)
        trial.markers = trial.artefacts.repaired

    def find_soft_tissue(self, trial: _Trial, person: _Person) -> None:
        """How the skin, or the shape, moves."""
        model, layout, markers, motion = self.model, person.fit.layout, trial.markers, trial.motion
        soft, ground, floor = self.config.soft, self.config.poses.ground, self.config.poses.floor
        assert motion is not None, "followed"
        trial.soft = self.run(
            "soft tissue", f"soft tissue {trial.number}", (model, layout, markers, motion, soft, ground, floor),
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
                step: Step = run_uncached) -> SexedMosh:
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
    check_models(models)
    config = config or MoshConfig()
    neutral = find_person(models["neutral"], sequences, layout, config.person, None, substeps(step, "neutral"))
    guess = guess_sex(models["neutral"], neutral.betas)
    result = mosh(models[guess.sex], sequences, layout, config, progress, step)
    motions = tuple(replace(motion, gender=guess.sex) for motion in result.motions)
    soft = tuple(replace(one, motion=replace(one.motion, gender=guess.sex)) for one in result.soft_tissue)
    return SexedMosh(guess, models[guess.sex], neutral, replace(result, motions=motions, soft_tissue=soft))


def check_models(models: Mapping[str, BodyModel]) -> None:
    """ValueError for models with which a sex cannot be told or used."""
    missing = [name for name in ("neutral", "female", "male") if name not in models]
    if missing:
        raise ValueError(f"models: expected 'neutral', 'female' and 'male', {' and '.join(missing)} missing")
    sex_plane(models["neutral"])
    faces = models["neutral"].template.faces
    for name in ("female", "male"):
        if models[name].template.faces.shape != faces.shape or (models[name].template.faces != faces).any():
            raise ValueError(f"models: expected the triangles of the neutral model in that of '{name}', found others")
