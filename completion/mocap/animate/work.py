"""The work of `scape animate` on one file of markers or of a motion: the person, its motion, all files, the page."""
from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from model.body import BodyModel
from model.linear import Subject
from model.motion.files import skeleton_arrays
from model.people import person_judgement
from scanprep.arguments import UsageError
from scanprep.batch.room import TaskContext
from scanprep.cli import MM
from scanprep.console import Metric, details, judgement_row
from scanprep.geometry import storage
from scanprep.judgement import Judgement
from scanprep.pictures.page import Page

from ...motion import Motion
from ...motion_pictures import (
    chart_residuals,
    frame_panes,
    marker_rows,
    moving_pane,
    pane_with_dots,
    worst_frames,
)
from ..angle_conventions import AngleConfig, define_segments, find_landmarks
from ..angle_errors import expect_angle_errors
from ..files.markers import MarkerSequence, marker_subjects, read_markers
from ..files.motion_files import write_glb, write_motion_folder
from ..files.opensim import remove_distrusted
from ..joint_angles import Known, angle_doubts
from ..labelling.labelled_file import label_first, show_labels
from ..marker_sets.layout import MarkerLayout
from ..marker_sets.named import choose_layout
from ..movement import pace_doubts, posture_doubts
from ..pose.coverage import find_coverage, find_told_parts, untold_spans
from ..pose.follow import AnimateConfig, animate
from ..pose.judgement import judge_motions, markers_told, motion_doubts, motion_problem
from ..pose.pelvis import follow_pelvis
from ..retargeting.retarget import morph_vertices, retarget
from ..subject.misplaced_markers import MisplacedMarkers, find_misplaced_markers
from ..subject.person import PersonConfig, PersonFit, doubt_layout, find_person
from .motions import bring, names_motion

BetasTo = dict[float, np.ndarray] | np.ndarray      # keys over seconds, betas (k,) at the end or (T, k) of every frame
MEAN_ERROR = "distance of markers, mean"


@dataclass(frozen=True, eq=False)
class AnimateTask:
    """Settings that all files of a call share; without a subject it is found from the markers."""

    model: BodyModel
    name: str                            # name of the model, for the output
    layout: str | Path | None            # a name or a file; None for the named one that fits the labels best
    subject: Subject | None              # None: found from the markers
    retarget_to: Subject | None          # another person, to whom the motion is retargeted
    betas_to: BetasTo | None             # how the shape changes over the motion
    unit: str | None                     # as for `read_markers`
    rate: float | None                   # frames a second, where a file does not say
    animate: AnimateConfig
    person: PersonConfig
    unlabelled: bool = False             # markers have no names
    angles: AngleConfig = field(default_factory=AngleConfig)

    def __call__(self, path: Path, context: TaskContext) -> list[Metric]:
        """Follow the markers of a file, or retarget its motion, and write everything into the folder of a task.

        Returned are the figures, the judgement first.
        """
        metrics, motion, body, page = bring(path, self.model, self.name, self.subject, self.unit, self.rate, context) \
            if names_motion(path) else self._follow(path, context)
        if self.retarget_to is not None:
            other = retarget(motion, body, self.retarget_to)
            other.save(context.folder / "onto.npz", **skeleton_arrays(self.retarget_to.rest_skeleton))
            metrics += write_glb(context.folder / "onto.glb", other, self.retarget_to)
            page.section("On another person", "The same rotations of the joints; the way over the ground is as much "
                         "longer as the legs are, and the feet are on the ground when those of the first are.")
            page.bodies([moving_pane(other, self.retarget_to)])
        if self.betas_to is not None:
            bodies = partial(morph_vertices, self.model, motion, betas_in_motion(self.betas_to, motion))
            metrics += write_glb(context.folder / "morph.glb", motion, body, bodies)
            page.section("With a body that changes", "Betas change straight from key to key, or are given for every "
                         "frame.")
            page.bodies([moving_pane(motion, body, bodies=bodies)])
        page.write(context.folder / "report.html")
        return metrics

    def _follow(self, path: Path, context: TaskContext) -> tuple[list[Metric], Motion, Subject, Page]:
        """Compute the motion of the markers of a file and write it."""
        # read the markers, and label them first if they have no names
        labelling = Judgement()
        if self.unlabelled:
            usual, _ = choose_layout(self.model, self.layout, ())
            file = label_first(context, "", path, self.subject or self.model, usual, self.unit, self.rate)
            sequence, labelling = file.markers, file.judgement
        else:
            people = marker_subjects(path)
            if len(people) > 1:
                raise ValueError(f"{path}: expected the markers of one person, found {', '.join(people)}: scape mosh "
                                 "takes them apart")
            sequence = read_markers(path, self.unit, rate=self.rate)
        layout, name = choose_layout(self.model, self.layout, sequence.labels)
        find_landmarks(self.angles, self.model, layout)      # an error now, not after the fit
        metrics = [Metric("model", self.name), Metric("layout", name)]
        body, fit, misplaced, placed = self.subject, None, MisplacedMarkers(), Judgement()
        # the person, found from the markers
        if body is None:
            usual = layout
            sequence, fit, misplaced = self._person(sequence, layout, context)
            rival = context.step("another layout", (self.model, sequence, usual, fit, self.person),
                                 lambda: doubt_layout(self.model, [sequence], usual, fit, self.person))
            placed = Judgement.of(check=filter(None, [rival])).merge(fit.judgement(usual))
            body, layout = self.model.subject(fit.betas), fit.layout
            metrics += [Metric("subject", f"{len(fit.betas)} betas from {len(fit.frames)} frames"),
                        *misplaced.metrics(), *fit.metrics(usual)]
        # the key of the kept motion: of a found person its betas, which are quicker to digest than its body
        whose = self.subject if fit is None else (self.model, fit.betas)
        motion = context.step("motion", (whose, sequence, layout, self.animate),
                              lambda: animate(body, sequence, layout, self.animate, context.report_progress))
        output = context.folder
        if fit is not None:
            storage.write_json(output / "subject.json", {"betas": fit.betas.tolist(),
                                                         "frames": fit.frames[:, 1].tolist()})
            layout.save(output / "layout.json")
        # what the markers determine, and a judgement of labels, motion, markers and person
        covered = find_coverage(body, layout, [motion], [sequence])
        told = find_told_parts(body, layout, motion)
        moving = Judgement.of(motion_problem(motion, body.template, layout, sequence),
                              motion_doubts([motion], [sequence], body.template) + pace_doubts(motion, body, told)
                              + posture_doubts(motion, body, told) + angle_doubts(motion, body, told))
        judgement = covered.judgement().merge(labelling, moving, misplaced.judgement(sequence.labels), placed)
        if fit is not None:
            judgement = judge_motions(person_judgement(self.model, fit.betas), judgement, [motion], body.template)
        metrics = [judgement_row(judgement), *metrics, *covered.metrics(),
                   *untold_spans(body.skeleton, told, motion.rate), *motion_figures(motion)]
        segments = define_segments(self.angles, self.model, body, layout)
        errors = expect_angle_errors(motion, body, layout, segments=segments)
        write_motion_folder(output, motion, body, remove_distrusted(motion, sequence),
                            Known(told, errors, segments=segments,
                                  pelvis=follow_pelvis(motion, body, layout, sequence)))
        metrics += write_glb(output / "animation.glb", motion, body)
        page = motion_page(motion, body, sequence, path.name, metrics)
        if self.unlabelled:
            show_labels(page)
        return metrics, motion, body, page

    def _person(self, sequence: MarkerSequence, layout: MarkerLayout, context: TaskContext
                ) -> tuple[MarkerSequence, PersonFit, MisplacedMarkers]:
        """Find the person; return the markers under corrected names, the fit, and misplaced markers."""
        def find(name: str, markers: MarkerSequence, usual: MarkerLayout) -> PersonFit:
            return context.step(name, (self.model, markers, usual, self.person),
                                lambda: find_person(self.model, markers, usual, self.person, context.report_progress))

        fit = find("subject", sequence, layout)
        misplaced = context.step("misplaced", (self.model, sequence, layout, fit, self.person),
                                 lambda: find_misplaced_markers(self.model, [sequence], layout, fit, self.person))
        if not misplaced.changes:
            return sequence, fit, misplaced
        sequence = misplaced.restore_names(sequence, layout)
        return sequence, find("subject again", sequence, misplaced.update_layout(layout)), misplaced


def motion_figures(motion: Motion) -> list[Metric]:
    """Return the figures by which a motion is judged."""
    seen = np.isfinite(motion.residuals)
    off = MM * motion.residuals[seen] if seen.any() else np.array([np.nan])
    frame = MM * np.where(seen, motion.residuals, 0).sum(axis=1) / np.maximum(seen.sum(axis=1), 1)
    return [
        Metric(MEAN_ERROR, MM * float(np.nanmean(motion.residuals_of_trusted())) if seen.any() else np.nan, "mm"),
        Metric("distance of markers, 95th percentile", float(np.percentile(off, 95)), "mm"),
        Metric("distance of markers, mean of the worst frame", float(frame.max()), "mm"),
        Metric("markers missing", 100 * float(1 - seen[:, seen.any(axis=0)].mean()) if seen.any() else 100.0, "%"),
        Metric("frames that settled", 100 * float(motion.converged.mean()), "%"),
        *details([markers_told([motion]), Metric("frames", len(motion.poses)), Metric("rate", motion.rate, "1/s")])]


def betas_in_motion(given: BetasTo, motion: Motion) -> dict[float, np.ndarray] | np.ndarray:
    """Return betas at some seconds, or (T, k) for every frame; betas at the end become keys at both ends."""
    if isinstance(given, dict):
        return given
    if given.ndim == 2:
        if len(given) != len(motion.poses):
            raise UsageError(f"--betas-to: expected betas of all {len(motion.poses)} frames, got those of {len(given)}")
        return given
    if motion.betas is None:
        raise UsageError("--betas-to: the subject has no betas to begin with; give keys {seconds: betas}")
    return {0.0: motion.betas, float(motion.times[-1]): given}


def motion_page(motion: Motion, subject: Subject, markers: MarkerSequence, name: str, metrics: list[Metric]) -> Page:
    """Make the page of `scape animate`."""
    page = Page(f"{name}, animated", "The body in motion, with the markers that were measured as dots.")
    page.bodies([pane_with_dots(motion, subject, markers.positions, "measured markers", markers.labels)],
                "Press the triangle to play, drag the body to turn it; it is kept in the middle.", 520)
    page.section("Markers").chart(chart_residuals(motion), "distance of the markers to where the body puts them")
    page.bodies(frame_panes(motion, subject, markers.positions, worst_frames(motion, 5)),
                "where the markers are farthest off", 300)
    rows = marker_rows(motion.labels, motion.residuals, None, motion.trusted)
    page.table([(*row[:2], *row[3:]) for row in rows],
               ("marker", "mean distance (mm)", "95th percentile (mm)", "seen (%)", "believed (%)"))
    used = np.isfinite(motion.residuals).any(axis=0)
    unused = [label for label, is_used in zip(motion.labels, used, strict=True) if not is_used]
    if unused:
        page.text(f"Not used, because the layout does not know them or they were never seen: {', '.join(unused)}.")
    return page.section("Figures").figures(metrics)
