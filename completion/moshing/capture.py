"""From marker files of one subject to a moving body: all stages one after the other."""
from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from model.body import BodyModel
from scanprep.threads import one_thread

from ..markers.files import MarkerSequence
from ..markers.layout import MarkerLayout
from .faults.search import by_tracks, find_faults
from .person import find_person, one_or_more
from .poses import follow_poses
from .results import MoshResult, PersonFit, SoftTissue
from .settings import MoshConfig
from .soft import follow_soft_tissue

Progress = Callable[[int, int], None]
STEPS = 100                          # of progress, of each stage
ROUNDS = 3                           # most times that a person is followed and the markers are judged


@one_thread()
def mosh(model: BodyModel, sequences: MarkerSequence | Sequence[MarkerSequence], layout: MarkerLayout,
         config: MoshConfig | None = None, progress: Progress | None = None) -> MoshResult:
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

    Raises
    ------
    ValueError
        A model without betas, no sequence, fewer than 3 markers in common, no frame with 3 of them, a layout of
        another body.

    [MoSh] Eq. 23, Eq. 24
    """
    config, sequences = config or MoshConfig(), one_or_more(sequences)
    bar = _Bar(progress, STEPS * (1 + len(sequences) * (2 + config.soft_tissue)))
    clock = _Clock()
    with clock.running("faults"):
        used = [by_tracks(each, config.faults) for each in sequences]
    with clock.running("person"):
        person = find_person(model, used, layout, config.person, bar.stage())
    bars = [[bar.stage() for _ in sequences] for _ in ("poses", "faults")]
    for _ in range(ROUNDS):
        subject = model.subject(person.betas)
        with clock.running("poses"):
            motions = [follow_poses(subject, each, person.layout, config.follow, tell)
                       for each, tell in zip(used, bars[0], strict=True)]
        with clock.running("faults"):
            faults = [find_faults(subject, each, person.layout, config.faults, motion, tell)
                      for each, motion, tell in zip(sequences, motions, bars[1], strict=True)]
        mended, bars = [fault.repaired for fault in faults], [[None for _ in sequences] for _ in bars]
        if not _matters(person, used, mended):
            break
        used = mended
        with clock.running("person"):
            person = find_person(model, used, layout, config.person)
    with clock.running("poses"):
        subject = model.subject(person.betas)
        motions = [motion if same(before, after) and used is not mended
                   else follow_poses(subject, after, person.layout, config.follow)
                   for motion, before, after in zip(motions, used, mended, strict=True)]
    soft: list[SoftTissue] = []
    if config.soft_tissue:
        with clock.running("soft tissue"):
            soft = [follow_soft_tissue(model, motion, each, person.layout, config.soft, bar.stage())
                    for motion, each in zip(motions, mended, strict=True)]
    return MoshResult(person.betas, person.layout, person, tuple(motions), tuple(soft), tuple(faults), clock.seconds)


def same(first: MarkerSequence, second: MarkerSequence) -> bool:
    """Whether two sequences hold the same markers in the same places."""
    return np.array_equal(first.positions, second.positions, equal_nan=True)


def _matters(person: PersonFit, sequences: Sequence[MarkerSequence], mended: Sequence[MarkerSequence]) -> bool:
    """Whether anything was repaired in the frames that told of the person."""
    return any(not np.array_equal(sequences[i].positions[t], mended[i].positions[t], equal_nan=True)
               for i, t in person.frames)


class _Clock:
    """How long each stage takes, seconds."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def running(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start


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
