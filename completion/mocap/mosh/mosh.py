"""From marker files of one subject to a moving body: all stages one after the other."""
from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from model.body import BodyModel
from model.linear import Subject
from scanprep.batch.steps import Step, inside, once
from scanprep.threads import one_thread

from ...motion import Motion
from ..artefacts.find import by_tracks, find_faults
from ..files.markers import MarkerSequence
from ..marker_sets.layout import MarkerLayout
from ..pose.follow import follow_poses
from ..results import MarkerFaults, MoshResult, PersonFit, SoftTissue
from ..settings import MoshConfig
from ..soft_tissue.soft_tissue import follow_soft_tissue
from ..subject.person import find_person, one_or_more

Progress = Callable[[int, int], None]
STEPS = 100                          # of progress, of each stage
ROUNDS = 3                           # most times that a person is followed and the markers are judged


@one_thread()
def mosh(model: BodyModel, sequences: MarkerSequence | Sequence[MarkerSequence], layout: MarkerLayout,
         config: MoshConfig | None = None, progress: Progress | None = None, step: Step = once) -> MoshResult:
    """Body shape, marker places, poses and soft tissue of one subject from marker sequences.

    Labels are put right as far as tracks tell. The person is found from a few frames of all sequences, then the pose of
    every frame. The motion tells which labels were exchanged and which markers were not on the body; where that
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
    bar = _Bar(progress, STEPS * (1 + len(sequences) * (2 + config.soft_tissue)))
    clock = _Clock(step)
    stages = _Stages(model, config, clock.step)
    with clock.running("faults"):
        used = [stages.by_tracks(f"tracks {i}", each) for i, each in enumerate(sequences)]
    with clock.running("person"):
        person = find_person(model, used, layout, config.person, bar.stage(), clock.step)
    bars = [[bar.stage() for _ in sequences] for _ in ("poses", "faults")]
    for n in range(ROUNDS):
        with clock.running("poses"):
            motions = [stages.poses(f"poses {n} {i}", person, each, tell)
                       for i, (each, tell) in enumerate(zip(used, bars[0], strict=True))]
        with clock.running("faults"):
            faults = [stages.faults(f"faults {n} {i}", person, each, motion, tell)
                      for i, (each, motion, tell) in enumerate(zip(sequences, motions, bars[1], strict=True))]
        mended, bars = [fault.repaired for fault in faults], [[None for _ in sequences] for _ in bars]
        if not _matters(person, used, mended):
            break
        used = mended
        with clock.running("person"):
            person = find_person(model, used, layout, config.person, None, inside(clock.step, f"again {n}"))
    with clock.running("poses"):
        motions = [motion if same(before, after) and used is not mended
                   else stages.poses(f"poses last {i}", person, after)
                   for i, (motion, before, after) in enumerate(zip(motions, used, mended, strict=True))]
    soft: list[SoftTissue] = []
    if config.soft_tissue:
        with clock.running("soft tissue"):
            soft = [stages.soft_tissue(f"soft tissue {i}", person, motion, each, bar.stage())
                    for i, (motion, each) in enumerate(zip(motions, mended, strict=True))]
    return MoshResult(person.betas, person.layout, person, tuple(motions), tuple(soft), tuple(faults), clock.seconds)


@dataclass
class _Stages:
    """The stages of a sequence, each kept by what it depends on."""

    model: BodyModel
    config: MoshConfig
    step: Step
    _last: tuple[PersonFit, Subject] | None = None

    def by_tracks(self, name: str, markers: MarkerSequence) -> MarkerSequence:
        config = self.config.faults
        return self.step(name, (markers, config), lambda: by_tracks(markers, config))

    def poses(self, name: str, person: PersonFit, markers: MarkerSequence, tell: Progress | None = None) -> Motion:
        config, layout = self.config.follow, person.layout
        return self.step(name, (self.model, person.betas, layout, markers, config),
                         lambda: follow_poses(self._subject(person), markers, layout, config, tell))

    def faults(self, name: str, person: PersonFit, markers: MarkerSequence, motion: Motion, tell: Progress | None
               ) -> MarkerFaults:
        config, layout = self.config.faults, person.layout
        return self.step(name, (self.model, person.betas, layout, markers, motion, config),
                         lambda: find_faults(self._subject(person), markers, layout, config, motion, tell))

    def soft_tissue(self, name: str, person: PersonFit, motion: Motion, markers: MarkerSequence, tell: Progress | None
                    ) -> SoftTissue:
        config, layout = self.config.soft, person.layout
        return self.step(name, (self.model, layout, markers, motion, config),
                         lambda: follow_soft_tissue(self.model, motion, markers, layout, config, tell))

    def _subject(self, person: PersonFit) -> Subject:
        """Made when a stage needs it, once."""
        if self._last is None or self._last[0] is not person:
            self._last = person, self.model.subject(person.betas)
        return self._last[1]


def same(first: MarkerSequence, second: MarkerSequence) -> bool:
    """Whether two sequences hold the same markers in the same places."""
    return np.array_equal(first.positions, second.positions, equal_nan=True)


def _matters(person: PersonFit, sequences: Sequence[MarkerSequence], mended: Sequence[MarkerSequence]) -> bool:
    """Whether anything was repaired in the frames that told of the person."""
    return any(not np.array_equal(sequences[i].positions[t], mended[i].positions[t], equal_nan=True)
               for i, t in person.frames)


@dataclass
class _Clock:
    """How long each stage took, seconds; what an earlier run has spent on steps that it kept counts too."""

    _step: Step
    seconds: dict[str, float] = field(default_factory=dict)
    _earlier: float = 0.0

    def now(self) -> float:
        return time.perf_counter() + self._earlier

    def step(self, name: str, inputs: Any, make: Callable[[], Any]) -> Any:
        def timed() -> tuple[Any, float]:
            start = self.now()
            return make(), self.now() - start

        start = self.now()
        value, seconds = self._step(name, inputs, timed)
        self._earlier += max(0.0, seconds - (self.now() - start))
        return value

    @contextmanager
    def running(self, stage: str) -> Iterator[None]:
        start = self.now()
        yield
        self.seconds[stage] = self.seconds.get(stage, 0.0) + self.now() - start


@dataclass
class _Bar:
    """Progress of stages one after the other, each as long as the others."""

    progress: Progress | None
    total: int
    done: int = 0

    def stage(self) -> Progress | None:
        """The callback of the next stage."""
        if self.progress is None:
            return None
        tell, before = self.progress, self.done
        self.done += STEPS

        def report(done: int, total: int) -> None:
            tell(before + round(STEPS * done / max(total, 1)), self.total)

        return report
