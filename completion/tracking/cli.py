"""The command `scape track`."""
from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from model.body import BodyModel
from model.cli import read_subject
from model.linear import Subject
from scanprep.cli import MM, Output, Unit
from scanprep.console import Metric, Outcome, bar, plain, say
from scanprep.ranges import Count, Positive

from ..cli import ModelOrNone, read_landmark_pairs, read_model, rows
from ..motion import Motion
from .folder import FrameFolder
from .sequence import as_motion, tracking_problem, without_points
from .settings import TrackConfig
from .store import FrameStore
from .tracker import TrackedFrame, Tracker

FramesArg = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FRAMES")]


def track_frames(frames: FramesArg, output: Output, model: ModelOrNone = None, rate: Positive = 30.0,
                 cameras: str | None = None, landmarks: Path | None = None, subject: str | None = None,
                 template_landmarks: Path | None = None, unit: Unit | None = None, surfaces: bool = False,
                 keys: Count = 120, config: Annotated[TrackConfig, tyro.conf.arg(name="")] = TrackConfig()  # noqa: B008
                 ) -> Outcome:
    """The motion of a person from frames of points, without markers.

    Example: scape track frames -m model.npz --rate 30 -o walk

    Frames are in the order of the numbers in their names; a number that is left out is a frame in which nothing was
    seen. Interrupted, the same command goes on where it stopped.

    Args:
        frames: Folder of meshes or point clouds, one for each frame; or with one such folder for each camera, all
            cameras in one frame of reference.
        output: Folder to write motion.npz, animation.glb, motion.bvh, joint_angles.csv, joint_centres.csv,
            residuals.csv and report.html to.
        model: Model of `scape learn`; without it that of the embedded people, which is made on first use.
        rate: Frames per second.
        cameras: How files of several cameras in one folder are named, such as "cam{camera}_{frame}.ply".
        landmarks: Named points in the first frame; without them the search starts from typical poses.
        subject: Whose body it is: "template" for the one the model's poses were learned from, betas in JSON or .npz,
            or a mesh in the model's triangles. Without it the shape is found from the first frames.
        template_landmarks: Where these landmarks are on the model's template; else those kept in the model.
        unit: Unit of the frames and landmarks.
        surfaces: Write the completed surface of every frame to surfaces/.
        keys: Largest number of key frames in the GLB.
        config: Settings.
    """
    found = FrameFolder(frames, cameras, unit)
    loaded, name = read_model(model)
    body: BodyModel | Subject = loaded
    if subject is not None or not loaded.n_betas:
        body = read_subject(loaded, None if subject in (None, "template") else Path(str(subject)), unit)
    marked = None if landmarks is None else read_landmark_pairs(loaded, name, landmarks, template_landmarks, unit)
    key = {"settings": plain(config), "model": name, "digest": loaded.info.get("digest"), "rate": rate, "unit": unit,
           "subject": subject, "landmarks": None if marked is None else [m.tolist() for m in marked],
           "surfaces": surfaces, "frames": str(frames.resolve()), "cameras": found.cameras,
           "first": [(p.name, p.stat().st_size) for p in found.paths(0)]}
    store = FrameStore(output / "tracked", key)
    tracker = Tracker(body, config, rate, marked)
    done, before = _follow(tracker, found, store, output / "surfaces" if surfaces else None)
    motion = as_motion(done, tracker.betas, rate, config)
    person = body if isinstance(body, Subject) else loaded.subject(motion.betas)
    metrics = [Metric("model", name), Metric("cameras", len(found.cameras)), *_figures(motion)]
    if before:
        metrics.append(Metric("frames tracked before", before))
    _write(output, motion, person, keys)
    _page(output, motion, person, found, frames.name, metrics)
    return Outcome(output, metrics, {"track": config, "rate": rate, "model": name}, found.problems,
                   tracking_problem(motion))


def _follow(tracker: Tracker, frames: FrameFolder, store: FrameStore, surfaces: Path | None
            ) -> tuple[list[TrackedFrame], int]:
    """All frames, those that were tracked before first, and how many these were."""
    done, betas = store.load()
    before = len(done)
    if before:
        tracker.resume(done, betas)
        say(f"{before} frames were tracked before")
    frames.problems += store.problems

    def keep(ready: list[TrackedFrame]) -> None:
        for frame in ready:
            if surfaces is not None:
                _write_surface(surfaces, tracker, frame)
            done.append(without_points(frame))
            store.add(done[-1], tracker.betas, frames.problems)
            progress(len(done), len(frames))

    with bar("following the body") as progress:
        try:
            for i in range(before, len(frames)):
                keep(tracker.push(frames[i]))
            keep(tracker.finish())
        finally:                                     # after an interruption too
            store.write(tracker.betas, frames.problems)
    return done, before


def _write_surface(folder: Path, tracker: Tracker, frame: TrackedFrame) -> None:
    from scanprep.geometry.files import write_mesh

    folder.mkdir(parents=True, exist_ok=True)
    write_mesh(folder / f"{frame.number:06d}.ply", tracker.surface(frame), "single")


def _figures(motion: Motion) -> list[Metric]:
    residual = motion.residuals[motion.converged, 0]
    shown = residual if len(residual) else np.array([np.nan])
    return [Metric("frames", len(motion.poses)), Metric("rate", motion.rate, "1/s"),
            Metric("frames lost", int((~motion.converged).sum())),
            Metric("distance of the points to the body, mean", MM * float(shown.mean()), "mm"),
            Metric("the same, worst frame", MM * float(shown.max()), "mm")]


def _write(output: Path, motion: Motion, person: Subject, keys: int) -> None:
    from ..animation.outputs import write_joint_angles, write_joint_centres, write_motion_bvh, write_residuals
    from ..animation.work import write_glb

    motion.save(output / "motion.npz")
    write_glb(output / "animation.glb", motion, person, keys)
    write_motion_bvh(output / "motion.bvh", motion, person)
    write_joint_angles(output / "joint_angles.csv", motion, person.skeleton.names)
    write_joint_centres(output / "joint_centres.csv", motion, person)
    write_residuals(output / "residuals.csv", motion)


def _page(output: Path, motion: Motion, person: Subject, frames: FrameFolder, name: str, metrics: list[Metric]
          ) -> None:
    from .report import track_page

    def cloud(t: int) -> np.ndarray[Any, Any]:
        return np.concatenate([np.zeros((0, 3)), *(view.points for view in frames[t])])

    track_page(motion, person, cloud, name, frames.numbers, rows(metrics)).write(output / "report.html")
