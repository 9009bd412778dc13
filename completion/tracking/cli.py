"""The command `scape track`."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np

from model.linear import Subject
from model.people import person_judgement
from scanprep.arguments import Place
from scanprep.batch.workspace import Workspace
from scanprep.cli import MM, Output, PersonUnit
from scanprep.console import Metric, Outcome, bar, say
from scanprep.geometry.farthest_points import spread_indices
from scanprep.geometry.files import PointCloud
from scanprep.judgement import Judgement, extent
from scanprep.plausible import check_unit, unit_problem
from scanprep.ranges import Positive

from ..cli import ModelOrNone, body_of, read_landmark_pairs, read_model
from .folder import FrameFolder, follow_folder
from .sequence import BodyTracker, as_motion, tracking_doubts, tracking_problem
from .settings import TrackConfig

FramesArg = Annotated[Path, Place("FRAMES")]


def track_frames(frames: FramesArg, output: Output, model: ModelOrNone = None, rate: Positive = 30.0,
                 landmarks: Path | None = None, subject: str | None = None, template_landmarks: Path | None = None,
                 unit: PersonUnit | None = None, surfaces: bool = False, config: TrackConfig = TrackConfig(), *,
                 space: Workspace) -> Outcome:
    """The motion of a person from frames of points, without markers.

    Example: scape track frames -m model.npz --rate 30 -o walk

    Frames are in the order of the numbers in their names; a number that is left out is a frame in which nothing was
    seen. Interrupted, the same command goes on where it stopped. A frame that has changed is tracked anew, with all
    that follow it.

    Args:
        frames: Folder of meshes or point clouds, one for each frame; or with one such folder for each camera, all
            cameras in one frame of reference.
        output: Folder to write motion.npz, animation.glb, motion.bvh, motion.trc, motion.mot, joint_angles.csv,
            joint_centres.csv, residuals.csv and report.html to.
        model: Model of `scape learn`; without it that of the built-in people.
        rate: Frames per second.
        landmarks: Named points in the first frame; without them the search starts from typical poses.
        subject: Whose body it is: "template" for the one the model's poses were learned from, betas in JSON or .npz,
            or a mesh in the model's triangles. Without it the shape is found from the first frames.
        template_landmarks: Where these landmarks are on the model's template; else those kept in the model.
        unit: Unit of the frames and landmarks; "unknown": it is found together with the person in the first frame.
        surfaces: Write the completed surface of every frame to surfaces/.
        config: Settings.
    """
    from ..mocap.files.motion_files import write_glb, write_motion_folder
    from ..mocap.movement import pace_doubts
    from .report import track_page

    found = FrameFolder(frames, unit)
    loaded, name = read_model(model)
    body = body_of(loaded, subject, unit)
    check_unit(_points(found[spread_indices(len(found), 3)[1]]), loaded.template.vertices, f"{frames}: a frame is")
    marked = None if landmarks is None else read_landmark_pairs(loaded, name, landmarks, template_landmarks, found.unit)
    whose = Path(subject) if subject not in (None, "template") else subject
    # what kept frames depend on; smoothing comes after them
    key = space.digests.of(model or loaded, whose, marked, unit, replace(config, smoothing=0), rate, surfaces)
    with bar("following the body") as progress:
        done = follow_folder(BodyTracker(body, config, rate, marked), found, space, key, surfaces, progress)
    if done.fresh < len(found):
        say(f"{len(found) - done.fresh} of {len(found)} frames were tracked before")
    # the whole motion, smoothed, and its figures
    motion = as_motion(done.frames, done.state.betas, rate, config)
    person = body if isinstance(body, Subject) else loaded.subject(motion.betas)
    residual = motion.residuals[motion.converged, 0] if motion.converged.any() else np.array([np.nan])
    metrics = [Metric("model", name), Metric("cameras", len(found.cameras)), Metric("frames", len(motion.poses)),
               Metric("rate", motion.rate, "1/s"), Metric("frames lost", int((~motion.converged).sum())),
               Metric("distance of the points to the body, mean", MM * float(residual.mean()), "mm"),
               Metric("the same, worst frame", MM * float(residual.max()), "mm")]

    def write(folder: Path) -> None:
        write_motion_folder(folder, motion, person)
        track_page(motion, person, lambda t: _points(found[t]), frames.name, found.numbers, metrics).write(
            folder / "report.html")

    # write files and page in steps that are kept, then judge
    of_motion = done.key, config.smoothing
    metrics += space.step("animation", of_motion, lambda folder: write_glb(folder / "animation.glb", motion, person))
    space.step("motion", (of_motion, metrics, frames.name), write)
    judgement = Judgement.of(wrong_size(found, person) or tracking_problem(motion),
                             (*tracking_doubts(motion, loaded.template), *pace_doubts(motion, person)))
    if not isinstance(body, Subject):
        judgement = judgement.merge(person_judgement(loaded, motion.betas))
    return Outcome(output, metrics, {"track": config, "rate": rate, "model": name}, found.problems,
                   judgement=judgement)


def _points(views: Sequence[PointCloud]) -> np.ndarray:
    """Return the points (n, 3) of all cameras in a frame, metres."""
    return np.concatenate([np.zeros((0, 3)), *(view.points for view in views)])


def wrong_size(frames: FrameFolder, person: Subject) -> str | None:
    """Return why frames cannot show the body, by the largest of five of them, or None where they can."""
    sampled = spread_indices(len(frames), 5)
    spans = [extent(_points(frames[t])) for t in sampled]
    return unit_problem(float(np.fmax.reduce(spans)), extent(person.template.vertices), "the frames are", 0.1)
