"""One marker file: whose body, its motion, and all that is written of it."""
from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from model.body import BodyModel
from model.linear import Subject
from scanprep.batch.room import Room
from scanprep.cli import MM
from scanprep.console import Metric
from scanprep.geometry import storage
from scanprep.pictures.page import Page

from ...cli import rows
from ...motion import Motion
from ..files.markers import MarkerSequence, read_markers
from ..files.motion_tables import write_joint_angles, write_joint_centres, write_motion_bvh, write_residuals
from ..marker_sets.layout import MarkerLayout
from ..marker_sets.named import fitting_layout, layout_names
from ..pose.follow import AnimateConfig, animate
from ..pose.robust import motion_problem
from ..retargeting.retarget import morphed_vertices, retarget
from ..subject.marker_shape import MarkerShapeConfig, subject_from_markers
from .report import motion_page

BetasTo = dict[float, np.ndarray] | np.ndarray      # keys over seconds, or betas at the end
ENDINGS = (".c3d", ".trc", ".csv")
MEAN_ERROR = "distance of markers, mean"


@dataclass(frozen=True, eq=False)
class Work:
    """What is the same for all files of a call.

    Attributes
    ----------
    model : BodyModel
    name : str
        Of the model, for the output.
    layout : str or Path, optional
        A named layout or a file; else the named one that fits the labels best.
    subject : Subject, optional
        Whose body; else it is found from the markers.
    onto : Subject, optional
        Another person, who makes the motion too.
    betas_to : {seconds: betas}, or betas at the end, optional
        How the body changes in the motion.
    unit, who : str, optional
        As `read_markers` takes them.
    keys : int
        Largest number of key frames in a GLB.
    """

    model: BodyModel
    name: str
    layout: str | Path | None
    subject: Subject | None
    onto: Subject | None
    betas_to: BetasTo | None
    unit: str | None
    who: str | None
    keys: int
    animate: AnimateConfig
    shape: MarkerShapeConfig

    def __call__(self, path: Path, room: Room) -> list[Metric]:
        """Follow the markers of a file; the figures."""
        return animate_file(self, path, room)

    def read_layout(self, labels: tuple[str, ...]) -> tuple[MarkerLayout, str]:
        """The layout for these labels, and its name."""
        return choose_layout(self.model, self.layout, labels)


def choose_layout(model: BodyModel, given: str | Path | None, labels: tuple[str, ...]) -> tuple[MarkerLayout, str]:
    """The layout that is named, or in a file, or the named one that fits some labels best; and its name.

    Raises
    ------
    ValueError
        Neither a name nor a file, a body on which the named one is not known.
    """
    kept = model.info.get("people_vertices")
    of_people = None if kept is None else np.array(kept)
    if given is None:
        return fitting_layout(labels, model.template, of_people)
    named = layout_or_file(given)
    if isinstance(named, str):
        return MarkerLayout.named(named, model.template, of_people), named
    return MarkerLayout.load(named, len(model.template.vertices)), str(named)


def layout_or_file(given: str | Path) -> str | Path:
    """What `--layout` names: a layout of ours as text, or a file as Path, on whose contents results depend.

    Raises
    ------
    ValueError
        Neither.
    """
    if str(given) in layout_names():
        return str(given)
    if not Path(given).exists():
        raise ValueError(f"--layout: expected a file or one of {', '.join(layout_names())}, got '{given}'")
    return Path(given)


def animate_file(work: Work, path: Path, room: Room) -> list[Metric]:
    """Follow the markers of a file, write everything into the folder of a room, and return the figures.

    The first is called "problem" where the motion means nothing, and says why.
    """
    sequence = read_markers(path, work.unit, work.who)
    layout, name = work.read_layout(sequence.labels)
    metrics = [Metric("model", work.name), Metric("layout", name)]
    body, found = work.subject, None
    if body is None:
        found = room.step("subject", (work.model, sequence, layout, work.shape),
                          lambda: subject_from_markers(work.model, sequence, layout, work.shape, room.tell))
        body, layout = work.model.subject(found.betas), found.layout
        metrics.append(Metric("subject", f"{len(found.betas)} betas from {len(found.frames)} frames"))
    # a person found from a model: what it was found from tells as much as its body, and sooner
    whose = work.subject if found is None else (work.model, found.betas)
    motion = room.step("motion", (whose, sequence, layout, work.animate),
                       lambda: animate(body, sequence, layout, work.animate, room.tell))
    output = room.folder
    if found is not None:
        storage.write_json(output / "subject.json", {"betas": found.betas.tolist(), "frames": found.frames.tolist()})
        layout.save(output / "layout.json")
    problem = motion_problem(motion, body.template, layout, sequence)
    metrics = [*([Metric("problem", problem)] if problem else []), *metrics, *figures(motion, sequence)]
    _write(work, output, motion, body)
    page = motion_page(motion, body, sequence, path.name, rows(metrics))
    if work.onto is not None:
        _other_person(work, work.onto, output, motion, body, page)
    if work.betas_to is not None:
        _changing_body(work, work.betas_to, output, motion, body, page)
    page.write(output / "report.html")
    return metrics


def figures(motion: Motion, markers: MarkerSequence) -> list[Metric]:
    """What a motion is judged by."""
    seen = np.isfinite(motion.residuals)
    off = MM * motion.residuals[seen] if seen.any() else np.array([np.nan])
    frame = MM * np.where(seen, motion.residuals, 0).sum(axis=1) / np.maximum(seen.sum(axis=1), 1)
    return [
        Metric("frames", len(motion.poses)), Metric("rate", motion.rate, "1/s"),
        Metric("markers used", f"{int(seen.any(axis=0).sum())} of {len(markers.labels)}"),
        Metric(MEAN_ERROR, float(off.mean()), "mm"),
        Metric("distance of markers, 95th percentile", float(np.percentile(off, 95)), "mm"),
        Metric("distance of markers, mean of the worst frame", float(frame.max()), "mm"),
        Metric("markers missing", 100 * float(1 - seen[:, seen.any(axis=0)].mean()) if seen.any() else 100.0, "%"),
        Metric("frames that settled", 100 * float(motion.converged.mean()), "%")]


def _write(work: Work, output: Path, motion: Motion, body: Subject) -> None:
    motion.save(output / "motion.npz")
    write_glb(output / "animation.glb", motion, body, work.keys)
    write_motion_bvh(output / "motion.bvh", motion, body)
    write_joint_angles(output / "joint_angles.csv", motion, body.skeleton.names)
    write_joint_centres(output / "joint_centres.csv", motion, body)
    write_residuals(output / "residuals.csv", motion)


def write_glb(path: Path, motion: Motion, body: Subject, keys: int, vertices: np.ndarray | None = None) -> None:
    """An animated GLB that lasts as long as the motion, of at most so many key frames.

    Parameters
    ----------
    vertices : (n, N, 3) float, metres, optional
        Of the key frames, where the body changes; else it is the subject's.
    """
    from scanprep.pictures.camera import upright
    from scanprep.pictures.gltf import write_animated_glb

    chosen = key_frames(motion, keys)
    rate = motion.rate * max(len(chosen) - 1, 1) / max(len(motion.poses) - 1, 1)
    write_animated_glb(path, body.template.faces, motion.vertices(body, chosen) if vertices is None else vertices, rate,
                       up=upright(body.template)[0], keys=keys)


def key_frames(motion: Motion, keys: int) -> np.ndarray:
    """At most so many frames, spread evenly from the first to the last."""
    return np.unique(np.linspace(0, len(motion.poses) - 1, min(keys, len(motion.poses))).round().astype(int))


def _other_person(work: Work, person: Subject, output: Path, motion: Motion, body: Subject, page: Page) -> None:
    from .report import picture_frames

    other = retarget(motion, body, person)
    other.save(output / "onto.npz")
    write_glb(output / "onto.glb", other, person, work.keys)
    page.section("On another person", "The same turns of the joints; the way over the ground is as much longer as the "
                 "legs are, and the feet are on the ground when those of the first are.")
    page.picture(picture_frames(other, person, None))


def _changing_body(work: Work, goal: BetasTo, output: Path, motion: Motion, body: Subject, page: Page) -> None:
    from .report import morph_frames, moving_picture

    shown = key_frames(motion, work.keys)
    bodies = morphed_vertices(work.model, motion, morph_keys(goal, motion), shown)
    write_glb(output / "morph.glb", motion, body, work.keys, bodies)
    some = np.unique(np.linspace(0, len(bodies) - 1, min(24, len(bodies))).round().astype(int))
    page.section("With a body that changes", "Betas change from key to key, straight over time.")
    page.picture(morph_frames(motion, body, bodies, shown)).picture(moving_picture(bodies[some], body, 8.0))


def morph_keys(given: BetasTo, motion: Motion) -> dict[float, np.ndarray]:
    """Betas at some seconds, from these or from those at the end.

    Raises
    ------
    ValueError
        Betas at the end of a motion whose own body has none.
    """
    if isinstance(given, dict):
        return given
    if motion.betas is None:
        raise ValueError("--betas-to: the subject has no betas to begin with; give keys {seconds: betas}")
    return {0.0: motion.betas, float(motion.times[-1]): given}
