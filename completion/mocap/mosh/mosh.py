"""[MoSh] for one subject: shape, marker places, poses and soft tissue from markers, in stages; by sex if wanted."""
from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from model.body import BodyModel
from model.learning.sexes import SexGuess, guess_sex, sex_plane
from model.linear import Subject
from model.people import person_judgement
from scanprep.batch.room import Step, run_uncached, substeps
from scanprep.judgement import Judgement
from scanprep.ranges import Settings
from scanprep.threads import one_thread
from scanprep.words import describe_result

from ...motion import Motion, Progress
from ..angle_conventions import AngleConfig, define_segments, find_landmarks
from ..angle_errors import expect_angle_errors
from ..artefacts.find import find_artefacts, no_artefacts, relabel_by_tracks
from ..artefacts.results import MarkerArtefacts
from ..files.markers import MarkerSequence
from ..joint_angles import Known, angle_doubts, angle_table
from ..marker_sets.layout import MarkerLayout
from ..movement import pace_doubts, posture_doubts
from ..pose.coverage import Coverage, find_coverage, find_told_parts
from ..pose.follow import animate
from ..pose.judgement import judge_motions, motion_doubts, motion_problem
from ..pose.marked_body import AnimateConfig
from ..pose.pelvis import follow_pelvis
from ..pose.witnesses import ask_witnesses, witness_doubts
from ..soft_tissue.follow import SoftTissueConfig, follow_soft_tissue
from ..soft_tissue.soft_tissue import SoftTissue
from ..subject.misplaced_markers import MisplacedMarkers, find_misplaced_markers
from ..subject.person import PersonConfig, PersonFit, doubt_layout, find_person
from .inputs import MarkerSource, load_default_model, read_recordings, recognise_layout

T = TypeVar("T")
STEPS = 100                          # steps of progress for each stage
UNLABELLED = Judgement()             # of labels that are those of the files


@dataclass(frozen=True)
class MoshConfig(Settings):
    """Settings of `mosh`.

    Attributes
    ----------
    person : PersonConfig
        Shape and marker places, from some frames.
    poses : AnimateConfig
        Poses of all frames, with known shape and marker places. Markers are trusted more than in `animate`, whose
        layout may be inexact. In weights of the paper the markers have 2, the prior 0.3 and the change of velocity
        57600 instead of 0.75, 1 and 6.25. The prior of a few dozen scans is narrow and must not outweigh markers, and
        joints accelerate by 60 radians per second squared, not by 5760.
    soft : SoftTissueConfig
        Movement of the skin, or of the shape, over time.
    soft_tissue : bool
        Let the skin move on the body.
    repair : bool
        Correct swapped labels, find misplaced markers, and leave out markers that slip, jitter or stray.
    angles : AngleConfig
        Convention of the joint angles.
    exaggeration : float
        Factor on soft tissue in exaggerated.glb and on a character; 0 leaves it out there.

    Examples
    --------
    >>> MoshConfig.from_paper().repair
    False

    [MoSh] Eq. 23, Eq. 24
    """

    person: PersonConfig = field(default_factory=PersonConfig)
    poses: AnimateConfig = field(default_factory=lambda: AnimateConfig.from_weights(2.0, 0.3, 57600.0))
    soft: SoftTissueConfig = field(default_factory=SoftTissueConfig)
    angles: AngleConfig = field(default_factory=AngleConfig)
    soft_tissue: bool = True
    repair: bool = True
    exaggeration: float = 1.0

    @classmethod
    def from_paper(cls) -> MoshConfig:
        """Return the weights of [MoSh], with equal markers and without repair, shrinkage or further smoothing.

        Three things differ from the paper. Covariances of poses have at least (0.05 radians)² in every direction. The
        first frame is found by a search, then all frames are solved together, by Gauss-Newton. The weight of the
        velocity is meant for 120 frames a second, and scaled for other rates.
        """
        # 1000 metres: no marker is an outlier
        poses = replace(AnimateConfig.from_weights(0.75, 1.0, 6.25), outlier=1000.0, published=True)
        return cls(PersonConfig.from_paper(), poses, SoftTissueConfig.from_paper(), repair=False)


@dataclass(frozen=True, eq=False)
class MoshResult:
    """Shape, marker places and motions of one person, from markers alone.

    Attributes
    ----------
    model : BodyModel
        The model of which the person is.
    betas : (k,) float, standard deviations
        Shape of the person.
    layout : MarkerLayout
        True places of the markers on this person.
    person : PersonFit
        The fit that found both.
    motions : tuple of Motion, one for each sequence
        With fixed shape; residuals (T, L), metres, in the order of the sequence's labels, NaN for labels that the
        layout does not know.
    soft_tissue : tuple of SoftTissue, one for each sequence, or empty
    artefacts : tuple of MarkerArtefacts, one for each sequence
    misplaced : MisplacedMarkers
        Markers that are not where the layout has them, and pairs with exchanged names.
    seconds : {str: (2,) float}
        Elapsed and processor time of each stage: "person", "poses", "artefacts", "soft tissue".
    angles : AngleConfig
        Convention of the joint angles.
    recordings : tuple of MarkerSequence
        The markers as they were recorded.
    usual : MarkerLayout
        Where such markers usually sit.
    rival : str or None
        The doubt that a named layout explains the recordings better.

    Examples
    --------
    >>> from completion import load_layout
    >>> from model import load_built_in_model
    >>> model = load_built_in_model()
    >>> layout = load_layout("cmu41", model)
    >>> still = MarkerSequence(np.stack([layout.place(model)] * 4), layout.labels, 120.0)
    >>> quick = MoshConfig(PersonConfig(frames=2, n_betas=3, annealing=(10.0, 1.0)), soft_tissue=False, repair=False)
    >>> result = mosh(still, config=quick)
    >>> result.betas.shape, sorted(result.seconds)
    ((3,), ['person', 'poses'])
    >>> result.joint_angles()["knee_angle_r"].shape
    (4,)

    [MoSh] Eq. 23, Eq. 24
    """

    model: BodyModel
    betas: np.ndarray
    layout: MarkerLayout
    person: PersonFit
    motions: tuple[Motion, ...]
    soft_tissue: tuple[SoftTissue, ...]
    artefacts: tuple[MarkerArtefacts, ...]
    misplaced: MisplacedMarkers = field(default_factory=MisplacedMarkers)
    seconds: dict[str, np.ndarray] = field(default_factory=dict)
    angles: AngleConfig = field(default_factory=AngleConfig)
    recordings: tuple[MarkerSequence, ...] = ()
    usual: MarkerLayout | None = None
    rival: str | None = None
    __repr__ = describe_result

    @cached_property
    def subject(self) -> Subject:
        """The body of the person."""
        return self.model.subject(self.betas)

    @cached_property
    def covered(self) -> Coverage:
        """Which parts of the body the markers of all sequences determine."""
        return find_coverage(self.subject, self.layout, self.motions, self.recordings)

    @cached_property
    def judgement(self) -> Judgement:
        """The verdict of `scape mosh` on the person and all motions."""
        return self.judge({i: f"recording {i + 1}" for i in range(len(self.motions))})

    def judge(self, names: Mapping[int, str], labelling: Judgement = UNLABELLED) -> Judgement:
        """Judge the person and the motions of some sequences, by number and name; `labelling` is that of the labels."""
        subject, problems, doubts = self.subject, list[str](), list[str]()
        for i, name in names.items():
            motion, markers, whose = self.motions[i], self.recordings[i], f"{name}: " if len(names) > 1 else ""
            told = find_told_parts(subject, self.layout, motion)
            off = ask_witnesses(motion, subject, markers, self.covered.used)
            problem = motion_problem(motion, subject.template, self.layout, markers)
            problems += [whose + problem] if problem else []
            doubts += [whose + why for why in (
                *pace_doubts(motion, subject, told), *posture_doubts(motion, subject, told),
                *angle_doubts(motion, subject, told), *witness_doubts(off))]
        motions, usual = [self.motions[i] for i in names], self.usual or self.layout
        moving = motion_doubts(motions, [self.recordings[i] for i in names], self.model.template)
        own = self.covered.judgement().merge(labelling, Judgement.of(problems, (*filter(None, [self.rival]), *moving,
                                                                                *doubts)),
                                             self.misplaced.judgement(usual.labels), self.person.judgement(usual))
        return judge_motions(person_judgement(self.model, self.betas), own, motions, self.model.template)

    def joint_angles(self, number: int = 0) -> Any:
        """Return the joint angles of a motion as `angle_table` does, with errors; NaN where no marker tells."""
        motion = self.motions[number]
        segments = define_segments(self.angles, self.model, self.subject, self.layout)
        errors = expect_angle_errors(motion, self.subject, self.layout, segments=segments)
        pelvis = follow_pelvis(motion, self.subject, self.layout, self.artefacts[number].repaired)
        return angle_table(motion, self.subject, Known(find_told_parts(self.subject, self.layout, motion), errors,
                                                       segments=segments, pelvis=pelvis))


@one_thread()
def mosh(recordings: MarkerSource | Sequence[MarkerSource], model: BodyModel | None = None,
         layout: MarkerLayout | str | Path | None = None, config: MoshConfig | None = None,
         progress: Progress | None = None, step: Step = run_uncached) -> MoshResult:
    """Compute body shape, marker places, poses and soft tissue of one subject from recordings of markers.

    Labels are corrected as far as tracks tell. The person is found from a few frames of all sequences; misplaced
    markers are searched on the whole body. Then the pose of every frame is solved. The motion tells which labels were
    swapped and which markers are bad. Where that changes frames of the person's fit, the person is found again, and
    poses and artefacts too. At last the skin may move.

    Parameters
    ----------
    recordings : str, Path or MarkerSequence, or several of one subject
        Files as `read_markers` reads them, or positions (T, L, 3) in metres.
    model : BodyModel, optional
        With betas; without it that of the built-in people.
    layout : MarkerLayout, str or Path, optional
        Where markers usually sit on the model's template: also a name of `layout_names()`, or a file. Without it the
        named one that fits the labels best. Markers that are only in one of the two are left out.
    config : MoshConfig, optional
        Settings.
    progress : callable, optional
        Called with (done, total).
    step : callable, optional
        Keeps the result of each stage, as `TaskContext.step` does.

    Returns
    -------
    MoshResult
        Betas (k,), the layout on this person, and a motion with poses (T, J, 3) in radians for each sequence.

    Raises
    ------
    ValueError
        A model without betas, no recording or one that cannot be read, fewer than 3 markers in common, no frame with 3
        of them, a layout of another body, a convention of joint angles without its landmarks.

    Examples
    --------
    >>> from completion import load_layout
    >>> from model import load_built_in_model
    >>> model = load_built_in_model()
    >>> layout = load_layout("cmu41", model)
    >>> still = MarkerSequence(np.stack([layout.place(model)] * 4), layout.labels, 120.0)
    >>> write_markers("still.c3d", still)
    >>> quick = PersonConfig(frames=2, n_betas=3, annealing=(10.0, 1.0))
    >>> result = mosh("still.c3d", config=MoshConfig(quick, soft_tissue=False, repair=False))
    >>> result.motions[0].poses.shape
    (4, 16, 3)

    [MoSh] Eq. 23, Eq. 24
    """
    # recordings of files are read, the set is recognised, and the built-in people are the model where none is named
    config, sequences = config or MoshConfig(), read_recordings(recordings)
    model = load_default_model() if model is None else model
    layout = recognise_layout(model, layout, sequences)
    find_landmarks(config.angles, model, layout)         # an error now, not after the fit
    trials = [_Trial(i, each, each) for i, each in enumerate(sequences)]
    stages = _Stages(model, config, step, progress, STEPS * (1 + len(trials) * (2 + config.soft_tissue)))

    # shape and marker places from some frames, with labels corrected by tracks; then misplaced markers
    for trial in trials:
        stages.relabel(trial)
    person = stages.find_person(trials, layout)                                 # [MoSh] Eq. 23, shape and markers
    rival = stages.doubt_layout(trials, layout, person)
    misplaced = stages.find_misplaced_markers(trials, layout, person)
    if misplaced.changes:
        for trial in trials:
            trial.order = misplaced.order(trial.raw, layout)
            trial.raw = misplaced.restore_names(trial.raw, layout)
            trial.markers = misplaced.restore_names(trial.markers, layout)
        layout = misplaced.update_layout(layout)
        person = stages.find_person(trials, layout, "misplaced")

    # poses of all frames, then artefacts; where these change a frame of the person's fit, the person is found again
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
    # collect the results, artefacts in the labels of the original recordings
    every = [trial.result() for trial in trials]
    return MoshResult(model, person.fit.betas, person.fit.layout, person.fit, tuple(motion for motion, _, _ in every),
                      tuple(soft for _, soft, _ in every if soft is not None), tuple(found for *_, found in every),
                      misplaced, stages.seconds, config.angles, tuple(sequences), layout, rival)


@dataclass(eq=False)
class _Trial:
    """A recording and its results so far: raw markers, repaired markers, motion, artefacts, soft tissue."""

    number: int
    raw: MarkerSequence                  # as recorded, with exchanged names corrected
    markers: MarkerSequence
    followed: MarkerSequence | None = None       # the markers that `motion` follows
    order: np.ndarray | None = None      # (L,) column of the recording from which `raw` takes each label
    motion: Motion | None = None
    artefacts: MarkerArtefacts | None = None
    soft: SoftTissue | None = None

    def is_unchanged(self, frames: int | slice = slice(None)) -> bool:
        """Tell whether the markers of some frames are those that the motion followed."""
        assert self.followed is not None, "followed"
        return np.array_equal(self.followed.positions[frames], self.markers.positions[frames], equal_nan=True)

    def result(self) -> tuple[Motion, SoftTissue | None, MarkerArtefacts]:
        """Return the results, with artefacts in the labels of the original recording."""
        assert self.motion is not None and self.artefacts is not None, "followed and judged"
        if self.order is None:
            return self.motion, self.soft, self.artefacts
        return self.motion, self.soft, self.artefacts.rename_labels(self.order,
                                                                    self.raw.seen[:, np.argsort(self.order)])


@dataclass(frozen=True, eq=False)
class _Person:
    """A fitted person, and the body, which is made when a stage needs it."""

    model: BodyModel
    fit: PersonFit

    @cached_property
    def subject(self) -> Subject:
        return self.model.subject(self.fit.betas)


def clocks() -> np.ndarray:
    """Return elapsed and processor time (2,) of this process, seconds; only differences have a meaning."""
    return np.array([time.perf_counter(), time.process_time()])


@dataclass
class _Stages:
    """Runs the stages of a call: keeps each result by its inputs, measures time, and reports progress."""

    model: BodyModel
    config: MoshConfig
    step: Step
    progress: Progress | None
    total: int
    done: int = 0
    seconds: dict[str, np.ndarray] = field(default_factory=dict)

    def run(self, stage: str, name: str, inputs: Any, make: Callable[[Progress | None], T], bar: bool = False) -> T:
        """Return the result of `make`, or that of an earlier run; with `bar` it reports progress."""
        before, self.done = self.done, self.done + STEPS * bar

        def report_progress(done: int, total: int) -> None:
            if self.progress:
                self.progress(before + round(STEPS * done / max(total, 1)), self.total)

        def timed() -> tuple[T, np.ndarray]:
            start = clocks()
            return make(report_progress if bar else None), clocks() - start

        value, seconds = self.step(name, inputs, timed)
        self.seconds[stage] = self.seconds.get(stage, 0) + seconds
        return value

    def relabel(self, trial: _Trial) -> None:
        """Correct labels as far as tracks tell."""
        if self.config.repair:
            trial.markers = self.run("artefacts", f"tracks {trial.number}", trial.raw,
                                     lambda _: relabel_by_tracks(trial.raw))

    def find_person(self, trials: Sequence[_Trial], layout: MarkerLayout, again: str = "") -> _Person:
        """Find shape and marker places; `again` names a repetition with other markers."""
        used, config, step = [trial.markers for trial in trials], self.config.person, self.step
        step = substeps(step, again) if again else step
        return _Person(self.model, self.run(
            "person", f"{again} person".strip(), (self.model, used, layout, config),
            lambda report_progress: find_person(self.model, used, layout, config, report_progress, step), not again))

    def doubt_layout(self, trials: Sequence[_Trial], layout: MarkerLayout, person: _Person) -> str | None:
        """Find the doubt that a named layout explains the recordings better."""
        inputs = self.model, [trial.markers for trial in trials], layout, person.fit, self.config.person
        return self.run("person", "another layout", inputs, lambda _: doubt_layout(*inputs))

    def find_misplaced_markers(self, trials: Sequence[_Trial], layout: MarkerLayout, person: _Person
                               ) -> MisplacedMarkers:
        """Find markers that do not sit where the layout says, and pairs with exchanged names."""
        if not self.config.repair:
            return MisplacedMarkers()
        inputs = self.model, [trial.markers for trial in trials], layout, person.fit, self.config.person
        return self.run("person", "misplaced", inputs, lambda _: find_misplaced_markers(*inputs))

    def follow(self, trial: _Trial, person: _Person, name: str) -> None:
        """Solve the motion of a person of fixed shape, from that of an earlier fit of the person if there is one."""
        fit, poses, markers, near = person.fit, self.config.poses, trial.markers, trial.motion
        trial.motion = self.run("poses", name, (self.model, fit.betas, fit.layout, markers, poses, near),
                                lambda report_progress: animate(person.subject, markers, fit.layout, poses,
                                                                report_progress, near),
                                near is None)
        trial.followed = markers

    def judge(self, trial: _Trial, person: _Person, name: str) -> None:
        """Find artefacts by the body that carries the markers, from those of an earlier fit if there are any."""
        fit, markers, motion, known = person.fit, trial.raw, trial.motion, trial.artefacts
        assert motion is not None, "followed"
        if not self.config.repair:
            trial.artefacts = no_artefacts(person.subject, markers, fit.layout, motion)
            return
        trial.artefacts = self.run(
            "artefacts", name, (self.model, fit.betas, fit.layout, markers, motion, known),
            lambda report_progress: find_artefacts(person.subject, markers, fit.layout, motion, report_progress,
                                                   known), known is None)
        trial.markers = trial.artefacts.repaired

    def find_soft_tissue(self, trial: _Trial, person: _Person) -> None:
        """Estimate the movement of the skin, or of the shape."""
        model, layout, markers, motion = self.model, person.fit.layout, trial.markers, trial.motion
        soft, ground = self.config.soft, self.config.poses.ground
        assert motion is not None, "followed"
        trial.soft = self.run(
            "soft tissue", f"soft tissue {trial.number}", (model, layout, markers, motion, soft, ground),
            lambda report_progress: follow_soft_tissue(model, motion, markers, layout, soft, report_progress, ground),
            True)


@one_thread()
def mosh_by_sex(models: Mapping[str, BodyModel], sequences: MarkerSequence | Sequence[MarkerSequence],
                layout: MarkerLayout, config: MoshConfig | None = None, progress: Progress | None = None,
                step: Step = run_uncached) -> tuple[SexGuess, MoshResult]:
    """Run `mosh` with the model of the person's sex; return the guess, and the result, whose motions name the sex.

    The neutral model finds a body, its betas suggest the sex, and `mosh` runs with the model of that sex.

    Parameters
    ----------
    models : {"neutral", "female", "male": BodyModel}
        As `learn_by_sex` makes them, of one topology; the neutral one stores how women and men differ.
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
    result = mosh(sequences, models[guess.sex], layout, config, progress, step)
    motions = tuple(replace(motion, gender=guess.sex) for motion in result.motions)
    soft = tuple(replace(one, motion=replace(one.motion, gender=guess.sex)) for one in result.soft_tissue)
    return guess, replace(result, motions=motions, soft_tissue=soft)


def check_models(models: Mapping[str, BodyModel]) -> None:
    """Check the three models; ValueError where one is missing or does not fit."""
    missing = [name for name in ("neutral", "female", "male") if name not in models]
    if missing:
        raise ValueError(f"models: expected 'neutral', 'female' and 'male', {' and '.join(missing)} missing")
    sex_plane(models["neutral"])
    faces = models["neutral"].template.faces
    for name in ("female", "male"):
        if models[name].template.faces.shape != faces.shape or (models[name].template.faces != faces).any():
            raise ValueError(f"models: expected the triangles of the neutral model in that of '{name}', found others")
