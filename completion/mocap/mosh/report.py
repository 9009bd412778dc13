"""Report pages of `scape mosh`: one for a person, one for each sequence."""
from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from model.body import BodyModel
from scanprep.cli import MM
from scanprep.console import Metric
from scanprep.folders import add_entry, as_line
from scanprep.pictures.page import Page
from scanprep.pictures.scene import picture_pane
from scanprep.pictures.shading import contact_sheet
from scanprep.pictures.sheets import webp_bytes

from ...motion_pictures import chart_residuals, frame_panes, mean_over, show_markers, worst_frames
from ..files.force_plates import GroundReactions
from ..gait.cycles import GaitCycles
from ..gait.pictures import chart_cycles, chart_forces
from ..marker_sets.layout import MarkerLayout
from . import pictures
from .mosh import MoshResult
from .takes import Take


def person_page(name: str, model: BodyModel, result: MoshResult, usual: MarkerLayout, takes: Sequence[Take],
                metrics: Sequence[Metric], figures: Mapping[str, Sequence[Metric]]) -> Page:
    """Make the page of a person: shape, markers before and after, links to its sequences and their figures."""
    body, labels, misplaced = pictures.person_in_mean_pose(model, result.betas), result.layout.labels, result.misplaced
    before = usual.select(labels)
    found, places = result.layout.place(body), before.place(body)
    moved = np.linalg.norm(found - places, axis=1)
    # the body with its markers, and the sequences
    page = Page(f"{name}: body shape and markers",
                f"Found from the markers of {len(takes)} {'sequence' if len(takes) == 1 else 'sequences'} alone.")
    ways = [f"{label}: {MM * far:.0f} mm" for label, far in zip(labels, moved, strict=True)]
    page.bodies([pictures.person_pane(body, found, places, ways)],
                "the body in the mean pose of the model's people; red: where the markers sat, blue: where the layout "
                "has them, with a rod from the one to the other", 520)
    page.section("Sequences")
    for take in takes:
        add_entry(page, take.name, map(as_line, _main(figures[take.name])))
    # misplaced markers and exchanged names
    if misplaced.changes or misplaced.too_many:
        page.section("Misplaced markers", "Markers that were far from the layout's place. They were searched on the "
                     "whole body that the other markers show.")
        page.table([*((f"{first} and {second}", "names were swapped throughout; corrected", np.nan, np.nan)
                      for first, second in misplaced.exchanged),
                    *((m.label, "misplaced; moved to its real place", MM * m.before,
                       MM * m.after) for m in misplaced.moved),
                    *((label, "no place on the skin explains it; left out", np.nan, np.nan)
                      for label in misplaced.unplaced),
                    *((label, "too many are far off; left as they are", np.nan,
                       np.nan) for label in misplaced.too_many)],
                   ("marker", "what was found", "from the layout's place (mm)", "from the new place (mm)"))
    # a table of markers, the one that moved most first
    left: dict[str, list[np.ndarray]] = {}
    for take in takes:
        for label, column in zip(take.motion.labels, take.motion.residuals.T, strict=True):
            left.setdefault(label, []).append(column)
    lifts = np.asarray(before.distances), np.asarray(result.layout.distances)
    rows = [(label, MM * float(moved[i]), *(MM * float(lift[i]) for lift in lifts),
             MM * float(mean_over(np.concatenate(left.get(label, [np.array([np.nan])])), 0)))
            for i, label in enumerate(before.labels)]
    page.section("Markers before and after", "From where the layout has each marker to where it was found.")
    page.table(sorted(rows, key=lambda row: -row[1]),
               ("marker", "moved (mm)", "off the skin, layout (mm)", "found (mm)", "distance left, fixed shape (mm)"))
    if before.loose:
        page.text(f"Loose markers, which may sit anywhere on their limb: {', '.join(before.loose)}.")
    return page.section("Figures").figures(metrics)


def take_page(take: Take, metrics: Sequence[Metric], picture: np.ndarray, gait: GaitCycles | None,
              reactions: GroundReactions | None) -> Page:
    """Make the page of a sequence without its end: motion, gait, distances of markers, soft tissue, artefacts."""
    motion, artefacts = take.motion, take.artefacts
    page = Page(f"{take.name}, with {'soft tissue' if take.soft else 'fixed shape'}",
                "Dots are the measured markers: red where they are believed, orange where they are seen but not "
                "believed.")
    page.table([(m.name, m.text(), m.unit) for m in _main(metrics)])
    page.section("The whole sequence").bodies(
        [pictures.take_pane(take)], "Press the triangle to play, drag the body to turn it; it is kept in the middle.",
        520, webp_bytes(picture))
    show_walk(page, gait, reactions)
    page.section("Distance of the markers", "From where the body has them to where they were measured.")
    page.chart(chart_residuals(take.shown), "mean of the markers, over time")
    page.bodies(frame_panes(motion, take.subject, take.markers.positions, worst_frames(take.shown, 5)),
                "the frames in which they are farthest", 300)
    show_markers(page, motion, None if take.soft is None else take.soft.motion)
    if take.soft is not None:
        page.section("Soft tissue", "The skin may move in every frame, as flesh does and as a pose model with one "
                     "fixed shape cannot. What it takes up may also be markers that slide with the skin.")
        page.bodies([pictures.soft_pane(take, take.soft)], "where the body changes most")
    page.section("Marker artefacts", "The body says where each marker should be: one that is elsewhere was "
                 "swapped with another, has slipped, jitters or strays.")
    # a table of artefacts, in order of time
    found = [("swapped", f"{e.first} and {e.second}", e.begin, e.end, (e.end - e.begin + 1) / motion.rate, np.nan)
             for e in artefacts.swaps]
    found += [(b.kind, b.label, b.begin, b.end, (b.end - b.begin + 1) / motion.rate, MM * b.distance)
              for b in artefacts.bad]
    if found:
        page.table(sorted(found, key=lambda row: row[2]),
                   ("artefact", "marker", "first frame", "last frame", "lasts (s)", "distance (mm)"))
    else:
        page.text("None was found.")
    return page


def show_walk(page: Page, gait: GaitCycles | None, reactions: GroundReactions | None) -> None:
    """Add joint angles over the gait cycle, and forces of the force plates, where there are any."""
    if gait is not None:
        sides = gait.events.cycles
        page.section("Gait", f"{len(sides['l'])} left and {len(sides['r'])} right gait cycles, "
                     f"{gait.events.cadence:.0f} steps a minute. Foot strikes and foot offs are from: "
                     f"{gait.events.source}. All angles are in gait_cycles.csv.")
        page.chart(chart_cycles(gait), "joint angles from foot strike to the next strike of the same foot; the pelvis "
                                       "is measured from the way of walking, once over left and once over right cycles")
    if reactions is not None:
        page.section("Force plates", "Forces of the ground on the person, in grf.mot for OpenSim.")
        page.chart(chart_forces(reactions), "vertical force over time")
        for note in reactions.notes:
            page.text(f"{note[0].upper()}{note[1:]}.")


def take_picture(take: Take) -> np.ndarray:
    """Render six frames of a sequence, for the page of its person."""
    frames = np.unique(np.linspace(0, len(take.motion.poses) - 1, 8).round().astype(int)[1:-1])
    panes = frame_panes(take.motion, take.subject, take.markers.positions, frames)
    return contact_sheet([picture_pane(pane, 161, 260) for pane in panes], [pane.label for pane in panes])


def _main(metrics: Sequence[Metric]) -> list[Metric]:
    """Return the metrics of the quality of a motion."""
    return [m for m in metrics if m.unit == "mm" or m.name in ("frames", "swaps", "bad spans")]
