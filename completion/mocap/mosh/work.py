"""One person: read the recordings, find the person and the motions, and write everything."""
from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from model.body import BodyModel
from model.learning.sex_plane import SexGuess
from scanprep.batch.room import Room
from scanprep.console import Metric, Outcome, write_report
from scanprep.pictures.camera import upright
from scanprep.pictures.sheets import save_png

from ...motion import spread_frames
from ...motion_pictures import picture_bodies
from ..artefacts.virtual import fault_table
from ..files.markers import MarkerSequence, read_markers
from ..files.motion_files import write_glb
from ..marker_sets.layout import MarkerLayout
from ..marker_sets.named import choose_layout
from ..pose.robust import motion_problem
from ..results import MoshResult
from ..retargeting.pictures import picture_transfer, write_character
from ..retargeting.retarget import retarget
from ..retargeting.soft_tissue import retarget_soft_tissue
from ..settings import MoshConfig
from ..subject.sex import mosh_by_sex
from .charts import MM
from .mosh import mosh
from .outputs import write_person, write_take
from .pictures import standing
from .recordings import Actor, Recording
from .report import PICTURE, closing, person_page, person_picture, take_page, take_picture
from .takes import LightMesh, Take, held_out

ERRORS = ("marker error, fixed shape", "marker error, soft tissue", "held-out error, fixed shape",
          "held-out error, soft tissue")
HALF = 100                           # of progress: finding shape and motion, then files and pictures


@dataclass(frozen=True, eq=False)
class Work:
    """The work on each person of a call.

    Attributes
    ----------
    model : BodyModel
    name : str
        Of the model, for the output.
    sexes : {"female", "male": BodyModel}
        Models for the sex that `model` tells; empty to do without.
    character : BodyModel, optional
        Whose body makes the motions too.
    layout : MarkerLayout and its name, optional
        Else the named one that fits the labels best.
    hold_out : strings
        Markers that no stage sees.
    unit : str, optional
        As `read_markers` takes it.
    keys : int
        Largest number of key frames in a GLB.
    factor : float
        On soft tissue, in exaggerated.glb and on the character.
    command : str
        For report.json.
    """

    model: BodyModel
    name: str
    sexes: Mapping[str, BodyModel]
    character: BodyModel | None
    layout: tuple[MarkerLayout, str] | None
    hold_out: tuple[str, ...]
    unit: str | None
    keys: int
    factor: float
    config: MoshConfig
    command: str = field(metadata={"digest": False})

    def __call__(self, actor: Actor, room: Room) -> tuple[list[Metric], list[str]]:
        return mosh_person(self, actor, room)


@dataclass(frozen=True, eq=False)
class _Found:
    """A person."""

    model: BodyModel
    guess: SexGuess | None
    result: MoshResult
    takes: list[Take]
    usual: MarkerLayout
    layout_name: str


def mosh_person(work: Work, actor: Actor, room: Room) -> tuple[list[Metric], list[str]]:
    """Everything of one person into the folder of a room: the figures, and what failed.

    A recording that cannot be read is left out and told. The first figure is called "problem" where a motion means
    nothing, and says why.

    Raises
    ------
    ValueError
        No recording that can be read, or as `mosh`.
    """
    start, folder = time.perf_counter(), room.folder
    found, failures = _solve(work, actor, room)
    settings = {"mosh": work.config, "model": work.name, "layout": found.layout_name, "held out": work.hold_out}
    about = {"model": work.name, "layout": found.layout_name, "held_out": work.hold_out, "sex": found.guess,
             "recordings": [r.path.name for r in actor.recordings]}
    write_person(folder, found.result, about)
    figures: dict[str, list[Metric]] = {}
    total = len(found.takes) + 1
    for i, take in enumerate(found.takes):
        room.tell(HALF + HALF * i // total, 2 * HALF)
        figures[take.name] = _write(work, found, take, room, settings)
    room.tell(HALF + HALF * (total - 1) // total, 2 * HALF)
    problems = [(take.name, _problem(found, take)) for take in found.takes]
    metrics = [Metric("model", work.name), *_person_metrics(found), *_figures(found.takes)]
    if any(problem for _, problem in problems):
        told = "; ".join(f"{name}: {problem}" for name, problem in problems if problem)
        metrics.insert(0, Metric("problem", told))
    person_page(actor.name, found.model, found.result, found.usual, found.takes, metrics, figures,
                settings).write(folder / "report.html")
    save_png(folder / PICTURE, person_picture(found.model, found.result))
    metrics += _speeds(found)                    # not on the page: it is the same however often it is made
    write_report(Outcome(folder, metrics, settings, failures), work.command, time.perf_counter() - start)
    room.tell(2 * HALF, 2 * HALF)
    return metrics, failures


def _solve(work: Work, actor: Actor, room: Room) -> tuple[_Found, list[str]]:
    recordings, sequences, failures = _read(work, actor.recordings)
    labels = tuple(dict.fromkeys(label for each in sequences for label in each.labels))
    usual, layout_name = work.layout or choose_layout(work.model, None, labels)
    try:
        layout = usual.without(work.hold_out) if work.hold_out else usual
    except ValueError as error:
        raise ValueError(f"--hold-out: {error}") from None
    model, guess = work.model, None

    def progress(done: int, total: int) -> None:
        room.tell(HALF * done // total, 2 * HALF)

    if work.sexes:
        told = mosh_by_sex({"neutral": work.model, **work.sexes}, sequences, layout, work.config, progress, room.step)
        model, guess, result = told.model, told.guess, told.result
    else:
        result = mosh(model, sequences, layout, work.config, progress, room.step)
    subject = model.subject(result.betas)
    light, takes = LightMesh.of(model.template), []
    for i, (source, markers) in enumerate(zip(recordings, sequences, strict=True)):
        soft = result.soft_tissue[i] if result.soft_tissue else None
        held = held_out(model, usual, work.hold_out, markers, result.motions[i], soft)
        takes.append(Take(source.name, source.path, source.who, work.unit, model, subject, markers, result.motions[i],
                          soft, result.faults[i], held, light))
    return _Found(model, guess, result, takes, usual, layout_name), failures


def _read(work: Work, recordings: Sequence[Recording]) -> tuple[list[Recording], list[MarkerSequence], list[str]]:
    found, sequences, failures = [], [], []
    for recording in recordings:
        try:
            sequences.append(read_markers(recording.path, work.unit, recording.who))
            found.append(recording)
        except ValueError as error:
            failures.append(" ".join(str(error).replace(str(recording.path), recording.path.name).split()))
    if not sequences:
        raise ValueError("; ".join(failures))
    return found, sequences, failures


def _write(work: Work, found: _Found, take: Take, room: Room, settings: Mapping[str, Any]) -> list[Metric]:
    """A sequence into its folder; the figures."""
    metrics = [Metric("layout", found.layout_name), *_figures([take])]
    solved = found.model, take.markers, take.motion, take.soft, take.faults, take.held

    def files(folder: Path) -> None:
        (folder / take.name).mkdir(exist_ok=True)
        write_take(folder / take.name, take, work.keys, work.factor)

    def character(folder: Path) -> tuple[Any, str]:
        (folder / take.name).mkdir(exist_ok=True)
        assert work.character is not None, "asked for"
        return _character(work.character, take, folder / take.name, work.keys, work.factor)

    def page(folder: Path) -> None:
        start, place = time.perf_counter(), folder / take.name
        place.mkdir(exist_ok=True)
        page = take_page(take, metrics)
        if shown is not None:
            page.section("On a character", "The same turns of the joints, and feet on the ground when those of the "
                         f"person are; soft tissue taken {work.factor:g} times.").picture(*shown)
        closing(page, metrics, settings).write(place / "report.html")
        save_png(place / PICTURE, take_picture(take))
        outcome = Outcome(place, metrics, settings, problem=_problem(found, take))
        write_report(outcome, work.command, time.perf_counter() - start)

    room.files(f"{take.name} files", (solved, take.path, take.who, take.unit, work.keys, work.factor), files)
    shown = None if work.character is None else room.files(
        f"{take.name} character", (solved, work.character, work.keys, work.factor), character)
    room.files(f"{take.name} page", (solved, metrics, settings, shown and (shown, work.factor)), page)
    return metrics


def _problem(found: _Found, take: Take) -> str | None:
    """Why the motion of a sequence means nothing."""
    return motion_problem(take.motion, take.subject.template, found.result.layout, take.markers)


def _person_metrics(found: _Found) -> list[Metric]:
    moved, result = MM * found.result.person.moved, found.result
    body = standing(found.model, result.betas)
    told = [Metric("layout", found.layout_name), Metric("sequences", len(found.takes)),
            Metric("height", float(np.ptp(body.vertices[:, upright(body)[0]])), "m"),
            Metric("volume", 1000 * abs(body.volume), "l"),
            Metric("betas, length", float(np.linalg.norm(result.betas)), "sd"),
            Metric("markers moved, mean", float(moved.mean()), "mm"),
            Metric(f"markers moved, most ({result.layout.labels[int(moved.argmax())]})", float(moved.max()), "mm")]
    if found.guess is not None:
        told[1:1] = [Metric("sex", found.guess.sex), Metric("sex, probability", 100 * found.guess.probability, "%")]
    return told


def _speeds(found: _Found) -> list[Metric]:
    frames = sum(len(take.motion.poses) for take in found.takes)
    return [Metric(f"{stage}, time", seconds, "s") if stage == "person" else
            Metric(f"{stage}, speed", frames / max(seconds, 1e-9), "frames/s")
            for stage, seconds in found.result.seconds.items()]


def _figures(takes: Sequence[Take]) -> list[Metric]:
    """What motions are judged by, of all frames together."""
    T = sum(len(take.motion.poses) for take in takes)
    out = [Metric("frames", T)]
    if len(takes) == 1:
        out.append(Metric("rate", takes[0].motion.rate, "1/s"))
    fixed, soft = ([t.motion.residuals for t in takes], [t.soft.motion.residuals for t in takes if t.soft is not None])
    held = [t.held for t in takes if t.held is not None]
    held_soft = [h.soft for h in held if h.soft is not None]
    for name, values in zip(ERRORS, (fixed, soft, [h.fixed for h in held], held_soft), strict=True):
        if values:
            out.append(Metric(name, MM * float(np.nanmean(np.concatenate([v.ravel() for v in values]))), "mm"))
    missing = sum(int((~t.markers.select(t.faults.labels).seen).sum()) for t in takes)
    filled = sum(sum(fault_table(t.faults)["filled"].values()) for t in takes)
    share = 100 / max(sum(t.faults.simulated[..., 0].size for t in takes), 1)
    return [*out, Metric("exchanges", sum(len(t.faults.exchanges) for t in takes)),
            Metric("bad spans", sum(len(t.faults.bad) for t in takes)),
            Metric("markers missing", share * missing, "%"),
            Metric("taken out as bad", share * max(filled - missing, 0), "%"),
            Metric("gaps filled in", filled, "positions")]


def _character(character: BodyModel, take: Take, folder: Path, keys: int, factor: float
               ) -> tuple[np.ndarray, str]:
    """The motion on a character: character.npz, character.glb; a picture, and what it shows."""
    if take.soft is not None:
        moving = retarget_soft_tissue(take.soft, take.model, character, factor)
        moving.save(folder / "character.npz")
        write_character(folder / "character.glb", character, moving, keys)
        return (picture_transfer(take.model, take.soft, character, moving),
                "the person, the character, and how far the character's skin is stretched or squeezed")
    body = character.subject(np.zeros(character.n_betas))
    motion = retarget(take.motion, take.subject, body)
    motion.save(folder / "character.npz")
    write_glb(folder / "character.glb", motion, body, keys)
    frames = spread_frames(len(motion.poses), 8)
    return picture_bodies(motion, body, motion.vertices(body, frames), frames), ""
