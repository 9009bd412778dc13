"""The work of `scape mosh` on one person: read recordings, find person and motions, write everything."""
from __future__ import annotations

import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from model.body import BodyModel
from model.learning.sexes import SexGuess
from model.linear import Subject
from model.motion.files import skeleton_arrays
from scanprep.batch.room import TaskContext
from scanprep.cli import MM
from scanprep.console import Metric, Outcome, details, judgement_row, write_report
from scanprep.folders import PICTURE
from scanprep.geometry import storage, tables
from scanprep.geometry.farthest_points import spread_indices
from scanprep.judgement import Judgement
from scanprep.pictures.camera import guess_upright
from scanprep.pictures.sheets import save_png

from ...motion_pictures import picture_bodies
from ..angle_conventions import define_segments
from ..angle_errors import expect_angle_errors
from ..artefacts.results import artefact_table, write_virtual
from ..files.force_plates import GroundReactions, read_ground_reactions, write_ground_reactions
from ..files.markers import MarkerSequence, read_markers
from ..files.motion_files import joint_centres, write_glb, write_motion_folder, write_residuals
from ..files.opensim import centre_sequence, mask_unknown_centres
from ..gait.cycles import GaitCycles, average_cycles, write_gait
from ..gait.events import find_gait_events
from ..joint_angles import (
    NOTHING_KNOWN,
    JointAngles,
    Known,
    SegmentAxes,
    anatomical_angles,
    find_static_zero,
)
from ..labelling.labelled_file import label_first, show_labels
from ..marker_sets.layout import MarkerLayout
from ..marker_sets.named import choose_layout
from ..pose.coverage import find_told_parts, untold_spans
from ..pose.follow import animate
from ..pose.judgement import markers_told
from ..pose.pelvis import follow_pelvis
from ..retargeting.retarget import retarget
from ..retargeting.soft_tissue import picture_transfer, retarget_soft_tissue, write_character
from .mosh import MoshConfig, MoshResult, clocks, mosh, mosh_by_sex
from .pictures import person_in_mean_pose, person_picture
from .recordings import Actor, Recording
from .report import person_page, take_page, take_picture
from .takes import Take

# what is left after soft tissue was fitted to the same markers is small, and no error
FIXED = "markers to the body, fixed shape"
ERRORS = (FIXED, "left over after soft tissue was fitted")
# metres: markers of a person are 5 to 15 mm off in another recording of the same session; and degrees from upright
SOMEBODY_ELSE, STANDING = 0.025, {"hip_flexion": 35, "hip_adduction": 25, "knee_angle": 30, "ankle_angle": 35}
HALF = 100                           # steps of progress for shape and motion, and as many for files and pictures


@dataclass(frozen=True, eq=False)
class MoshTask:
    """The work on each person, with the settings of the call."""

    model: BodyModel
    name: str                            # name of the model, for the output
    sexes: Mapping[str, BodyModel]       # models of "female" and "male" people, or empty
    character: BodyModel | None
    layout: tuple[MarkerLayout, str] | None          # with its name; None for the named one that fits labels best
    unit: str | None
    rate: float | None                   # frames a second, where a file does not say
    unlabelled: bool                     # markers have no names
    static: Path | None                  # static trial, in which joint angles are 0
    config: MoshConfig
    command: str = field(metadata={"digest": False})

    def __call__(self, actor: Actor, context: TaskContext) -> tuple[list[Metric], list[str]]:
        """Process one person into the folder of a task; return the figures, judgement first, and failures.

        A recording that cannot be read is left out and reported; ValueError where none can be read.
        """
        start, folder = clocks(), context.folder
        outcome, failures = _solve(self, actor, context)
        solved = clocks() - start
        settings = {"mosh": self.config, "model": self.name, "layout": outcome.layout_name}
        # the person: betas and how they were found, where the markers sat
        result, person = outcome.result, outcome.result.person
        storage.write_json(folder / "subject.json", {
            "betas": result.betas.tolist(), "model": self.name, "layout": outcome.layout_name,
            "sex": outcome.guess, "recordings": [r.path.name for r in actor.recordings],
            "frames": person.frames.tolist(),
            "moved": dict(zip(result.layout.labels, person.moved.tolist(), strict=True)),
            "misplaced": {m.label: {"from_the_layout": m.before, "left": m.after} for m in result.misplaced.moved},
            "exchanged": result.misplaced.exchanged, "left_out": result.misplaced.unplaced,
            "residual": person.residual, "energies": person.energies, "converged": bool(person.converged)})
        result.layout.save(folder / "layout.json")
        # the sequences, each into its folder
        figures: dict[str, list[Metric]] = {}
        pages, total = np.zeros(2), len(outcome.takes) + 1
        for i, take in enumerate(outcome.takes):
            context.report_progress(HALF + HALF * i // total, 2 * HALF)
            figures[take.name], seconds = _write(self, outcome, take, context, settings)
            pages += seconds
        context.report_progress(HALF + HALF * (total - 1) // total, 2 * HALF)
        # judgement, figures and page of the person
        pages -= clocks()
        judgement = outcome.judgement(outcome.takes)
        metrics = [judgement_row(judgement), Metric("model", self.name), *_person_metrics(outcome),
                   *_figures(outcome.takes)]
        person_page(actor.name, outcome.model, result, outcome.usual, outcome.takes, metrics, figures
                    ).write(folder / "report.html")
        save_png(folder / PICTURE, person_picture(outcome.model, result))
        pages += clocks()
        # run times of the stages, including kept ones; not on the page, which must not change from run to run
        whole = clocks() - start
        stages = {**result.seconds, "files": whole - solved - pages, "pages": pages, "all": whole}
        count = sum(len(take.motion.poses) for take in outcome.takes)
        metrics += details([
            *(Metric(f"{stage}, {what}", float(seconds[i]), "s") for i, what in
              ((1, "processor time"), (0, "time by the clock")) for stage, seconds in stages.items()),
            Metric("speed", count / max(float(whole[1]), 1e-9), "frames/s")])
        write_report(Outcome(folder, metrics, settings, failures, judgement=judgement), self.command, float(whole[0]))
        context.report_progress(2 * HALF, 2 * HALF)
        return metrics, failures


@dataclass(frozen=True, eq=False)
class _Found:
    """The results for one person."""

    model: BodyModel
    guess: SexGuess | None
    result: MoshResult
    takes: list[Take]
    usual: MarkerLayout
    layout_name: str
    labelling: Judgement                 # of labels that were found for unlabelled recordings, and of a static trial
    segments: SegmentAxes | None         # by another convention than the usual ISB
    zero: Mapping[str, np.ndarray] | None        # of joint angles, from a static trial

    def told(self, take: Take) -> np.ndarray:
        """Find in which frames the markers determine which parts, (T, J) bool."""
        return find_told_parts(take.subject, self.result.layout, take.motion)

    def find_known(self, take: Take) -> Known:
        """Find what is known of the joint angles of a sequence."""
        errors = expect_angle_errors(take.motion, take.subject, self.result.layout, self.zero is not None,
                                     self.segments)
        pelvis = follow_pelvis(take.motion, take.subject, self.result.layout, take.artefacts.repaired)
        return Known(self.told(take), errors, self.zero, self.segments, pelvis)

    def judgement(self, takes: Sequence[Take]) -> Judgement:
        """Judge the person and the motions of some sequences."""
        result = self.result if self.result.usual is self.usual else replace(self.result, usual=self.usual)
        return result.judge({self.takes.index(take): take.name for take in takes}, self.labelling)


def _solve(work: MoshTask, actor: Actor, context: TaskContext) -> tuple[_Found, list[str]]:
    """Read the recordings of a person and run `mosh`; return the results and what could not be read."""
    # recordings, labelled first where markers have no names
    recordings, sequences, failures = list[Recording](), list[MarkerSequence](), list[str]()
    labelling, units = list[Judgement](), list[str | None]()
    for recording in actor.recordings:
        try:
            if work.unlabelled:
                assert work.layout is not None, "the command asks for one"
                file = label_first(context, recording.name, recording.path, work.model, work.layout[0], work.unit,
                                   work.rate)
                labelling.append(Judgement.of(
                    check=[f"labels of {recording.name}: {why}" for why in file.judgement.reasons]))
                recording, unit = replace(recording, path=file.path, who=None), file.unit
                sequences.append(file.markers)
            else:
                unit = work.unit
                sequences.append(read_markers(recording.path, work.unit, recording.who, work.rate))
            units.append(unit)
            recordings.append(recording)
        except ValueError as error:
            failures.append(" ".join(str(error).split()))
    if not sequences:
        raise ValueError("; ".join(failures))
    # the layout for these labels
    labels = tuple(dict.fromkeys(label for each in sequences for label in each.labels))
    usual, layout_name = work.layout or choose_layout(work.model, None, labels)
    usual = usual.with_spellings(labels)
    model, guess = work.model, None

    def progress(done: int, total: int) -> None:
        context.report_progress(HALF * done // total, 2 * HALF)

    if work.sexes:
        guess, result = mosh_by_sex({"neutral": work.model, **work.sexes}, sequences, usual, work.config, progress,
                                    context.step)
        model = result.model
    else:
        result = mosh(sequences, model, usual, work.config, progress, context.step)
    # a take for each sequence
    subject = model.subject(result.betas)
    takes = []
    for i, (source, unit, markers) in enumerate(zip(recordings, units, sequences, strict=True)):
        soft = result.soft_tissue[i] if result.soft_tissue else None
        takes.append(Take(source, unit, model, subject, markers, result.motions[i], soft, result.artefacts[i]))
    segments = define_segments(work.config.angles, model, subject, result.layout)
    zero, doubts = _stand(work, subject, result.layout, segments) if work.static else (None, Judgement())
    return _Found(model, guess, result, takes, usual, layout_name, Judgement().merge(*labelling, doubts), segments,
                  zero), failures


def _stand(work: MoshTask, subject: Subject, layout: MarkerLayout, segments: SegmentAxes | None
           ) -> tuple[dict[str, np.ndarray], Judgement]:
    """Find the zero of joint angles in the static trial of a person; judge whether it is one, and of that person."""
    assert work.static is not None, "the command asks for one"
    markers = read_markers(work.static, work.unit, None, work.rate)
    motion = animate(subject, markers, layout, work.config.poses)
    doubts = []
    off = float(np.nanmedian(motion.residuals)) if np.isfinite(motion.residuals).any() else np.inf
    if off > SOMEBODY_ELSE:
        doubts.append(f"the static trial {work.static.name} has its markers {MM * off:.0f} mm off this person: is it "
                      "of somebody else, or of another session?")
    still = anatomical_angles(motion, subject, subject.joints(motion.poses, motion.trans))
    for name, degrees in zip(still.names, still.degrees.T, strict=True):
        if name[:-2] in STANDING and abs(float(np.median(degrees))) > STANDING[name[:-2]]:
            doubts.append(f"{name} is {np.median(degrees):.0f} degrees in the static trial {work.static.name}, which "
                          "counts as 0: expected somebody who stands upright")
    pelvis = follow_pelvis(motion, subject, layout, markers)
    return find_static_zero(motion, subject, Known(segments=segments, pelvis=pelvis)), Judgement.of(check=doubts[:3])


def _write(work: MoshTask, found: _Found, take: Take, context: TaskContext, settings: Mapping[str, Any]
           ) -> tuple[list[Metric], np.ndarray]:
    """Write a sequence into its folder, in steps that are kept; return figures and times (2,) of the page, seconds."""
    metrics, factor = [Metric("layout", found.layout_name), *_figures([take])], work.config.exaggeration
    solved = found.model, take.markers, take.motion, take.soft, take.artefacts

    def place(folder: Path) -> Path:
        (folder / take.name).mkdir(exist_ok=True)
        return folder / take.name

    def page(folder: Path) -> None:
        start = time.perf_counter()
        picture = take_picture(take)
        page = take_page(take, metrics, picture, gait, reactions)
        if shown:
            page.section("On a character", "The same rotations of the joints, and feet on the ground when those of the "
                         f"person are; soft tissue taken {factor:g} times.").picture(*shown)
        if work.unlabelled:
            show_labels(page)
        page.section("Figures").figures(metrics).write(place(folder) / "report.html")
        save_png(place(folder) / PICTURE, picture)
        judgement = found.judgement([take])
        outcome = Outcome(place(folder), metrics, settings, judgement=judgement)
        write_report(outcome, work.command, time.perf_counter() - start)

    metrics += untold_spans(take.subject.skeleton, found.told(take), take.motion.rate)
    inputs = (solved, found.told(take), take.source.path, take.source.who, take.unit, factor, found.zero,
              work.config.angles)
    exact, gait, reactions = context.files(
        f"{take.name} files", inputs, lambda folder: write_take(place(folder), take, found.find_known(take), factor))
    metrics += exact
    shown: list[Any] = []
    if (body := work.character) is not None:
        *shown, errors = context.files(f"{take.name} character", (solved, body, factor),
                                      lambda folder: _character(body, take, place(folder), factor))
        metrics += errors
    start = clocks()
    context.files(f"{take.name} page", (solved, metrics, settings, gait, reactions, shown and (shown, factor)), page)
    return metrics, clocks() - start


def write_take(folder: Path, take: Take, known: Known = NOTHING_KNOWN, factor: float = 1.0
               ) -> tuple[list[Metric], GaitCycles | None, GroundReactions | None]:
    """Write all files of a sequence but its page; exaggerated.glb only for a factor on soft tissue other than 1.

    Angles and joint centres between parts that the markers do not determine are empty cells, as far as that is `known`.
    Returned are the distance of the GLB files from the exact bodies, and what a gait laboratory reads.
    """
    motion, body, soft = take.motion, take.subject, take.soft
    angles = write_motion_folder(folder, motion, body, take.artefacts.virtual(), known)
    gait, reactions = (None, None) if angles is None else write_walk(folder, take, angles)
    exact = write_glb(folder / "animation.glb", take.shown, body, None if soft is None else take.make)
    if soft is not None:
        soft.save(folder / "soft_tissue.npz")
        write_residuals(folder / "residuals_soft.csv", soft.motion)
        if factor != 1:
            exact += write_glb(folder / "exaggerated.glb", soft.motion, body,
                               partial(soft.vertices, take.model, factor=factor, subject=body))
    # virtual markers: gaps filled, with joint centres, in a copy of a C3D recording
    path = take.source.path
    write_virtual(folder / "virtual.c3d", take.artefacts, path if path.suffix.lower() == ".c3d" else None,
                  take.source.who, take.unit,
                  centre_sequence(mask_unknown_centres(joint_centres(motion, body), body.skeleton, known.told),
                                  body.skeleton, motion.rate))
    # artefacts as JSON, and the spans as a table
    storage.write_json(folder / "artefacts.json", artefact_table(take.artefacts))
    rows: list[tuple[str, str, int, int, str]] = [
        *(("swapped", f"{s.first} {s.second}", s.begin, s.end, "") for s in take.artefacts.swaps),
        *((b.kind, b.label, b.begin, b.end, f"{b.distance:.4g}") for b in take.artefacts.bad)]
    tables.write_table(folder / "artefacts.csv", ("artefact", "markers", "begin", "end", "distance"),
                       sorted(rows, key=lambda row: (row[2], row[1])))
    return exact, gait, reactions


def write_walk(folder: Path, take: Take, angles: JointAngles) -> tuple[GaitCycles | None, GroundReactions | None]:
    """Write gait cycles and events of somebody who walks, and grf.mot of a C3D file with force plates."""
    path, motion = take.source.path, take.motion
    events = find_gait_events(motion, take.subject, joint_centres(motion, take.subject), angles, path, take.source.who)
    gait = None if events is None else average_cycles(angles, motion.rate, events)
    if gait is not None:
        write_gait(folder, gait)
    reactions = None
    if path.suffix.lower() == ".c3d":
        try:
            reactions = read_ground_reactions(path, angles.ground, motion.rate, take.unit)
        except ValueError as problem:
            warnings.warn(f"grf.mot is not written: {problem}", stacklevel=2)
    if reactions is not None:
        write_ground_reactions(folder / "grf.mot", reactions)
    return gait, reactions


def _character(character: BodyModel, take: Take, folder: Path, factor: float) -> tuple[np.ndarray, str, list[Metric]]:
    """Write the motion on a character; return a picture, its caption, and the error of the GLB."""
    if take.soft is not None:
        moving = retarget_soft_tissue(take.soft, take.model, character, factor)
        moving.save(folder / "character.npz")
        told = write_character(folder / "character.glb", character, moving)[1]
        return (picture_transfer(take.model, take.soft, character, moving),
                "the person, the character, and how far the character's skin is stretched or squeezed", told)
    body = character.subject(np.zeros(character.n_betas))
    motion = retarget(take.motion, take.subject, body)
    motion.save(folder / "character.npz", **skeleton_arrays(body.rest_skeleton))
    told = write_glb(folder / "character.glb", motion, body)
    frames = spread_indices(len(motion.poses), 8)
    return picture_bodies(motion, body, motion.vertices(body, frames), frames), "", told


def _person_metrics(found: _Found) -> list[Metric]:
    """Return the figures of a person: size, sex, markers, betas."""
    moved, result = MM * found.result.person.moved, found.result
    body = person_in_mean_pose(found.model, result.betas)
    told = [Metric("height", float(np.ptp(body.vertices[:, guess_upright(body)[0]])), "m"),
            Metric("volume", 1000 * abs(body.volume), "l")]
    if found.guess is not None:
        told.append(Metric("sex", f"{found.guess.sex} ({100 * found.guess.probability:.0f}%)"))
    return [*told, *result.covered.metrics(), *result.misplaced.metrics(), *result.person.metrics(found.usual),
            Metric("markers beside the layout's places, mean", float(moved.mean()), "mm"),
            *details([Metric("layout", found.layout_name), Metric("sequences", len(found.takes)),
                      Metric("body shape from the mean person, length of the betas",
                             float(np.linalg.norm(result.betas)), "sd"),
                      Metric(f"most beside the layout's place ({result.layout.labels[int(moved.argmax())]})",
                             float(moved.max()), "mm")])]


def _figures(takes: Sequence[Take]) -> list[Metric]:
    """Return the figures of some sequences, over all their frames together."""
    out = list[Metric]()
    fixed = [t.motion.residuals_of_trusted() for t in takes]
    soft = [np.where(np.isnan(t.motion.residuals_of_trusted()), np.nan,
                     t.soft.motion.residuals) for t in takes if t.soft is not None]
    for name, values in zip(ERRORS, (fixed, soft), strict=True):
        if values:
            out.append(Metric(name, MM * float(np.nanmean(np.concatenate([v.ravel() for v in values]))), "mm"))
    # counts of missing, bad and filled positions
    missing = sum(int((~t.markers.select(t.artefacts.labels).seen).sum()) for t in takes)
    filled = sum(sum(artefact_table(t.artefacts)["filled"].values()) for t in takes)
    share = 100 / max(sum(t.artefacts.simulated[..., 0].size for t in takes), 1)
    rate = [Metric("rate", takes[0].motion.rate, "1/s")] if len(takes) == 1 else []
    return [*out, Metric("swaps", sum(len(t.artefacts.swaps) for t in takes)),
            Metric("markers missing", share * missing, "%"),
            Metric("markers taken out as bad", share * max(filled - missing, 0), "%"),
            Metric("frames", sum(len(take.motion.poses) for take in takes)),
            *details([*rate, markers_told([take.motion for take in takes]),
                      Metric("bad spans", sum(len(t.artefacts.bad) for t in takes)),
                      Metric("gaps filled in", filled, "positions")])]
