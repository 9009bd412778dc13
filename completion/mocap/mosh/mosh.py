"""From marker files of one subject to a moving body: all stages of [MoSh] one after the other."""
from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np

from model.body import BodyModel
from model.linear import Subject
from scanprep.batch.room import Step, inside, once
from scanprep.ranges import Settings
from scanprep.threads import one_thread

from ...motion import Motion
from ..artefacts.find import find_artefacts, no_artefacts, relabelled_by_tracks
from ..artefacts.results import ArtefactConfig, MarkerArtefacts
from ..files.markers import MarkerSequence
from ..marker_sets.layout import MarkerLayout
from ..pose.follow import animate
from ..pose.settings import RATE, AnimateConfig
from ..soft_tissue.soft_tissue import SoftTissue, SoftTissueConfig, follow_soft_tissue
from ..subject.person import PersonConfig, PersonFit, find_person, one_or_more

Progress = Callable[[int, int], None]
T = TypeVar("T")
ROUNDS = 3                           # most times that a person is followed and the markers are judged
STEPS = 100                          # of progress, of each stage


@dataclass(frozen=True)
class PoseConfig(AnimateConfig):
    """Settings of the poses of a person whose shape and marker places are known: as of `animate`, without a flag."""

    ground: bool = False

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
        The shape that changes with time.
    artefacts : ArtefactConfig
        What counts as wrong with the markers.
    soft_tissue : bool
        Let the shape change with time.
    repair : bool
        Put swapped labels right and leave out markers that slip, jitter or stray.
    exaggeration : float
        Factor on the change of shape in exaggerated.glb and on a character; 0 leaves it out there.
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
        """The weights of [MoSh], every marker believed alike, nothing repaired and nothing smoothed beyond them."""
        poses = replace(PoseConfig.weighted(0.75, 1.0, 6.25, outlier=1000.0), place_acceleration=1e6)
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
    seconds : {str: float}
        How long each stage took: "person", "poses", "artefacts", "soft tissue".
    """

    betas: np.ndarray
    layout: MarkerLayout
    person: PersonFit
    motions: tuple[Motion, ...]
    soft_tissue: tuple[SoftTissue, ...]
    artefacts: tuple[MarkerArtefacts, ...]
    seconds: dict[str, float] = field(default_factory=dict)


@one_thread()
def mosh(model: BodyModel, sequences: MarkerSequence | Sequence[MarkerSequence], layout: MarkerLayout,
         config: MoshConfig | None = None, progress: Progress | None = None, step: Step = once) -> MoshResult:
    """Body shape, marker places, poses and soft tissue of one subject from marker sequences.

    Labels are put right as far as tracks tell. The person is found from a few frames of all sequences, then the pose of
    every frame. The motion tells which labels were swapped and which markers were not on the body; where that
    concerns the frames that told of the person, the person is found again, and so is what is wrong. At last the shape
    may change with time.

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
    stages = _Stages(model, config, step, progress, STEPS * (1 + len(sequences) * (2 + config.soft_tissue)))
    used = [stages.relabelled(f"tracks {i}", each) for i, each in enumerate(sequences)]
    person = stages.person(used, layout)                                        # [MoSh] Eq. 23, shape and markers
    for n in range(ROUNDS):
        motions = [stages.motion(f"poses {n} {i}", person, each, n == 0)        # [MoSh] Eq. 23, poses
                   for i, each in enumerate(used)]
        artefacts = [stages.artefacts(f"artefacts {n} {i}", person, each, motion, n == 0)
                     for i, (each, motion) in enumerate(zip(sequences, motions, strict=True))]
        before, used = used, [each.repaired for each in artefacts]
        settled = all(same(before[i], used[i], t) for i, t in person.frames)
        if settled:
            break
        person = stages.person(used, layout, f"again {n}")
    motions = [motion if settled and same(old, new) else stages.motion(f"poses last {i}", person, new)
               for i, (motion, old, new) in enumerate(zip(motions, before, used, strict=True))]
    soft = [stages.soft_tissue(f"soft tissue {i}", person, each, motion)        # [MoSh] Eq. 24
            for i, (each, motion) in enumerate(zip(used, motions, strict=True)) if config.soft_tissue]
    return MoshResult(person.betas, person.layout, person, tuple(motions), tuple(soft), tuple(artefacts),
                      stages.seconds)


def same(first: MarkerSequence, second: MarkerSequence, frames: int | slice = slice(None)) -> bool:
    """Whether two sequences hold the same markers in the same places, in some frames."""
    return np.array_equal(first.positions[frames], second.positions[frames], equal_nan=True)


@dataclass
class _Stages:
    """The stages of a call: what each finds is kept by what it depends on, and it is told how far it is."""

    model: BodyModel
    config: MoshConfig
    step: Step
    progress: Progress | None
    total: int
    done: int = 0
    seconds: dict[str, float] = field(default_factory=dict)
    last: tuple[PersonFit, Subject] | None = None

    def relabelled(self, name: str, markers: MarkerSequence) -> MarkerSequence:
        """A sequence with labels put right as far as tracks tell."""
        if not self.config.repair:
            return markers
        return self._run("artefacts", name, markers, lambda _: relabelled_by_tracks(markers))

    def person(self, sequences: Sequence[MarkerSequence], layout: MarkerLayout, again: str = "") -> PersonFit:
        """Shape and marker places; `again` names it where it was found before, of other markers."""
        model, config = self.model, self.config.person
        step = inside(self.step, again) if again else self.step
        return self._run("person", f"{again} person".strip(), (model, sequences, layout, config),
                         lambda tell: find_person(model, sequences, layout, config, tell, step), not again)

    def motion(self, name: str, person: PersonFit, markers: MarkerSequence, told: bool = False) -> Motion:
        """The motion of a person of fixed shape."""
        layout, config = person.layout, self.config.poses
        return self._run("poses", name, (self.model, person.betas, layout, markers, config),
                         lambda tell: animate(self._subject(person), markers, layout, config, tell), told)

    def artefacts(self, name: str, person: PersonFit, markers: MarkerSequence, motion: Motion, told: bool
                  ) -> MarkerArtefacts:
        """What is wrong with the markers, by the body that carries them."""
        layout, config = person.layout, self.config.artefacts
        if not self.config.repair:
            return no_artefacts(self._subject(person), markers, layout, motion)
        return self._run("artefacts", name, (self.model, person.betas, layout, markers, motion, config), lambda tell:
                         find_artefacts(self._subject(person), markers, layout, config, motion, tell), told)

    def soft_tissue(self, name: str, person: PersonFit, markers: MarkerSequence, motion: Motion) -> SoftTissue:
        """The motion with a shape that changes."""
        model, layout, config = self.model, person.layout, self.config.soft
        return self._run("soft tissue", name, (model, layout, markers, motion, config),
                         lambda tell: follow_soft_tissue(model, motion, markers, layout, config, tell), True)

    def _subject(self, person: PersonFit) -> Subject:
        """Made when a stage needs it, once."""
        if self.last is None or self.last[0] is not person:
            self.last = person, self.model.subject(person.betas)
        return self.last[1]

    def _run(self, stage: str, name: str, inputs: Any, make: Callable[[Progress | None], T], told: bool = False
             ) -> T:
        """What `make` finds or found in an earlier run; its seconds count, and it moves the bar if it is told."""
        before, self.done = self.done, self.done + STEPS * told

        def tell(done: int, total: int) -> None:
            if self.progress:
                self.progress(before + round(STEPS * done / max(total, 1)), self.total)

        def timed() -> tuple[T, float]:
            start = time.perf_counter()
            return make(tell if told else None), time.perf_counter() - start

        value, seconds = self.step(name, inputs, timed)
        self.seconds[stage] = self.seconds.get(stage, 0.0) + seconds
        return value
