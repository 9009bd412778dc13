"""Motions of another skeleton (BVH, AMASS), or keys, on a body, with figures and page."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from model.body import BodyModel
from model.linear import Subject
from model.motion.error import LEAN, MOST, RetargetingError
from model.motion.files import is_motion as holds_poses
from model.motion.keys import holds_keys, judge_keys, read_keys
from model.motion.onto import BodyMotion, read_motion
from scanprep.batch.room import TaskContext
from scanprep.cli import MM
from scanprep.console import Metric, judgement_row
from scanprep.geometry.storage import StorageError
from scanprep.judgement import Judgement
from scanprep.pictures.page import Page

from ...motion import Motion
from ...motion_pictures import chart_residuals, frame_panes, moving_pane, pane_with_dots, worst_frames
from ..files.motion_files import write_glb, write_motion_folder, write_residuals

ENDINGS = (".bvh", ".npz")
MEAN_DISTANCE = "distance of joint centres, mean"


def names_motion(path: Path) -> bool:
    """Tell whether a file is read as a motion, not as markers."""
    return path.suffix.lower() in ENDINGS or holds_keys(path)


def motion_among(path: Path) -> bool:
    """Tell whether a file of a folder is a motion; .npz files of other kinds may be there."""
    try:
        return path.suffix.lower() == ".bvh" or (path.suffix.lower() in ENDINGS and holds_poses(path))
    except StorageError:
        return False


def bring(path: Path, model: BodyModel, name: str, subject: Subject | None, unit: str | None, rate: float | None,
          context: TaskContext) -> tuple[list[Metric], Motion, Subject, Page]:
    """Retarget a motion or keys to a body and write it into the folder of a task.

    Returned are the figures, the motion, the body, and the page, which is not written yet.
    """
    # keys, or a motion of another skeleton; without a subject a motion may have betas of its own
    if holds_keys(path):
        body = subject if subject is not None else model.mean_subject
        source = read_keys(path, body.skeleton, body.betas, unit, rate)
        judgement = judge_keys(source.poses)
    else:
        source = read_motion(path, model, subject, unit, rate)
        body = subject if subject is not None else model.subject(source.betas)
        judgement = judge_fit(source.fit, source.doubts)
    motion = Motion.of(source)
    metrics = [judgement_row(judgement), Metric("model", name), *transfer_figures(source)]
    write_motion_folder(context.folder, motion, body)
    metrics += write_glb(context.folder / "animation.glb", motion, body)
    # the page, with the joint centres of the other skeleton if there is one
    page = Page(f"{path.name}, on the body", "The body in motion" + (
        ", with dots where the joint centres of the motion's own skeleton would be with bones as long as these."
        if source.fit else "."))
    if source.fit is None:
        page.bodies([moving_pane(motion, body)], "Press the triangle to play, drag the body to turn it.", 520)
    else:
        _joints(page, replace(motion, residuals=source.fit.distances, labels=source.fit.names,
                              trusted=np.ones_like(source.fit.distances, dtype=bool)), body, source.fit, context.folder)
    return metrics, motion, body, page.section("Figures").figures(metrics)


def judge_fit(fit: RetargetingError | None, twists: Sequence[str]) -> Judgement:
    """Judge a retargeted motion by its segments, doubts about their twists, and the lean of its skeleton."""
    reasons = [*twists]
    if fit is not None and fit.angle > MOST:
        worst = int(fit.angles.mean(axis=0).argmax())
        reasons.append(f"segments point {fit.angle:.0f} degrees off on average, that to the {_words(fit.names[worst])} "
                       f"{fit.angles[:, worst].mean():.0f}")
    if fit is not None and fit.lean > LEAN:
        reasons.append(f"the trunk of the motion's skeleton leans {fit.lean:.0f} degrees otherwise at rest; does it "
                       "stand upright there?")
    return Judgement.of(None, reasons)


def transfer_figures(found: BodyMotion) -> list[Metric]:
    """Return figures of the retargeting: how it was done, and how well the body follows."""
    out = [Metric("frames", len(found.poses)), Metric("rate", found.rate, "1/s"), Metric("copied", found.how)]
    # the rest pose of the other skeleton, and which parts follow which joints
    if found.rest:
        out.append(Metric("rest of its skeleton", found.rest))
    if found.brought is not None:
        out += [Metric("parts that follow a joint", f"{len(found.brought.matched)} of {found.poses.shape[1]}"),
                Metric("travel scaled by", found.brought.scale)]
        if found.brought.lacking:
            out.append(Metric("parts without a joint in the motion", ", ".join(found.brought.lacking)))
    # bones whose twist their elbow or knee told
    if found.twist is not None and found.twist.rolled.any():
        rolled = [f"{part} {angle:.0f}°" for part, angle in zip(found.twist.parts, found.twist.rolled, strict=True)
                  if angle]
        out.append(Metric("bones rolled otherwise at rest, allowed for", ", ".join(rolled)))
    # errors of joint centres and of the directions of segments
    if found.fit is not None:
        out += [Metric(MEAN_DISTANCE, MM * found.fit.distance, "mm"),
                Metric("angle of segments, mean", found.fit.angle, "°"),
                Metric("trunk leans otherwise at rest, allowed for", found.fit.lean, "°")]
    return out


def _joints(page: Page, motion: Motion, body: Subject, fit: RetargetingError, folder: Path) -> None:
    """Add the body with the joint centres that it follows; the residuals of `motion` are their distances."""
    page.bodies([pane_with_dots(motion, body, fit.wanted, "joint centres of the motion", [*map(_words, fit.names)],
                                True)],
                "Press the triangle to play, drag the body to turn it; it is kept in the middle.", 520)
    # distances over time, the worst frames, and a table by segment
    page.section("Joint centres").chart(chart_residuals(motion, "joint centres"),
                                        "distance of the body's joint centres from those of the motion")
    page.bodies(frame_panes(motion, body, fit.wanted, worst_frames(motion, 5)), "where they are farthest off", 300)
    page.table([(_words(name), MM * float(fit.distances[:, i].mean()), float(fit.angles[:, i].mean()))
                for i, name in enumerate(fit.names)], ("end of the segment", "mean distance (mm)", "mean angle (°)"))
    write_residuals(folder / "residuals.csv", motion)


def _words(joint: str) -> str:
    """Return the name of the joint at the end of a segment, for a sentence."""
    side = {"l_": "left ", "r_": "right "}.get(joint[:2], "")
    return {"skullbase": "head", "shoulders": "middle of the shoulders"}.get(joint, side + joint[2:])
